"""The block Cholesky factorisation against dense linear algebra, on patterns of every kind."""

import itertools

import numpy as np
import pytest

from pcm_jax.sparse import assembly
from pcm_jax.sparse._memory import SpareMemory
from pcm_jax.sparse._symbolic import front_tree
from pcm_jax.sparse.assembly import _places, plan_for
from pcm_jax.sparse.cholesky import (
    NotPositiveDefiniteError,
    factorize,
    inverse_triangles,
)
from pcm_jax.sparse.inverse import (
    inverse_block,
    inverse_column,
    inverse_columns,
    inverse_diagonal,
    inverse_own,
)
from pcm_jax.sparse.selected import Selected


@pytest.fixture
def rng() -> np.random.Generator:
    """One stream for each test, whatever ran before it."""
    return np.random.default_rng(3)


def random_pairs(size: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    pairs = np.random.default_rng(count).integers(0, size, (count, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    return pairs[:, 0], pairs[:, 1]


def chain(size: int) -> tuple[np.ndarray, np.ndarray]:
    return np.arange(size - 1), np.arange(1, size)


def grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    index = np.arange(side * side).reshape(side, side)
    tail = np.concatenate([index[:, :-1].ravel(), index[:-1].ravel()])
    return tail, np.concatenate([index[:, 1:].ravel(), index[1:].ravel()])


def star(size: int) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros(size - 1, int), np.arange(1, size)


PATTERNS = {
    "one pose": (1, (np.empty(0, int), np.empty(0, int))),
    "no pair": (5, (np.empty(0, int), np.empty(0, int))),
    "chain": (200, chain(200)),
    "star": (60, star(60)),
    "grid": (400, grid(20)),
    "complete": (40, tuple(np.triu_indices(40, 1))),
    "sparse random": (150, random_pairs(150, 200)),
    "dense random": (80, random_pairs(80, 1200)),
    "two parts": (
        61,
        (np.r_[chain(30)[0], 30 + chain(31)[0]], np.r_[chain(30)[1], 30 + chain(31)[1]]),
    ),
}


@pytest.fixture(params=PATTERNS)
def pattern(request: pytest.FixtureRequest) -> tuple[int, np.ndarray, np.ndarray]:
    size, (tail, head) = PATTERNS[request.param]  # type: ignore[misc]
    return size, tail, head


def random_system(rng: np.random.Generator, size: int, tail: np.ndarray, head: np.ndarray, d: int):
    """A plan, blocks of a positive definite H in its order, and H dense in the poses' order."""
    plan = plan_for(size, tail, head, d)
    blocks = rng.normal(size=(len(plan.block_row), d, d))
    blocks[:size] = 0.0
    dense = np.zeros((size, d, size, d))
    pose = np.argsort(plan.position)
    for block, row, column in zip(
        blocks, pose[plan.block_row], pose[plan.block_column], strict=True
    ):
        dense[row, :, column] += block
        dense[column, :, row] += block.T
    weight = np.abs(dense).sum(axis=(2, 3)) + 1.0
    blocks[plan.position] = weight[:, :, None] * np.eye(d)
    for pose_index in range(size):
        dense[pose_index, :, pose_index] = np.diag(weight[pose_index])
    return plan, blocks, dense.reshape(size * d, size * d)


@pytest.mark.parametrize("d", [1, 3, 6])
def test_solve_inverts_the_matrix(pattern, d, rng):
    size, tail, head = pattern
    plan, blocks, dense = random_system(rng, size, tail, head, d)
    right = rng.normal(size=(size * d, 3))
    factor = factorize(plan, blocks)
    np.testing.assert_allclose(dense @ factor.solve(right), right, atol=1e-10)
    np.testing.assert_allclose(dense @ factor.solve(right[:, 0]), right[:, 0], atol=1e-10)


@pytest.mark.parametrize("d", [1, 3, 6])
def test_inverse_block_is_that_of_the_dense_inverse(pattern, d, rng):
    size, tail, head = pattern
    plan, blocks, dense = random_system(rng, size, tail, head, d)
    wanted = rng.permutation(size)[: max(1, size // 3)]
    rows = (wanted[:, None] * d + np.arange(d)).ravel()
    expected = np.linalg.inv(dense)[np.ix_(rows, rows)]
    found = inverse_block(factorize(plan, blocks), wanted)
    np.testing.assert_allclose(found, expected, atol=1e-13)
    np.testing.assert_array_equal(found, found.T)


@pytest.mark.parametrize("d", [3, 6])
def test_columns_and_diagonal_are_those_of_the_dense_inverse(pattern, d, monkeypatch, rng):
    monkeypatch.setattr("pcm_jax.sparse.inverse.POSES_AT_ONCE", 16)
    size, tail, head = pattern
    plan, blocks, dense = random_system(rng, size, tail, head, d)
    factor = factorize(plan, blocks)
    expected = np.linalg.inv(dense).reshape(size, d, size, d)
    wanted = rng.permutation(size)[: max(1, size // 3)]
    right = rng.normal(size=(len(wanted), d, d))
    columns = inverse_columns(factor, wanted, right)[plan.position]
    products = np.einsum("iajb,jbc->iacj", expected[:, :, wanted], right)
    np.testing.assert_allclose(columns, products, atol=1e-12)
    diagonal = inverse_diagonal(factor, wanted)
    np.testing.assert_allclose(diagonal, expected[wanted, :, wanted], atol=1e-13)


@pytest.mark.parametrize("d", [1, 3, 6])
def test_one_column_and_its_own_block_are_those_of_the_dense_inverse(pattern, d, rng):
    size, tail, head = pattern
    plan, blocks, dense = random_system(rng, size, tail, head, d)
    factor = factorize(plan, blocks)
    expected = np.linalg.inv(dense).reshape(size, d, size, d)
    for pose in {0, size // 2, size - 1}:
        right = rng.normal(size=(d, d))
        column = inverse_column(factor, pose, right)[plan.position]
        np.testing.assert_allclose(column, expected[:, :, pose] @ right, atol=1e-12)
        own = inverse_own(factor, pose, right)
        np.testing.assert_allclose(own, right.T @ expected[pose, :, pose] @ right, atol=1e-12)


@pytest.mark.parametrize("d", [1, 3, 6])
def test_blocks_at_the_factor_s_own_are_those_of_the_dense_inverse(pattern, d, rng):
    """Of all pairs that share a front: those that edges join, and those that elimination adds."""
    size, tail, head = pattern
    plan, blocks, dense = random_system(rng, size, tail, head, d)
    expected = np.linalg.inv(dense).reshape(size, d, size, d).transpose(0, 2, 1, 3)
    position = plan.position
    assert plan.tree.together(position[tail], position[head]).all()
    first, second = (part.ravel() for part in np.indices((size, size)))
    together = plan.tree.together(position[first], position[second])
    assert together[first == second].all()
    parted = np.zeros((size, size), bool)  # fronts, one by one
    for front, start in enumerate(plan.tree.first):
        rest = plan.tree.rest[plan.tree.rest_start[front] : plan.tree.rest_start[front + 1]]
        own = np.arange(start, start + plan.tree.pivots[front])
        parted[np.ix_(own, np.append(own, rest))] = True
    parted |= parted.T
    np.testing.assert_array_equal(together, parted[position[first], position[second]])
    first, second = first[together], second[together]
    found = Selected(factorize(plan, blocks)).pairs(first, second)
    np.testing.assert_allclose(found, expected[first, second], atol=1e-13)


@pytest.mark.parametrize("d", [3, 6])
def test_right_hand_sides_cost_no_product(pattern, d, rng):
    """Rᵀ (block of the inverse) R, by blocks of R."""
    size, tail, head = pattern
    plan, blocks, dense = random_system(rng, size, tail, head, d)
    factor = factorize(plan, blocks)
    wanted = rng.permutation(size)[: max(1, size // 3)]
    right = rng.normal(size=(len(wanted), d, d))
    inverse = np.linalg.inv(dense).reshape(size, d, size, d)[wanted][:, :, wanted]
    expected = np.einsum("iba,ibjc,jcd->iajd", right, inverse, right)
    found = inverse_block(factor, wanted, right).reshape(expected.shape)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    own = np.arange(len(wanted))
    diagonal = inverse_diagonal(factor, wanted, right)
    np.testing.assert_allclose(diagonal, expected[own, :, own], atol=1e-12)


def test_a_long_chain_is_solved(rng):
    size, d = 3000, 3
    plan = plan_for(size, *chain(size), d)
    blocks = np.zeros((len(plan.block_row), d, d))
    blocks[:size], blocks[size:] = 2.5 * np.eye(d), -np.eye(d)
    right = rng.normal(size=(size, d))
    x = factorize(plan, blocks).solve(right.ravel()).reshape(size, d)
    product = 2.5 * x
    product[1:] -= x[:-1]
    product[:-1] -= x[1:]
    np.testing.assert_allclose(product, right, atol=1e-12)


def test_large_fronts_take_the_same_path_as_small_ones(monkeypatch, rng):
    plan, blocks, dense = random_system(rng, 60, *random_pairs(60, 700), 6)
    right = rng.normal(size=360)
    monkeypatch.setattr("pcm_jax.sparse.cholesky.LARGE_PIVOTS", 0)
    np.testing.assert_allclose(dense @ factorize(plan, blocks).solve(right), right, atol=1e-10)


@pytest.mark.parametrize("size", [1, 9, 24, 36, 72, 96, 50])
def test_inverse_of_triangles(size, rng):
    lower = np.tril(rng.normal(size=(3, size, size))) + 5 * np.eye(size)
    inverse = inverse_triangles(lower)
    expected = np.broadcast_to(np.eye(size), lower.shape)
    np.testing.assert_allclose(inverse @ lower, expected, atol=1e-12)
    np.testing.assert_allclose(np.triu(inverse, 1), 0.0, atol=1e-12)


def test_places_overlap_only_where_the_earlier_one_is_done_with(rng):
    size = rng.integers(0, 9, 60)
    needed_by = np.arange(60) + rng.integers(1, 20, 60)
    start = _places(size, needed_by)
    for early, late in itertools.combinations(range(60), 2):
        apart = (
            start[early] + size[early] <= start[late] or start[late] + size[late] <= start[early]
        )
        assert apart or needed_by[early] <= late
    assert (start + size).max() < size.sum() / 2


def test_places_are_the_first_gaps_that_are_long_enough():
    """The third fits where the first was, which nobody needs by then; the fourth behind all."""
    start = _places(np.array([2, 3, 1, 2]), np.array([2, 4, 4, 4]))
    assert start.tolist() == [0, 2, 0, 5]


def test_groups_share_memory_and_stay_small(monkeypatch):
    size, (tail, head) = PATTERNS["grid"]
    whole = plan_for(size, tail, head, 3)
    monkeypatch.setattr(assembly, "SCALARS_AT_ONCE", 1000)
    small = plan_for(size, head, tail, 3)
    fronts = [group.count * (group.pivots + group.rest) ** 2 for group in small.groups]
    assert max(front for front, g in zip(fronts, small.groups, strict=True) if g.count > 1) <= 1000
    assert len(small.groups) > len(whole.groups)
    own = sum(group.count * group.rest**2 for group in small.groups)
    assert small.chunks * 3 - (1 + len(small.block_row)) * 9 < own / 2


def test_a_factor_in_given_memory_is_the_same(rng):
    plan, blocks, _ = random_system(rng, 60, *random_pairs(60, 200), 3)
    right = rng.normal(size=180)
    expected = factorize(plan, blocks).solve(right)
    spare = SpareMemory()
    for _ in range(2):
        with spare.borrow(plan.scalars) as memory:
            memory[:] = np.nan
            factor = factorize(plan, blocks, memory)
            assert all(np.shares_memory(part, memory) for part in factor.couplings if part.size)
            np.testing.assert_array_equal(factor.solve(right), expected)


def test_an_indefinite_matrix_is_reported(rng):
    plan, blocks, _ = random_system(rng, 50, *chain(50), 3)
    blocks[7] *= -1.0
    with pytest.raises(NotPositiveDefiniteError):
        factorize(plan, blocks)


def test_a_matrix_that_is_not_finite_is_reported(rng):
    plan, blocks, _ = random_system(rng, 50, *chain(50), 3)
    blocks[7] = np.nan
    with pytest.raises(NotPositiveDefiniteError):
        factorize(plan, blocks)


def test_the_tree_eliminates_every_pose_once_and_children_first(pattern):
    size, tail, head = pattern
    tree = front_tree(size, tail, head)
    np.testing.assert_array_equal(np.sort(tree.position), np.arange(size))
    assert tree.pivots.sum() == size
    inner = tree.parent >= 0
    assert (tree.parent[inner] > np.flatnonzero(inner)).all()
    for front in range(len(tree.first)):
        rest = tree.rest[tree.rest_start[front] : tree.rest_start[front + 1]]
        assert (np.diff(rest) > 0).all()
        assert (rest >= tree.first[front] + tree.pivots[front]).all()


def test_a_long_ring_has_a_low_tree():
    """Minimum degree halves a ring again and again: the fill of the M-matrix must not underflow."""
    size = 20000
    tree = front_tree(size, np.arange(size), (np.arange(size) + 1) % size)
    assert tree.height.max() < 60
    assert tree.rests.max() <= 4
    assert (tree.parent < 0).sum() == 1


def test_plans_are_found_by_content():
    tail, head = random_pairs(40, 60)
    plan = plan_for(40, tail, head, 3)
    assert plan_for(40, tail.copy(), head.astype(np.int32), 3) is plan
    assert plan_for(40, tail, head, 6) is not plan
    assert plan_for(41, tail, head, 3) is not plan
