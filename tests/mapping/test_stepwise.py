"""Least squares in NumPy against the compiled program: the same steps, the same optimum."""

import dataclasses

import numpy as np
import pytest

from pcm_jax import lie, optimize
from pcm_jax.compiling import ALWAYS
from pcm_jax.mapping import least_squares
from pcm_jax.mapping.optimization import problem_of
from pcm_jax.simulation import simulate_city, simulate_sessions

SIMULATE = {"SE2": simulate_city, "SE3": simulate_sessions}


@pytest.fixture(params=["SE2", "SE3"])
def pose_graph(request):
    world = SIMULATE[request.param](seed=1, poses=60, inliers=1, aliased_groups=0, random=0)
    return world.graph.maps[0]


def both(pose_graph, monkeypatch, **options):
    """The solution in NumPy, and the compiled one."""
    in_numpy = optimize(pose_graph, **options)
    monkeypatch.setenv(ALWAYS, "always")
    return in_numpy, optimize(pose_graph, **options)


@pytest.mark.parametrize("solver", least_squares.SOLVERS)
@pytest.mark.parametrize("initial", ["chordal", "spanning-tree"])
def test_the_same_optimum_in_as_many_steps(pose_graph, initial, solver, monkeypatch):
    ours, compiled = both(pose_graph, monkeypatch, initial=initial, solver=solver)
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


@pytest.mark.parametrize("most", [2, 12, 100])
def test_the_same_steps_are_refused(most, monkeypatch):
    """Loops whose measurements are another's: damping rises and falls several times."""
    world = simulate_city(seed=4, poses=60, inliers=1, aliased_groups=0, random=0)
    pose_graph = world.graph.maps[0]
    order = np.arange(pose_graph.num_edges)
    loops = np.flatnonzero(pose_graph.head - pose_graph.tail != 1)
    order[loops] = loops[::-1]
    wrong = dataclasses.replace(pose_graph, measurement=lie.take(pose_graph.measurement, order))
    how = {"initial": "given", "solver": "levenberg-marquardt", "max_steps": most}
    ours, compiled = both(wrong, monkeypatch, **how)
    assert (ours.converged, ours.iterations) == (compiled.converged, compiled.iterations)
    assert ours.cost == pytest.approx(compiled.cost, rel=1e-9)
    if most == 100:
        monkeypatch.delenv(ALWAYS)
        fewer = optimize(wrong, **how | {"max_steps": ours.iterations + 1})
        assert not fewer.converged and fewer.iterations < ours.iterations  # some were refused


def test_a_start_without_a_cost_is_no_optimum(pose_graph, monkeypatch):
    values = np.array(lie.parameters(lie.as_numpy(pose_graph.poses)))
    values[5] = np.nan
    broken = dataclasses.replace(pose_graph, poses=pose_graph.group(values))
    ours, compiled = both(broken, monkeypatch, initial="given")
    assert not ours.converged and not compiled.converged


@pytest.mark.slow
def test_equal_solves_give_equal_bits(pose_graph):
    first, *others = (
        lie.parameters(lie.as_numpy(optimize(pose_graph).graph.poses)) for _ in range(200)
    )
    assert all(np.array_equal(first, other) for other in others)


def test_large_problems_are_compiled_for(pose_graph, monkeypatch):
    edge = least_squares.SECONDS_AN_EDGE[pose_graph.tangent_dim]
    called = []
    monkeypatch.setattr(least_squares, "minimize", lambda *a, **k: called.append(a) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        optimize(pose_graph)
    most = (pose_graph.num_edges - 1) * edge
    monkeypatch.setattr("pcm_jax.compiling.SECONDS_TO_COMPILE", most)
    assert optimize(pose_graph).converged and len(called) == 1


def test_slices_of_edges_are_the_whole(pose_graph, monkeypatch):
    for solver in least_squares.SOLVERS:
        whole = optimize(pose_graph, solver=solver)
        with monkeypatch.context() as patched:
            patched.setattr("pcm_jax.mapping._stepwise.SLICE", 7)
            sliced = optimize(pose_graph, solver=solver)
        assert sliced.iterations == whole.iterations
        assert sliced.cost == pytest.approx(whole.cost, rel=1e-12)
        poses = (lie.parameters(lie.as_numpy(one.graph.poses)) for one in (sliced, whole))
        np.testing.assert_allclose(*poses, rtol=0, atol=1e-9)


def test_two_steps_with_one_factor(pose_graph):
    """The first is Gauss-Newton's; what the second is to gain, it gains, and is told."""
    near = optimize(pose_graph).graph
    moves = 1e-3 * np.random.default_rng(0).normal(size=(near.num_poses, near.tangent_dim))
    moves[0] = 0.0
    poses = lie.as_numpy(lie.compose(near.poses, lie.exp(near.group, moves)))
    problem = problem_of(near)
    found = problem.step_twice(poses)
    whole = problem.solve(poses, max_steps=2)
    assert found.cost == pytest.approx(whole.cost, rel=1e-9)
    assert found.cost == pytest.approx(problem.cost(found.halfway), rel=1e-12)
    best = problem.solve(poses, rtol=0.0, atol=1e-12, max_steps=20).cost
    left = found.cost - best
    assert left > 1e-12 and found.left == pytest.approx(left, rel=0.2, abs=1e-13)
    assert problem.cost(found.poses) - best < 0.1 * left
