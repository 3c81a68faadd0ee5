"""Transformations that functions go through: run, not claimed, and in the package's docstring."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

import pcm_jax
from pcm_jax import lie
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph

pytestmark = pytest.mark.slow


YES, CONSTANT = "yes", "–"


class Case(NamedTuple):
    """A function of one array, and two arrays to run it on."""

    run: Callable[[Any], Any]
    at: Any
    other: Any


def small_graph():
    """Two straight maps and three closures."""
    rng = np.random.default_rng(0)
    path = lie.exp(jaxlie.SE2, np.arange(5.0)[:, None] * np.array([1.0, 0.0, 0.2]))
    own = PoseGraph.from_trajectory(path, sigma_translation=0.1, sigma_rotation=0.05)
    ends = np.array([[0, 2, 4], [1, 0, 3]])
    exact = lie.between(*(lie.take(path, rows) for rows in ends))
    error = lie.exp(jaxlie.SE2, 0.05 * rng.normal(size=(3, 3)))
    closures = LoopClosures.from_arrays(
        robot_a=[0] * 3,
        pose_a=ends[0],
        robot_b=[1] * 3,
        pose_b=ends[1],
        measurement=lie.compose(exact, error),
        covariance=np.tile(0.01 * np.eye(3), (3, 1, 1)),
    )
    return MultiRobotGraph((own, own), closures)


def cases():
    rng = np.random.default_rng(1)
    graph = small_graph()
    problem = pcm_jax.consistency_problem(*graph.maps, graph.closures)
    covariance = problem.measurement_covariance
    near = np.triu(rng.random((12, 12)) < 0.3, 1)
    near[np.ix_(range(5), range(5))] = True
    squared = np.where(near | near.T, rng.chisquare(3, (12, 12)), 40.0)
    truth = lie.concatenate([one.poses for one in graph.maps])

    def distances(covariance):
        moved = dataclasses.replace(problem, measurement_covariance=covariance)
        return pcm_jax.squared_mahalanobis(moved)

    def error(step):
        return pcm_jax.ate_rmse(
            lie.compose(truth, lie.exp(jaxlie.SE2, step)), truth, align="umeyama"
        )

    def clique(squared):
        return pcm_jax.maximum_clique_batched(squared < gate).members

    def selected(squared):
        return pcm_jax.select_batched(squared, gate, method="pcm-heuristic")

    def merged(weights):
        poses = pcm_jax.merge_differentiable(graph, weights)
        return lie.parameters(lie.concatenate(poses))

    def of_pairs(measurements):
        variances = jnp.full((5, 1, 1), 0.3)
        return pcm_jax.squared_mahalanobis_of(lambda a, b: a - b, measurements, variances)

    gate = float(pcm_jax.chi2_gate(0.99, 3))
    pair = (jnp.asarray(squared), jnp.asarray(squared[::-1, ::-1]))
    steps = jnp.asarray(0.1 * rng.normal(size=(2, 10, 3)))
    return {
        "squared_mahalanobis": Case(distances, covariance, 1.5 * covariance),
        "squared_mahalanobis_of": Case(of_pairs, *jnp.asarray(rng.normal(size=(2, 5, 1)))),
        "chi2_gate": Case(lambda p: pcm_jax.chi2_gate(p, 3), jnp.asarray(0.99), jnp.asarray(0.5)),
        "consistency_graph": Case(lambda q: pcm_jax.consistency_graph(q, gate), *pair),
        "maximum_clique_batched": Case(clique, *pair),
        "select_batched": Case(selected, *pair),
        "soft_select": Case(lambda q: pcm_jax.soft_select(q, gate, temperature=1.0), *pair),
        "merge_differentiable": Case(
            merged, jnp.asarray([1.0, 0.5, 0.2]), jnp.asarray([0.3, 0.9, 0.0])
        ),
        "true_positive_rate": Case(
            lambda q: pcm_jax.true_positive_rate(q[0] < gate, np.arange(12) < 5), *pair
        ),
        "ate_rmse": Case(error, *steps),
    }


def check_batches(case):
    """One compiled program for both inputs gives what each gives by itself."""
    found = jax.jit(jax.vmap(case.run))(jnp.stack([case.at, case.other]))
    for row, x in enumerate((case.at, case.other)):
        expected = np.asarray(case.run(x))
        kept = found[row][tuple(slice(size) for size in expected.shape)]  # of padded results
        np.testing.assert_allclose(kept, expected, rtol=1e-9, atol=1e-12)
    return found.dtype


def is_constant(case):
    """Whether nothing changes with the input; if not, checks both derivatives by differences."""
    rng = np.random.default_rng(2)
    shape = jax.eval_shape(case.run, case.at).shape
    pull, along = jnp.asarray(rng.normal(size=shape)), jnp.asarray(rng.normal(size=case.at.shape))
    along = 0.01 * along * jnp.max(jnp.abs(case.at))

    @jax.jit
    def run(x):
        def value(x):
            result = case.run(x)
            return jnp.sum(jnp.where(jnp.isfinite(result), pull * result, 0.0))

        result, forward = jax.linearize(value, x)
        return result, forward(along), jax.linear_transpose(forward, x)(jnp.ones(()))[0]

    _, forward, gradient = run(case.at)
    if not np.any(gradient):
        return True
    h = 1e-3
    difference = (run(case.at + h * along)[0] - run(case.at - h * along)[0]) / (2 * h)
    np.testing.assert_allclose(jnp.vdot(gradient, along), forward, rtol=1e-9)
    np.testing.assert_allclose(forward, difference, rtol=1e-4)
    return False


@pytest.fixture(scope="module")
def found():
    """{function: (jit and vmap, grad and jvp)}."""
    marks = {}
    for name, case in cases().items():
        dtype = check_batches(case)
        marks[name] = CONSTANT if dtype.kind == "b" or is_constant(case) else YES
    return marks


def test_what_has_derivatives(found):
    constant = {name for name, mark in found.items() if mark == CONSTANT}
    discrete = {"consistency_graph", "maximum_clique_batched", "select_batched"}
    assert constant == discrete | {"true_positive_rate"}


def test_the_packages_table(found):
    lines = ["| function | `jit` | `vmap` | `grad` | `jvp` |", "|---|---|---|---|---|"]
    for name, mark in found.items():
        lines.append(f"| `{name}` | {YES} | {YES} | {mark} | {mark} |")
    assert "\n\n" + "\n".join(lines) + "\n" in pcm_jax.__doc__
    assert all(hasattr(pcm_jax, name) for name in found)
