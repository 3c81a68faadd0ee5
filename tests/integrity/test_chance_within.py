"""Chance inside one map: the level where no closure is right, and the power where some are."""

import numpy as np
import pytest
from scipy.stats import binom

from pcm_jax import lie
from pcm_jax.consistency import chi2_gate, odometry_edges, own_loops, within_problem
from pcm_jax.graph import PoseGraph
from pcm_jax.integrity import Places
from pcm_jax.integrity.within import (
    Loops,
    level_of_measurements,
    level_of_poses,
    squared_errors,
)
from pcm_jax.pipeline import select_within
from pcm_jax.simulation import simulate_city

GATE = float(chi2_gate(0.99, 3))
POSES = 120


@pytest.fixture(scope="module")
def city():
    return simulate_city(seed=3, poses=POSES).graph.maps[0]


def with_closures(city, true, false, seed, sure=1.0):
    """Odometry, some true closures and random false ones; odometry's sigmas `sure` times smaller.

    Returns the map, and which of its edges are right.
    """
    rng = np.random.default_rng(seed)
    odometry = odometry_edges(city)
    closures = np.setdiff1d(np.arange(city.num_edges), odometry)
    rows = np.concatenate([odometry, rng.choice(closures, true, replace=False)])
    ends = rng.choice(np.argwhere(np.triu(np.ones((POSES, POSES)), 10)), false).T
    wrong = lie.exp(city.group, rng.uniform(-1.0, 1.0, (false, 3)) * [4.0, 4.0, np.pi])
    information = np.array(city.information)
    information[odometry] *= sure**2
    graph = PoseGraph.from_arrays(
        poses=city.poses,
        tail=np.append(np.asarray(city.tail)[rows], ends[0]),
        head=np.append(np.asarray(city.head)[rows], ends[1]),
        measurement=lie.concatenate([lie.take(lie.as_numpy(city.measurement), rows), wrong]),
        information=np.concatenate([information[rows], np.tile(information[0], (false, 1, 1))]),
    )
    return graph, np.arange(graph.num_edges) < len(rows)


def loops_of(graph):
    problem = within_problem(graph)
    closures = np.setdiff1d(np.arange(graph.num_edges), odometry_edges(graph))
    ends = np.sort(np.stack([graph.tail, graph.head])[:, closures], axis=0)
    return Loops(graph, problem, Places(*ends.astype(float), 0.0), np.array([20.0, 20.0]))


def test_the_level_of_poses_is_a_binomial_tail(city):
    graph, _ = with_closures(city, 3, 12, seed=0)
    loops = loops_of(graph)
    accepted = np.arange(15) < 3
    found = level_of_poses(loops, GATE, accepted, factor=6.0, seed=0)
    rng = np.random.default_rng(7)
    n, shortest = graph.num_poses, int(np.abs(graph.tail - graph.head)[POSES - 1 :].min())
    drawn = np.array([(i, k) for i in range(n) for k in range(i + shortest, n)])
    drawn = rng.permutation(drawn)[:1500]
    z = POSES - 1 + rng.integers(0, 15, len(drawn))
    anywhere = PoseGraph.from_arrays(
        poses=graph.poses,
        tail=np.append(graph.tail[: POSES - 1], drawn[:, 0]),
        head=np.append(graph.head[: POSES - 1], drawn[:, 1]),
        measurement=lie.take(lie.as_numpy(graph.measurement), np.append(np.arange(POSES - 1), z)),
        information=graph.information[np.append(np.arange(POSES - 1), z)],
    )
    share = np.mean(squared_errors(own_loops(within_problem(anywhere)), 6.0) <= GATE)
    assert 0.01 < share < 0.5
    low, high = (binom.sf(2, 15, s * share) for s in (0.75, 1.3))
    assert low < found.p_value < high
    assert found.places == 3
    one = level_of_poses(loops, GATE, np.arange(15) < 1, factor=1.0, seed=0)
    assert one.p_value == 1.0


def test_no_right_closure_none_accepted(city):
    """Of worlds without a right closure at most the level accepts any, whatever odometry states."""
    accepting = 0
    for seed in range(30):
        for sure in (1.0, 5.0):
            graph, _ = with_closures(city, 0, 30, seed, sure)
            accepting += select_within(graph).accepted.any()
    assert accepting <= 2  # P(3 or more of 60) = 0.02 at 1 %


def test_a_p_value_is_seldom_small_where_none_is_right(city):
    ps = []
    for seed in range(40):
        graph, _ = with_closures(city, 0, 20, seed, sure=3.0)
        loops = loops_of(graph)
        agreeing = squared_errors(own_loops(loops.problem), 6.0) <= GATE
        asked = {"factor": 6.0, "significance": 0.05, "seed": seed}
        ps.append(level_of_measurements(loops, GATE, agreeing, **asked).p_value)
    assert np.mean(np.array(ps) <= 0.05) <= 0.15


def test_few_right_closures_are_found(city):
    for true in (3, 6):
        graph, right = with_closures(city, true, 20, seed=1)
        found = select_within(graph)
        assert found.kept[right].sum() >= POSES - 1 + true - 1
        assert not found.kept[~right].any()


def test_the_same_seed_gives_the_same_level(city):
    graph, _ = with_closures(city, 8, 20, seed=2, sure=4.0)
    loops, accepted = loops_of(graph), np.arange(28) < 8
    asked = {"factor": None, "significance": 0.02}
    one, same = (level_of_measurements(loops, GATE, accepted, seed=4, **asked) for _ in range(2))
    assert (one.p_value, one.shuffles) == (same.p_value, same.shuffles)
    np.testing.assert_array_equal(one.null, same.null)
    assert one.least_p_value == pytest.approx(0.02)
