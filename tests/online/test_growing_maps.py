"""Maps at their optimum after loops, one after another: as `optimize` finds them from nothing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from online_worlds import without_closures

from pcm_jax import lie
from pcm_jax.errors import ConvergenceWarning
from pcm_jax.mapping import covariance, optimize
from pcm_jax.mapping.covariance import LOOPS_SINCE
from pcm_jax.mapping.optimization import problem_of
from pcm_jax.online import IncrementalPcm, _maps
from pcm_jax.simulation import simulate_city, simulate_sessions


@pytest.fixture(params=["SE2", "SE3"])
def online(request):
    make = simulate_city if request.param == "SE2" else simulate_sessions
    kind = {"robots": 2} if request.param == "SE2" else {"sessions": 2}
    return IncrementalPcm(without_closures(make(seed=5, poses=60, **kind).graph))


def loop(online: IncrementalPcm, pose: int, *, error: float, seed: int) -> dict:
    """A loop from the end of robot 0's map to a pose, away from where the map has it."""
    one = online._state.covariances[0].pose_graph
    last, d = one.num_poses - 1, one.tangent_dim
    start, end = (lie.take(lie.as_numpy(one.poses), np.array([at])) for at in (last, pose))
    noise = lie.exp(one.group, error * np.random.default_rng(seed).normal(size=(1, d)))
    return {
        "tail": [last],
        "head": [pose],
        "measurement": lie.compose(lie.between(start, end), noise),
        "information": np.asarray(one.information)[:1],
    }


def whole(monkeypatch):
    """The maps that were optimised until `optimize` stopped."""
    asked, real = [], _maps.optimized_maps
    monkeypatch.setattr(
        _maps,
        "optimized_maps",
        lambda maps, *args, **kw: (asked.append(maps), real(maps, *args, **kw))[1],
    )
    return asked


def assert_at_optimum(online: IncrementalPcm) -> None:
    found = online._state.covariances[0].pose_graph
    # From the chordal start alone a city's loops can end in another optimum.
    best = optimize(found, initial="given")
    assert best.initial_cost - best.cost <= 1e-9 * best.cost + 1e-12
    assert best.initial_cost == pytest.approx(optimize(found).cost, rel=1e-8, abs=1e-12)
    apart = lie.log(lie.between(lie.as_numpy(found.poses), lie.as_numpy(best.graph.poses)))
    np.testing.assert_allclose(np.asarray(apart), 0.0, atol=1e-4)


def test_small_loops_take_one_step(online, monkeypatch):
    """But for a map without any residuals before: of a cost of zero every change is large."""
    asked = whole(monkeypatch)
    one = online.graph.maps[0]
    step = {
        "measurement": lie.take(lie.as_numpy(one.measurement), np.array([0])),
        "information": np.asarray(one.information)[:1],
    }
    for number in range(8):
        online.extend(0, **loop(online, 3 * number, error=0.01, seed=number))
        assert_at_optimum(online)
        online.extend(0, **step)
    assert asked == [] or one.num_edges == one.num_poses - 1


def test_loops_that_follow_each_other_share_a_factor(online, monkeypatch):
    made, factorize = [], covariance.covariance_factor
    monkeypatch.setattr(
        covariance, "covariance_factor", lambda graph: (made.append(graph), factorize(graph))[1]
    )
    for number in range(LOOPS_SINCE):
        online.extend(0, **loop(online, 3 * number, error=0.01, seed=number))
    assert len(made) == 1


def test_large_ones_take_what_optimize_does(online, monkeypatch):
    """From where the first steps led, if that is nearer."""
    asked = whole(monkeypatch)
    before = online._state.covariances[0].pose_graph
    online.extend(0, **loop(online, 2, error=0.5, seed=1))
    (start,) = asked[0]
    assert len(asked) == 1
    problem = problem_of(start)
    assert problem.cost(start.poses) < problem.cost(before.poses)
    assert_at_optimum(online)


@pytest.mark.parametrize(("tighter", "error"), [(1e3, 0.1), (1e4, 0.3), (1e9, 0.3)])
def test_loops_that_turn_the_map_reach_the_optimum(online, tighter, error):
    """A loop far tighter than the odometry: the first step's fall says nothing of what is left."""
    one = loop(online, 30, error=error, seed=3)
    online.extend(0, **one | {"information": one["information"] * tighter})
    found = online._state.covariances[0].pose_graph
    best = optimize(found, initial="given")
    for _ in range(3):
        best = optimize(best.graph, initial="given")
    assert optimize(found, initial="given").initial_cost <= best.cost * (1.0 + 1e-8)


def test_odometry_in_another_order_is_no_loop(online):
    one = online.graph.maps[0]
    steps = lie.take(lie.as_numpy(one.measurement), np.array([0, 1]))
    online.extend(
        0, tail=[60, 59], head=[61, 60], measurement=steps, information=one.information[:2]
    )
    assert online.graph.maps[0].num_poses == 62
    assert_at_optimum(online)


def test_many_loops_at_once_are_solved_whole(online, monkeypatch):
    asked = whole(monkeypatch)
    loops = [loop(online, pose, error=0.01, seed=pose) for pose in range(LOOPS_SINCE + 1)]
    online.extend(
        0,
        tail=np.concatenate([one["tail"] for one in loops]),
        head=np.concatenate([one["head"] for one in loops]),
        measurement=lie.concatenate([one["measurement"] for one in loops]),
        information=np.concatenate([one["information"] for one in loops]),
    )
    assert len(asked) == 1
    assert_at_optimum(online)


def test_the_first_pose_stays(online):
    before = np.array(lie.parameters(online._state.covariances[0].pose_graph.poses))[0]
    online.extend(0, **loop(online, 7, error=0.01, seed=1))
    after = np.array(lie.parameters(online._state.covariances[0].pose_graph.poses))[0]
    np.testing.assert_array_equal(after, before)


def test_a_singular_map_grows_with_a_warning(online):
    """A map that hangs together by next to nothing, 1e-30 + 1 − 1, has no optimum to start from."""
    one = online.graph.maps[0].with_edges(np.arange(59))
    information = np.array(one.information)
    information[0] *= 1e-30
    weak = dataclasses.replace(one, information=information)
    closing = loop(online, 0, error=0.01, seed=0)
    with pytest.warns(ConvergenceWarning):
        online.replace_maps((weak, online.graph.maps[1]))
    with pytest.warns(ConvergenceWarning):
        online.extend(0, **closing)
    assert online.graph.maps[0].num_edges == 60
