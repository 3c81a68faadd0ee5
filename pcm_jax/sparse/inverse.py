"""Parts of `H⁻¹` from the factor of `H`: a block, its diagonal, some columns.

They are the joint covariance of some poses, of each pose alone, and of some poses with all.

With `H = L Lᵀ` and the unit columns `E` of the poses, the block is `Eᵀ H⁻¹ E = Wᵀ W`, `W = L⁻¹ E`:
forward substitution alone. The columns of `W` are sparse. A pose's column is nonzero only in the
fronts on its way from the front that eliminates it to the root; in elimination order the poses
below a front are consecutive, so each front multiplies one dense slice:

    [ W_s ]   [ L⁻¹            ] [ right-hand sides of the front's poses, ]
    [ U_s ] = [ −X L⁻¹     I   ] [ its own and its children's U           ]      block += W_sᵀ W_s

Work is Σ pivots · (poses of interest below)², far below both the whole inverse and `H⁻¹ E`.

Whole columns `H⁻¹ E R` take back substitution as well, from the root down: with X_r the solution at
a front's rest, `X_s = L⁻ᵀ (W_s R − Xᵀ X_r)`. Each costs twice the factor's size.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pcm_jax.sparse import registry
from pcm_jax.sparse._symbolic import FrontTree
from pcm_jax.sparse.cholesky import CholeskyFactor

LARGE_COLUMNS = 1536
"""Columns (scalars) from which BLAS threads gain even where other work holds some cores."""
POSES_AT_ONCE = 512
"""A bound on the memory of `inverse_diagonal`."""


class _Passed(NamedTuple):
    """A child's U: the poses of its rest against the columns from `first_column` on."""

    child: int
    first_column: int
    update: Float[np.ndarray, "r*d columns*d"]


def inverse_block(
    factor: CholeskyFactor,
    poses: Int[np.ndarray, " k"],
    right: Float[np.ndarray, "k d d"] | None = None,
) -> Float[np.ndarray, "k*d k*d"]:
    """Rᵀ Eᵀ H⁻¹ E R: rows and columns of `H⁻¹` that belong to `poses`, in their order.

    Args:
        factor: of `H`.
        poses: which block columns, each given once.
        right: `[j]` the block of R for pose j, which costs nothing; None: the identity.
    """
    d, by_position = factor.plan.block_dim, np.argsort(factor.plan.position[poses])
    total = np.zeros((len(poses) * d, len(poses) * d))
    right = _identities(len(poses), d) if right is None else right
    with registry.blas.one():
        for solved in _forward(factor, poses[by_position], right[by_position]):
            part = slice(solved.low * d, solved.high * d)
            total[part, part] += solved.rows.T @ solved.rows
    given = np.argsort(by_position)
    blocks = total.reshape(len(poses), d, len(poses), d)
    return blocks[given][:, :, given].reshape(total.shape)


def inverse_diagonal(
    factor: CholeskyFactor,
    poses: Int[np.ndarray, " k"],
    right: Float[np.ndarray, "k d d"] | None = None,
) -> Float[np.ndarray, "k d d"]:
    """The diagonal blocks of what `inverse_block` gives for the same arguments."""
    right = _identities(len(poses), factor.plan.block_dim) if right is None else right
    d, by_position = factor.plan.block_dim, np.argsort(factor.plan.position[poses])
    total = np.zeros((len(poses), d, d))
    with registry.blas.one():
        for start in range(0, len(poses), POSES_AT_ONCE):
            some = by_position[start : start + POSES_AT_ONCE]
            for solved in _forward(factor, poses[some], right[some]):
                columns = solved.rows.reshape(len(solved.rows), -1, d).transpose(1, 2, 0)
                total[some[solved.low : solved.high]] += columns @ columns.transpose(0, 2, 1)
    return total


def inverse_columns(
    factor: CholeskyFactor, poses: Int[np.ndarray, " k"], right: Float[np.ndarray, "k d d"]
) -> Float[np.ndarray, "n d d k"]:
    """Columns `H⁻¹ E R`: those of `poses`, each given once, times a block of its own.

    Args:
        factor: of `H`.
        poses: which block columns.
        right: `[j]` what column j is multiplied by from the right.

    Returns:
        `[p, :, :, j]`: the block of the pose at elimination position p (`factor.plan.position`).
    """
    tree, d = factor.plan.tree, factor.plan.block_dim
    by_position = np.argsort(factor.plan.position[poses])
    solution = np.zeros((tree.size, d, d, len(poses)))
    with registry.blas.one():
        for solved in _forward(factor, poses[by_position], right[by_position]):
            first = tree.first[solved.front]
            own = slice(first, first + tree.pivots[solved.front])
            blocks = solved.rows.reshape(-1, d, solved.high - solved.low, d)
            solution[own][..., by_position[solved.low : solved.high]] = blocks.swapaxes(2, 3)
        _backward(factor, solution.reshape(tree.size, d, -1))
    return solution


def inverse_column(
    factor: CholeskyFactor, pose: int, right: Float[np.ndarray, "d d"]
) -> Float[np.ndarray, "n d d"]:
    """One of `inverse_columns`, in a fraction of the time: all fronts of a group at once.

    Args:
        factor: of `H`.
        pose: which block column.
        right: what it is multiplied by from the right.
    """
    plan, tree, d = factor.plan, factor.plan.tree, factor.plan.block_dim
    rows = np.zeros(((tree.size + 1) * d, d))  # padding lies behind the last
    with registry.blas.one():
        for own, solved, inverse in _path(factor, pose, right, rows):
            rows[own] = inverse.T @ solved
        for group, back in zip(reversed(plan.groups), reversed(factor.back), strict=True):
            if group.rest:
                own = rows.take(group.pivot_rows, axis=0)
                rows[group.pivot_rows] = own - back @ rows.take(group.rest_rows, axis=0)
                rows[tree.size * d :] = 0.0
    return rows.reshape(-1, d, d)[:-1]


def inverse_own(
    factor: CholeskyFactor, pose: int, right: Float[np.ndarray, "d d"]
) -> Float[np.ndarray, "d d"]:
    """One of `inverse_diagonal`: what the fronts on the way from a pose to the root add up to.

    Args:
        factor: of `H`.
        pose: which block.
        right: what it is multiplied by from the right, and transposed from the left.
    """
    d = factor.plan.block_dim
    rows, total = np.zeros((factor.plan.tree.size * d, d)), np.zeros((d, d))
    with registry.blas.one():
        for _, solved, _ in _path(factor, pose, right, rows):
            total += solved.T @ solved
    return total


def _path(
    factor: CholeskyFactor, pose: int, right: Float[np.ndarray, "d d"], rows: np.ndarray
) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """W of one column, front by front up to the root: which rows, W there, and the front's L⁻¹.

    Args:
        factor: of `H`.
        pose: which block column.
        right: what it is multiplied by from the right.
        rows: zeros, to work in.
    """
    tree, d = factor.plan.tree, factor.plan.block_dim
    blocks = rows.reshape(-1, d, d)
    blocks[factor.plan.position[pose]] = right
    front = int(tree.front_of[factor.plan.position[pose]])
    while front >= 0:
        first = int(tree.first[front])
        own = slice(first * d, (first + int(tree.pivots[front])) * d)
        rest = tree.rest[tree.rest_start[front] : tree.rest_start[front + 1]]
        inverse, coupling = _front_of(factor, front)
        solved = inverse @ rows[own]
        if len(rest):
            blocks[rest] -= (coupling @ solved).reshape(len(rest), d, d)
        yield own, solved, inverse
        front = int(tree.parent[front])


def _backward(factor: CholeskyFactor, solution: Float[np.ndarray, "n d k*d"]) -> None:
    """Turns W into the solution, front by front from the root down, in place."""
    tree, d = factor.plan.tree, factor.plan.block_dim
    for front in reversed(range(len(tree.first))):
        own = slice(tree.first[front], tree.first[front] + tree.pivots[front])
        rest = tree.rest[tree.rest_start[front] : tree.rest_start[front + 1]]
        inverse, coupling = _front_of(factor, front)
        known = solution[own].reshape(len(inverse), -1)
        if len(rest):
            known -= coupling.T @ solution[rest].reshape(len(rest) * d, -1)
        np.matmul(inverse.T, known.copy(), out=known)


def _identities(count: int, d: int) -> Float[np.ndarray, "k d d"]:
    return np.broadcast_to(np.eye(d), (count, d, d))


class _Solved(NamedTuple):
    """W at one front: its poses' rows against the columns from `low` up to `high`."""

    front: int
    low: int
    high: int
    rows: Float[np.ndarray, "p*d columns*d"]


def _forward(
    factor: CholeskyFactor, poses: Int[np.ndarray, " k"], right: Float[np.ndarray, "k d d"]
) -> Iterator[_Solved]:
    """W of `E R`, front by front from the leaves up; `poses` in elimination order.

    What the caller does with a front's rows runs with as many BLAS threads as suit them; the caller
    is in `registry.blas.one` until the last front.
    """
    plan, tree, d = factor.plan, factor.plan.tree, factor.plan.block_dim
    wanted = plan.position[poses]
    low = np.searchsorted(wanted, _subtree_starts(tree))
    middle = np.searchsorted(wanted, tree.first)
    high = np.searchsorted(wanted, tree.first + tree.pivots)
    passed: list[list[_Passed]] = [[] for _ in tree.first]
    for front in np.flatnonzero(high > low).tolist():
        gathered = _gathered(tree, front, passed[front], (low[front], high[front]), d)
        passed[front].clear()
        own = np.arange(middle[front], high[front])
        blocks = gathered.reshape(-1, d, high[front] - low[front], d)
        blocks[wanted[own] - tree.first[front], :, own - low[front]] = right[own]
        with registry.blas.many(gathered.shape[1] > LARGE_COLUMNS):
            solved, update = _eliminate(factor, front, gathered)
            yield _Solved(front, int(low[front]), int(high[front]), solved)
        if tree.parent[front] >= 0:
            passed[tree.parent[front]].append(_Passed(front, low[front], update))


def _subtree_starts(tree: FrontTree) -> Int[np.ndarray, " s"]:
    """First position of each front's subtree; it ends with the front's own pivots."""
    start = tree.first.copy()
    for front, parent in enumerate(tree.parent.tolist()):
        if parent >= 0:
            start[parent] = min(start[parent], start[front])
    return start


def _gathered(
    tree: FrontTree, front: int, passed: list[_Passed], columns: tuple[int, int], d: int
) -> Float[np.ndarray, "(p+r)*d columns*d"]:
    """Right-hand sides at a front's poses: what its children pass on."""
    pivots, rests = tree.pivots[front], tree.rests[front]
    low, high = columns
    right = np.zeros((pivots + rests, d, (high - low) * d))
    for child, first_column, update in passed:
        positions = tree.rest[tree.rest_start[child] : tree.rest_start[child + 1]]
        rows = tree.locate(np.full(len(positions), front), positions, tree.pivots)
        start = (first_column - low) * d
        right[rows, :, start : start + update.shape[1]] += update.reshape(len(rows), d, -1)
    return right.reshape((pivots + rests) * d, -1)


def _eliminate(
    factor: CholeskyFactor, front: int, right: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """W and U of one front."""
    inverse, coupling = _front_of(factor, front)
    pivots = len(inverse)
    solved = inverse @ right[:pivots]
    return solved, right[pivots:] - coupling @ solved


def _front_of(factor: CholeskyFactor, front: int) -> tuple[np.ndarray, np.ndarray]:
    """L⁻¹ and X of one front, without padding."""
    plan, tree, d = factor.plan, factor.plan.tree, factor.plan.block_dim
    group, slot = plan.group_of[front], plan.slot_of[front]
    pivots = tree.pivots[front] * d
    rests = (tree.rest_start[front + 1] - tree.rest_start[front]) * d
    inverse = factor.inverse_pivots[group][slot, :pivots, :pivots]
    return inverse, factor.couplings[group][slot, :rests, :pivots]
