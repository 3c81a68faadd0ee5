"""Gauss-Newton in NumPy against the compiled one: the same steps, the same optimum."""

import dataclasses

import numpy as np
import pytest

from pcm_jax import lie, optimize
from pcm_jax.compiling import ALWAYS
from pcm_jax.mapping import least_squares
from pcm_jax.simulation import simulate_city, simulate_sessions

SIMULATE = {"SE2": simulate_city, "SE3": simulate_sessions}


@pytest.fixture(params=["SE2", "SE3"])
def pose_graph(request):
    world = SIMULATE[request.param](seed=1, poses=60, inliers=1, aliased_groups=0, random=0)
    return world.graph.maps[0]


def both(pose_graph, monkeypatch, **options):
    """The solution in NumPy, and the compiled one."""
    monkeypatch.setattr(least_squares, "_thrift", least_squares.Thrift(1e9))
    in_numpy = optimize(pose_graph, **options)
    monkeypatch.setenv(ALWAYS, "always")
    return in_numpy, optimize(pose_graph, **options)


@pytest.mark.parametrize("initial", ["chordal", "spanning-tree"])
def test_the_same_optimum_in_as_many_steps(pose_graph, initial, monkeypatch):
    ours, compiled = both(pose_graph, monkeypatch, initial=initial)
    assert ours.converged and compiled.converged
    assert ours.iterations == compiled.iterations
    assert ours.initial_cost == pytest.approx(compiled.initial_cost, rel=1e-12)
    assert ours.cost == pytest.approx(compiled.cost, rel=1e-12)
    found, expected = (lie.parameters(lie.as_numpy(s.graph.poses)) for s in (ours, compiled))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


def test_as_many_steps_as_are_allowed(pose_graph, monkeypatch):
    for most in (1, 2, 3):
        ours, compiled = both(pose_graph, monkeypatch, initial="spanning-tree", max_steps=most)
        assert (ours.converged, ours.iterations) == (compiled.converged, compiled.iterations)
        assert not ours.converged or most > 1
        assert ours.cost == pytest.approx(compiled.cost, rel=1e-12, abs=1e-12)
        monkeypatch.delenv(ALWAYS)


def test_a_start_without_a_cost_is_no_optimum(pose_graph, monkeypatch):
    values = np.array(lie.parameters(lie.as_numpy(pose_graph.poses)))
    values[5] = np.nan
    broken = dataclasses.replace(pose_graph, poses=pose_graph.group(values))
    ours, compiled = both(broken, monkeypatch, initial="given")
    assert not ours.converged and not compiled.converged


def test_a_process_that_solves_often_compiles(pose_graph, monkeypatch):
    thrift = least_squares.Thrift(
        2.5 * pose_graph.num_edges * least_squares.SECONDS_AN_EDGE[pose_graph.tangent_dim]
    )
    asked = []
    monkeypatch.setattr(least_squares, "_thrift", thrift)
    compiles = thrift.compiles
    monkeypatch.setattr(thrift, "compiles", lambda *a: asked.append(compiles(*a)) or asked[-1])
    for _ in range(4):
        optimize(pose_graph)
    assert asked == [False, False, True, True]
