"""q² of all pairs: against the definition, a naive oracle, and what must not change it."""

import dataclasses

import consistency_worlds as worlds
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.consistency import consistency_problem, squared_mahalanobis, squared_rows
from pcm_jax.errors import InputError

GROUPS = [jaxlie.SE2, jaxlie.SE3]
COUNT = 20


@pytest.fixture(scope="module", params=GROUPS, ids=lambda group: group.__name__)
def world(request):
    return worlds.random_world(request.param, seed=1, count=COUNT)


@pytest.fixture(scope="module")
def problem(world):
    return consistency_problem(*world, marginals=worlds.marginals_of(*world))


@pytest.fixture(scope="module")
def squared(problem):
    return np.asarray(squared_mahalanobis(problem))


def assert_same(found, expected, tolerance):
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.slow
def test_closed_form_is_the_definition(problem, squared):
    definition = squared_mahalanobis(problem, kernel="jacfwd")
    assert squared.shape == (COUNT, COUNT)
    off_diagonal = ~np.eye(COUNT, dtype=bool)
    assert squared[off_diagonal].min() > 1e-3  # relative errors mean something
    np.testing.assert_allclose(squared, definition, rtol=1e-10)
    np.testing.assert_array_equal(np.diagonal(squared), 0.0)


def test_the_two_directions_differ_and_poses_are_shared(world, squared):
    """What the comparison above would miss if the world were too simple."""
    assert np.abs(squared - squared.T).max() > 1e-2
    pose_a, pose_b = np.asarray(world[2].pose_a), np.asarray(world[2].pose_b)
    same_a, same_b = (p[:, None] == p[None, :] for p in (pose_a, pose_b))
    assert (same_a & ~same_b).any()
    assert (same_b & ~same_a).any()


def test_naive_oracle(world, squared):
    pairs = [(0, 1), (1, 0), (3, 17), (17, 3)]
    pose_a, pose_b = np.asarray(world[2].pose_a), np.asarray(world[2].pose_b)
    for poses in (pose_a, pose_b):
        shared = np.argwhere(np.triu(poses[:, None] == poses[None, :], 1))
        pairs.append(tuple(shared[0]))
    for u, v in pairs:
        assert_same(squared[u, v], worlds.naive_squared(*world, u, v), 1e-10)


def test_default_marginals(world, squared):
    assert_same(squared_mahalanobis(consistency_problem(*world)), squared, 1e-8)


def test_closures_of_one_and_the_same_pair_of_poses():
    """G = 0 in both maps: only the measurements' own noise is left."""
    map_a, map_b, closures = worlds.random_world(jaxlie.SE3, seed=2)
    closures = closures[np.array([4] * 3)]
    noise = np.linalg.inv(np.asarray(closures.information))[0]
    step = 0.1 * np.random.default_rng(0).normal(size=(3, 6))
    measurement = lie.compose(lie.as_numpy(closures.measurement), lie.exp(jaxlie.SE3, step))
    closures = dataclasses.replace(closures, measurement=lie.as_device(measurement))
    squared = squared_mahalanobis(consistency_problem(map_a, map_b, closures))
    error = lie.log(lie.between(lie.take(measurement, 0), lie.take(measurement, 1)))
    # ε = Log(z_u⁻¹ z_v): with Jl and Jr of ε the noises of u and v reach it.
    to_v = lie.right_jacobian_inverse(jaxlie.SE3, error)
    to_u = lie.right_jacobian_inverse(jaxlie.SE3, -error)
    total = to_v @ noise @ to_v.T + to_u @ noise @ to_u.T
    assert_same(squared[0, 1], error @ np.linalg.solve(total, error), 1e-10)


def test_the_gauge_does_not_matter(world, squared):
    other = worlds.marginals_of(*world, fixed=(5, 8))
    assert not np.allclose(other[0], worlds.marginals_of(*world)[0], rtol=0.1)
    assert_same(squared_mahalanobis(consistency_problem(*world, marginals=other)), squared, 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("distance", "tolerance"), [(1.0, 1e-10), (1e5, 1e-7)])
def test_the_maps_frames_do_not_matter(world, squared, distance, tolerance):
    """Each map moved and turned on its own; at 100 km the poses themselves keep 1e-11 m."""
    map_a, map_b, closures = world
    rng = np.random.default_rng(3)
    d = closures.tangent_dim
    motions = lie.exp(
        closures.group, rng.normal(size=(2, d)) * np.where(np.arange(d) < 2, distance, 1)
    )
    moved = (worlds.moved_map(g, lie.take(motions, k)) for k, g in enumerate((map_a, map_b)))
    problem = consistency_problem(*moved, closures, marginals=worlds.marginals_of(*world))
    assert_same(squared_mahalanobis(problem), squared, tolerance)
    assert_same(squared_mahalanobis(problem, kernel="jacfwd"), squared, tolerance)


@pytest.mark.parametrize("count", [1, 7, 16])
def test_padding_changes_nothing(world, problem, squared, count):
    part = consistency_problem(
        *world[:2], world[2][:count], marginals=worlds.marginals_of(*world[:2], world[2][:count])
    )
    assert jax.tree.map(jnp.shape, part) == jax.tree.map(jnp.shape, problem)  # one compilation
    assert_same(squared_mahalanobis(part), squared[:count, :count], 1e-11)


def test_no_closures_at_all(world):
    problem = consistency_problem(*world[:2], world[2][:0])
    assert squared_mahalanobis(problem).shape == (0, 0)


def several_tiles(world):
    """More closures than a tile holds, and not a multiple of it."""
    map_a, map_b, closures = world
    return worlds.random_closures(closures.group, np.random.default_rng(4), map_a, map_b, 150)


@pytest.mark.slow
def test_several_tiles(world):
    closures = several_tiles(world)
    found = np.asarray(squared_mahalanobis(consistency_problem(*world[:2], closures)))
    for u, v in [(0, 149), (149, 0), (70, 60), (149, 148)]:
        assert_same(found[u, v], worlds.naive_squared(*world[:2], closures, u, v), 1e-9)


def test_a_problem_of_any_size():
    """Cut by hand to a number of closures that tiles do not divide."""
    world = worlds.random_world(jaxlie.SE2, seed=1)
    problem = consistency_problem(*world[:2], several_tiles(world))
    fields = (
        "measurement",
        "measurement_covariance",
        "pose_a",
        "pose_b",
        "row_a",
        "row_b",
        "valid",
    )
    cut = {name: jax.tree.map(lambda leaf: leaf[:149], getattr(problem, name)) for name in fields}
    found = squared_mahalanobis(dataclasses.replace(problem, **cut))
    assert_same(found, np.asarray(squared_mahalanobis(problem))[:149, :149], 1e-11)


@pytest.mark.slow
def test_inside_jit_padding_is_infinite(problem, squared):
    padded = np.asarray(jax.jit(squared_mahalanobis)(problem))
    assert_same(padded[:COUNT, :COUNT], squared, 1e-12)
    rest = padded.copy()
    rest[:COUNT, :COUNT] = np.inf
    np.testing.assert_array_equal(np.diagonal(padded), 0.0)
    np.fill_diagonal(rest, np.inf)
    assert np.isposinf(rest).all()


@pytest.mark.slow
def test_vmap_over_robot_pairs(world):
    map_a, map_b, closures = world
    rng = np.random.default_rng(5)
    sets = [
        worlds.random_closures(closures.group, rng, map_a, map_b, count) for count in (9, 15, 12)
    ]
    problems = [consistency_problem(map_a, map_b, each) for each in sets]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems)
    found = jax.vmap(squared_mahalanobis)(stacked)
    for row, (each, one) in enumerate(zip(sets, problems, strict=True)):
        n = len(each)
        assert_same(found[row, :n, :n], squared_mahalanobis(one), 1e-11)


@pytest.mark.slow
def test_gradients_where_only_some_inputs_are_traced():
    """`valid` is concrete then, so the padding is cut and cannot make the sum infinite."""
    problem = consistency_problem(*worlds.random_world(jaxlie.SE2, seed=9))
    squared = np.asarray(squared_mahalanobis(problem))
    total = lambda packed: jnp.sum(  # noqa: E731
        squared_mahalanobis(dataclasses.replace(problem, relative_covariance_a=packed))
    )
    value, gradient = jax.value_and_grad(total)(problem.relative_covariance_a)
    np.testing.assert_allclose(value, squared.sum(), rtol=1e-12)
    assert np.isfinite(gradient).all()


def test_float32_follows_its_input(problem, squared):
    single = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == float else x, problem)
    found = squared_mahalanobis(single)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, squared, rtol=2e-3, atol=1e-3)


def test_kernel_names(problem):
    with pytest.raises(InputError, match="kernel: 'fast'; expected one of 'closed-form', 'jacfwd'"):
        squared_mahalanobis(problem, kernel="fast")


@pytest.mark.slow
def test_rows_are_what_new_closures_add(world):
    problem = consistency_problem(*world)
    squared = np.asarray(squared_mahalanobis(problem))
    rows = np.array([2, 0, len(squared) - 1])
    forward, backward = squared_rows(problem, rows)
    np.testing.assert_allclose(forward, squared[rows], rtol=1e-12)
    np.testing.assert_allclose(backward, squared[:, rows].T, rtol=1e-12)
