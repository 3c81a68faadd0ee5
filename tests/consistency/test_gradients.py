"""Derivatives of q² by each of its inputs, in both modes; batches, padding, bad samples."""

import dataclasses

import consistency_worlds as worlds
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.consistency import consistency_graph, consistency_problem, squared_mahalanobis
from pcm_jax.lie import unrolled

pytestmark = pytest.mark.slow


COUNT = 20
LIE = ("measurement", "pose_a", "pose_b")
COVARIANCES = ("measurement_covariance", "relative_covariance_a", "relative_covariance_b")
INPUTS = (*LIE, *COVARIANCES)


def moved_problem(problem, step):
    """Lie fields moved on the right, covariances additively."""
    changes = {}
    for name, delta in step.items():
        value = getattr(problem, name)
        group = lie.group_of(value) if name in LIE else None
        changes[name] = (
            value + delta if group is None else lie.compose(value, lie.exp(group, delta))
        )
    return dataclasses.replace(problem, **changes)


def still(problem):
    d = problem.measurement_covariance.shape[-1]
    rows = {name: jnp.zeros((len(problem.valid), d)) for name in LIE}
    return rows | {name: jnp.zeros(getattr(problem, name).shape) for name in COVARIANCES}


def direction_in(problem, name, seed=6):
    """A random direction; covariances move by a few per cent of themselves."""
    leaf = still(problem)[name]
    along = np.random.default_rng(seed).normal(size=leaf.shape)
    if name in COVARIANCES:
        along *= 0.02 * float(np.abs(getattr(problem, name)).max())
    if name == "measurement_covariance":
        along += along.swapaxes(-1, -2)
    return still(problem) | {name: jnp.asarray(along)}


@jax.jit
def both_modes(problem, weights, step, direction):
    """A weighted sum of q², its derivative along a direction, and its gradient."""

    def value(step):
        squared = squared_mahalanobis(moved_problem(problem, step))
        return jnp.sum(jnp.where(weights > 0.0, weights * squared, 0.0))

    at, forward = jax.linearize(value, step)
    (gradient,) = jax.linear_transpose(forward, step)(jnp.ones(()))
    return at, forward(direction), gradient


def exact_world(group):
    """Closures between maps whose closures are exact; between some, no rotation either."""
    map_a, map_b, closures = worlds.random_world(group, seed=1, count=COUNT)
    straight = lie.exp(group, np.random.default_rng(0).normal(size=(9, closures.tangent_dim)))
    space = lie.module_of(group).MATRIX_DIM - 1
    values = np.array(lie.parameters(straight))
    values[4:, :-space] = lie.parameters(lie.identity(group))[:-space]  # translations only
    maps = tuple(one.with_poses(lie.as_device(group(values))) for one in (map_a, map_b))
    ends = zip(maps, (closures.pose_a, closures.pose_b), strict=True)
    a, b = (lie.take(lie.as_numpy(one.poses), np.asarray(rows)) for one, rows in ends)
    exact = dataclasses.replace(closures, measurement=lie.as_device(lie.between(a, b)))
    return *maps, exact


@pytest.fixture(scope="module", params=[jaxlie.SE2, jaxlie.SE3], ids=["SE2", "SE3"])
def case(request):
    """A problem, and weights that leave padding and the diagonal out."""
    world = worlds.random_world(request.param, seed=1, count=COUNT)
    problem = consistency_problem(*world, marginals=worlds.marginals_of(*world))
    size = len(problem.valid)
    weights = np.zeros((size, size))
    weights[:COUNT, :COUNT] = np.random.default_rng(5).uniform(0.1, 1.0, (COUNT, COUNT))
    np.fill_diagonal(weights, 0.0)
    return problem, jnp.asarray(weights)


@pytest.mark.parametrize("name", INPUTS)
def test_derivatives_are_those_of_differences(case, name):
    problem, weights = case
    at, direction = still(problem), direction_in(problem, name)
    _, forward, gradient = both_modes(problem, weights, at, direction)
    reverse = float(jnp.vdot(gradient[name], direction[name]))

    def slope(h):
        ahead, behind = (
            both_modes(problem, weights, {k: t * v for k, v in direction.items()}, at)[0]
            for t in (h, -h)
        )
        return float(ahead - behind) / (2 * h)

    h = 1e-3
    assert abs(reverse) > 1e-3
    np.testing.assert_allclose(forward, reverse, rtol=1e-10)
    np.testing.assert_allclose(reverse, (4.0 * slope(h / 2) - slope(h)) / 3.0, rtol=1e-6)


def everywhere(problem):
    """A random direction in every input at once."""
    rng = np.random.default_rng(6)
    direction = {}
    for name, leaf in still(problem).items():
        along = rng.normal(size=leaf.shape)
        if name == "measurement_covariance":
            along += along.swapaxes(-1, -2)
        direction[name] = jnp.asarray(1e-3 * along if name in COVARIANCES else along)
    return direction


def by_gradient_and_difference(problem, weights, h):
    """The derivative along that direction, two ways."""
    at, direction = still(problem), everywhere(problem)
    _, _, gradient = both_modes(problem, weights, at, direction)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    ahead, behind = (
        both_modes(problem, weights, {k: t * v for k, v in direction.items()}, at)[0]
        for t in (h, -h)
    )
    slope = sum(float(jnp.vdot(gradient[name], direction[name])) for name in direction)
    return slope, float(ahead - behind) / (2 * h)


def test_every_input_at_once(case):
    problem, weights = case
    slope, difference = by_gradient_and_difference(problem, weights, 1e-5)
    assert abs(slope) > 1e-3
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


def test_at_zero_error_and_zero_rotation(case):
    """q² has its minimum, zero: every derivative is zero, and finite."""
    problem, weights = case
    exact = consistency_problem(*exact_world(lie.group_of(problem.measurement)))
    assert jax.tree.map(jnp.shape, exact) == jax.tree.map(jnp.shape, problem)  # one compilation
    along = direction_in(exact, "measurement")
    value, forward, gradient = both_modes(exact, weights, still(exact), along)
    assert value < 1e-20
    np.testing.assert_allclose(forward, 0.0, atol=1e-8)
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_allclose(leaf, 0.0, atol=1e-8)
    slope, difference = by_gradient_and_difference(exact, weights, 1e-6)
    np.testing.assert_allclose(slope, 0.0, atol=1e-9)
    np.testing.assert_allclose(difference, 0.0, atol=1e-6)


def test_at_zero_error_and_any_rotation(case):
    problem, weights = case
    world = worlds.random_world(lie.group_of(problem.measurement), seed=1, count=COUNT)
    map_a, map_b, closures = world
    ends = [
        lie.take(lie.as_numpy(graph.poses), np.asarray(rows))
        for graph, rows in ((map_a, closures.pose_a), (map_b, closures.pose_b))
    ]
    exact = dataclasses.replace(closures, measurement=lie.as_device(lie.between(*ends)))
    exact = consistency_problem(map_a, map_b, exact, marginals=worlds.marginals_of(*world))
    assert np.asarray(squared_mahalanobis(exact)).max() < 1e-20
    slope, difference = by_gradient_and_difference(exact, weights, 1e-6)
    np.testing.assert_allclose(slope, 0.0, atol=1e-9)
    np.testing.assert_allclose(difference, 0.0, atol=1e-6)


def test_padding_changes_nothing(case):
    """Whatever stands in it, bit for bit, derivatives included."""
    problem, weights = case
    along = direction_in(problem, "pose_a")
    expected = both_modes(problem, weights, still(problem), along)

    def filled(name, filling):
        values = getattr(problem, name)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf).at[COUNT:].set(filling), values)

    rows = {name: filled(name, 1e3) for name in LIE}
    rows["measurement_covariance"] = filled("measurement_covariance", np.nan)
    found = both_modes(dataclasses.replace(problem, **rows), weights, still(problem), along)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("kernel", ["closed-form", "jacfwd"])
def test_one_bad_sample_in_a_stack(kernel):
    """Flagged by NaN where it is bad; everything else stays the same bit for bit."""
    world = worlds.random_world(jaxlie.SE2, seed=1, count=COUNT)
    one = consistency_problem(*world, marginals=worlds.marginals_of(*world))
    problem = jax.tree.map(lambda leaf: jnp.stack([leaf] * 4), one)
    covariance = np.array(problem.measurement_covariance)
    covariance[1, 2] = np.diag([1.0, 1.0, -5.0])
    covariance[2] = np.nan
    moved = np.array(lie.parameters(problem.measurement))
    moved[3, 4, 0] = np.inf
    bad = dataclasses.replace(
        problem,
        measurement=jaxlie.SE2(jnp.asarray(moved)),
        measurement_covariance=jnp.asarray(covariance),
    )
    run = jax.jit(jax.vmap(lambda problem: squared_mahalanobis(problem, kernel=kernel)))
    expected, found = np.array(run(problem)), np.asarray(run(bad))
    off_diagonal = ~np.eye(COUNT, dtype=bool)
    for sample, closures in ((1, [2]), (2, range(COUNT)), (3, [4])):
        for u in closures:
            expected[sample, u, :COUNT] = expected[sample, :COUNT, u] = np.nan
        np.fill_diagonal(expected[sample], 0.0)
    np.testing.assert_array_equal(found, expected)
    graph = consistency_graph(found[:, :COUNT, :COUNT], np.inf)
    np.testing.assert_array_equal(graph[0], off_diagonal)
    assert not graph[1, 2].any()
    assert not graph[2].any()


def test_nothing_flows_from_a_bad_sample():
    """A loss that leaves NaN out has the other samples' gradient, and zero for the bad one's."""
    world = worlds.random_world(jaxlie.SE2, seed=1, count=COUNT)
    problem = consistency_problem(*world, marginals=worlds.marginals_of(*world))
    given = np.stack([np.asarray(problem.measurement_covariance)] * 3)
    given[1, 2], given[2, 3] = np.diag([1.0, 1.0, -5.0]), np.nan

    def loss(covariance):
        squared = squared_mahalanobis(
            dataclasses.replace(problem, measurement_covariance=covariance)
        )
        return jnp.sum(jnp.where(jnp.isfinite(squared), squared, 0.0))

    gradient = np.asarray(jax.jit(jax.vmap(jax.grad(loss)))(given))
    assert np.isfinite(gradient).all()
    assert np.abs(gradient[0, 2]).max() > 1e-3
    np.testing.assert_array_equal(gradient[1, 2], 0.0)
    np.testing.assert_array_equal(gradient[2, 3], 0.0)


def test_a_form_that_is_not_positive_definite_is_nan():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(40, 3, 3))
    symmetric = root + root.swapaxes(1, 2) + 2.5 * np.eye(3)
    definite = np.linalg.eigvalsh(symmetric).min(axis=1) > 0.0
    assert 0 < definite.sum() < 40
    vector = tuple(rng.normal(size=(3, 40)))
    found = unrolled.inverse_quadratic_form(unrolled.from_array(symmetric), vector)
    np.testing.assert_array_equal(np.isnan(found), ~definite)
