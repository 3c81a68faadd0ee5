"""Refining: what comes back, what does not, and minima that are known."""

import dataclasses
import itertools
import warnings

import jaxlie
import numpy as np
import pytest

import pcm_jax
from pcm_jax import lie
from pcm_jax.consistency import chi2_gate, odometry_edges
from pcm_jax.errors import ConvergenceWarning, InputError
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph
from pcm_jax.mapping import optimize
from pcm_jax.merging import refine as refining
from pcm_jax.merging._innovation import squared_by_leaving
from pcm_jax.merging.joint import joint_graph
from pcm_jax.merging.recall import ROUNDS
from pcm_jax.merging.refinement import JointTest
from pcm_jax.merging.robust.solve import Turns
from pcm_jax.pipeline import merge
from pcm_jax.simulation import simulate_city, simulate_sessions

GATE = float(chi2_gate(0.99, 3))


def world_of(group, seed=1, **more):
    counts = {"poses": 60, "inliers": 8, "aliased_groups": 1, "aliased_size": 3, "random": 10}
    simulate = simulate_city if group.__name__ == "SE2" else simulate_sessions
    return simulate(seed=seed, **{**counts, **more})


def two_lines(offsets, sigma=1.0, poses=30):
    """Two robots on one straight line, whose closures u measure the other `offsets[u]` too far."""
    edges = np.tile(np.eye(3), (poses - 1, 1, 1))
    edges[:, 0, 2] = 1.0
    small = np.diag([1e-3, 1e-3, 1e-4]) ** 2
    line = {"tail": np.arange(poses - 1), "head": np.arange(1, poses), "measurement": edges}
    maps = tuple(
        PoseGraph.from_arrays(**line, covariance=np.tile(small, (poses - 1, 1, 1)), name=name)
        for name in "ab"
    )
    count = len(offsets)
    measured = np.tile(np.eye(3), (count, 1, 1))
    measured[:, 0, 2] = offsets
    at = np.arange(count) % poses
    closures = LoopClosures.from_arrays(
        robot_a=np.zeros(count, int),
        pose_a=at,
        robot_b=np.ones(count, int),
        pose_b=at,
        measurement=measured,
        covariance=np.tile(np.diag([sigma, sigma, 0.01]) ** 2, (count, 1, 1)),
    )
    return MultiRobotGraph(maps, closures)


def first(count, total):
    return np.arange(total) < count


def test_a_closure_comes_back_once_others_have_moved_the_map():
    """Accepted: four about 0 m. Of 4.1 m χ² is 4.1² / 1.25 = 13.4, above the gate of 11.3.

    With four of 3.5 m back, whose own is 9.8, the map is at 1.75 m, and it is 2.35² / 1.125 = 4.9.
    """
    about = [-1.2, 1.2, -0.9, 0.9]
    result = merge(two_lines([*about, *[3.5] * 4, 4.1]), accepted=first(4, 9), refine="recall")
    assert result.accepted.all()
    assert result.refinement.rounds == 2
    alone = merge(two_lines([*about, 4.1]), accepted=first(4, 5), refine="recall")
    assert alone.accepted.tolist() == [True] * 4 + [False]


def test_a_right_closure_that_was_left_out_comes_back(group):
    world = world_of(group)
    left_out = np.flatnonzero(world.is_true)[2]
    accepted = world.is_true.copy()
    accepted[left_out] = False
    result = merge(world.graph, accepted=accepted, refine="recall")
    np.testing.assert_array_equal(result.accepted, world.is_true)
    assert np.flatnonzero(result.recalled).tolist() == [left_out]
    assert result.refinement.rounds == 1  # one solve with it
    whole = merge(world.graph, accepted=world.is_true)
    assert result.solution.cost == pytest.approx(whole.solution.cost, rel=1e-8)
    np.testing.assert_allclose(
        lie.as_matrix(result.anchors), lie.as_matrix(whole.anchors), atol=1e-6
    )


def test_the_clique_loses_one_by_chance_and_recall_brings_it_back():
    world = simulate_city(seed=3, poses=200, inliers=40, aliased_groups=1, random=40)
    alone = merge(world.graph)
    lost = world.is_true & ~alone.accepted
    assert lost.any()
    assert alone.refinement is None
    assert not alone.recalled.any()
    result = merge(world.graph, refine="recall")
    np.testing.assert_array_equal(result.accepted, world.is_true)
    np.testing.assert_array_equal(result.recalled, lost)
    assert result.refinement.rounds <= ROUNDS
    assert result.refinement.settled
    assert result.refinement.joint.p > 0.01


def test_squared_is_what_the_cost_rises_and_falls_by(group):
    """To first order: errors of the world are a tenth of the usual."""
    sigma = {"sigma_translation": 0.002, "sigma_rotation": 0.0002}
    world = world_of(group, aliased_groups=0, random=0, **sigma)
    maps = tuple(optimize(one).graph for one in world.graph.maps)
    graph = MultiRobotGraph(maps, world.graph.closures)
    without = merge(graph, accepted=np.arange(1, 8), optimized=True)
    whole = merge(graph, accepted=np.arange(8), optimized=True)
    rise = 2.0 * (whole.solution.cost - without.solution.cost)
    for result, used in ((without, False), (whole, True)):
        placed = MultiRobotGraph(result.graph.maps, graph.closures)
        joint = joint_graph(placed, (0, 1), np.arange(8), lie.identity(group, (2,)))
        edge = joint.num_edges - 8
        mask = np.ones(joint.num_edges, bool)
        mask[edge] = used
        found = squared_by_leaving(joint, mask, np.array([edge]))
        assert found == pytest.approx(rise, rel=1e-3)


def test_the_joint_test_is_that_of_the_closures(group):
    """By `joint_consistency`, which knows the two maps alone and no merged one."""
    world = world_of(group, aliased_groups=0, random=0)
    result = merge(world.graph, accepted=np.arange(7), refine="recall")
    assert result.accepted.all()
    selection = pcm_jax.select(world.graph, minimum_inliers=2)
    tested = pcm_jax.joint_consistency(selection.pairs[0].evidence)
    assert result.refinement.joint.dof == tested.dof
    assert result.refinement.joint.chi2 == pytest.approx(tested.chi2, rel=0.02)


CHAIN = [0.0] * 3 + [3.4] * 5 + [5.4] * 10 + [7.3] * 20 + [9.0] * 40


def naively_recalled(graph, accepted):
    """Rounds by the gate alone, in the map of the round before."""
    while True:
        result = merge(graph, accepted=accepted)
        placed = MultiRobotGraph(result.graph.maps, graph.closures)
        count = len(accepted)
        here = lie.identity(graph.group, (2,))
        joint = joint_graph(placed, (0, 1), np.arange(count), here)
        used = np.concatenate([np.ones(joint.num_edges - count, bool), accepted])
        outside = np.flatnonzero(~used)
        passing = squared_by_leaving(joint, used, outside) <= GATE
        if not passing.any():
            return accepted
        accepted = accepted.copy()
        accepted[outside[passing] - (joint.num_edges - count)] = True


def test_false_closures_let_in_no_further_ones():
    """Five at 3 sigma pass; each further family passes where those before have pulled the map."""
    graph = two_lines(CHAIN)
    accepted = first(3, len(CHAIN))
    assert naively_recalled(graph, accepted).all()
    result = merge(graph, accepted=accepted, refine="recall")
    assert not result.accepted[8:].any()
    assert result.accepted[:3].all()


def test_of_two_that_contradict_each_other_one_comes_back():
    graph = two_lines([1.0, -1.0, 0.0, 3.3, -3.3])
    result = merge(graph, accepted=first(3, 5), refine="recall")
    assert result.accepted[:3].all()
    assert result.accepted[3:].sum() == 1
    alone = merge(two_lines([1.0, -1.0, 0.0, -3.3]), accepted=first(3, 4), refine="recall")
    assert alone.recalled.any()


def test_the_set_keeps_the_joint_test():
    """Each of 24 is within the gate, to both sides; all together they are not."""
    offsets = [1.0, -1.0] * 3 + [2.8, -2.8] * 12
    graph = two_lines(offsets)
    accepted = first(6, len(offsets))
    result = merge(graph, accepted=accepted, refine="recall")
    assert 0 < result.recalled.sum() < 24
    assert result.refinement.joint.p >= 0.01
    everything = merge(graph, accepted=np.ones(len(offsets), bool), refine="recall")
    assert everything.refinement.joint.p < 0.01


def test_errors_stated_too_large_let_in_no_more():
    """Accepted ones are off by 0.2 m of the 1 m that they state: what is 1.5 m off stays out."""
    offsets = [0.2, -0.2] * 6 + [1.5, 0.4]
    result = merge(two_lines(offsets), accepted=first(12, 14), refine="recall")
    np.testing.assert_array_equal(np.flatnonzero(result.recalled), [13])


def test_a_set_that_fails_the_joint_test_may_stay_as_it_is_but_not_get_worse():
    offsets = [2.5, -2.5] * 6 + [2.9, -2.9] * 10
    graph = two_lines(offsets)
    result = merge(graph, accepted=first(12, len(offsets)), refine="recall")
    before = merge(graph, accepted=first(12, len(offsets)))
    ratio = 2.0 * before.solution.cost / (11 * 3)
    test = result.refinement.joint
    assert test.p < 0.01
    assert test.chi2 / test.dof <= ratio * (1 + 1e-9)


def test_refining_joins_nobody():
    """A pair that chance refuses stays apart, however well its closures would fit."""
    world = simulate_city(seed=2, poses=60, robots=3, inliers=6, aliased_groups=0, random=5)
    ends = np.stack([world.graph.closures.robot_a, world.graph.closures.robot_b])
    accepted = world.is_true & ~(ends == 2).any(axis=0)
    for mode in ("recall", "gnc"):
        result = merge(world.graph, accepted=accepted, refine=mode)
        assert result.groups == ((0, 1), (2,))
        assert not result.accepted[(ends == 2).any(axis=0)].any()
    tied = world.is_true & ~((ends == 2).any(axis=0) & (ends == 0).any(axis=0))
    joined = merge(world.graph, accepted=tied, refine="recall")
    np.testing.assert_array_equal(joined.accepted, world.is_true)


def test_where_all_is_accepted_nothing_is_left_to_settle():
    result = merge(two_lines([0.1, -0.1, 0.0]), accepted=first(3, 3), refine="recall")
    assert (result.refinement.settled, result.refinement.rounds) == (True, 0)
    assert not result.refinement.recalled.any()


def test_a_joint_test_without_freedom_finds_nothing_against():
    """For two degrees the probability of more than χ² is exp(−χ² / 2)."""
    assert JointTest(5.0, 2).p == pytest.approx(np.exp(-2.5))
    assert JointTest(5.0, 0).p == JointTest(5.0, -3).p == 1.0


def test_closures_without_weight_stay_out():
    world = world_of(jaxlie.SE2)
    left_out = np.flatnonzero(world.is_true)[0]
    accepted = world.is_true.copy()
    accepted[left_out] = False
    weight = np.ones(len(accepted))
    weight[left_out] = 0.0
    closures = dataclasses.replace(world.graph.closures, weight=weight)
    graph = MultiRobotGraph(world.graph.maps, closures)
    for mode in ("recall", "gnc"):
        assert not merge(graph, accepted=accepted, refine=mode).accepted[left_out]


def small_problem(group):
    """Twelve poses a robot; four right closures, two false; a false loop inside map a."""
    world = world_of(group, seed=1, poses=14, inliers=4, aliased_groups=0, random=2)
    maps = []
    for robot, one in enumerate(world.graph.maps):
        odometry = np.zeros(one.num_edges, bool)
        odometry[odometry_edges(one)] = True
        own = one.with_edges(odometry)
        if robot == 0:
            wrong = np.zeros(group.tangent_dim)
            wrong[:2] = 3.0, -2.0
            measured = lie.as_numpy(lie.exp(group, wrong))
            own = dataclasses.replace(
                own,
                tail=np.append(own.tail, 1).astype(np.int32),
                head=np.append(own.head, 11).astype(np.int32),
                measurement=lie.concatenate([own.measurement, lie.stack([measured])]),
                information=np.concatenate([own.information, own.information[:1]]),
                source=np.append(own.source, ""),
            )
        maps.append(own)
    return MultiRobotGraph(tuple(maps), world.graph.closures), world.is_true


@pytest.mark.slow
def test_gnc_finds_the_known_minimum(group):
    """The least of all 2⁷ subsets of closures and loops, each solved."""
    graph, is_true = small_problem(group)
    accepted = is_true.copy()
    accepted[np.flatnonzero(is_true)[0]] = False
    result = merge(graph, accepted=accepted, refine="gnc")
    gate = float(chi2_gate(0.99, graph.tangent_dim))
    edges = graph.maps[0].num_edges
    costs = {}
    for bits in itertools.product([False, True], repeat=7):
        used, loop = np.array(bits[:6]), bits[6]
        if not used.any():
            continue
        kept = np.ones(edges, bool)
        kept[-1] = loop
        maps = (graph.maps[0].with_edges(kept), graph.maps[1])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            solved = merge(MultiRobotGraph(maps, graph.closures), accepted=used)
        left = 7 - used.sum() - loop
        costs[bits] = 2.0 * solved.solution.cost + gate * left
    least = min(costs, key=lambda bits: costs[bits])
    np.testing.assert_array_equal(result.accepted, least[:6])
    assert bool(result.refinement.loops[0][-1]) == least[6]
    np.testing.assert_array_equal(result.accepted, is_true)
    assert result.refinement.loops_dropped == 1
    assert result.graph.maps[0].num_edges == edges - 1
    assert 2.0 * result.solution.cost + gate * 3 == pytest.approx(costs[least], rel=1e-6)


@pytest.mark.slow
def test_gnc_drops_a_false_closure_that_was_accepted(group):
    world = world_of(group, seed=2)
    wrong = np.flatnonzero(~world.is_true)[-1]
    accepted = world.is_true.copy()
    accepted[wrong] = True
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # of the merge that it begins with
        result = merge(world.graph, accepted=accepted, refine="gnc")
    np.testing.assert_array_equal(result.accepted, world.is_true)
    assert np.flatnonzero(result.refinement.dropped).tolist() == [wrong]


def test_gnc_is_not_taken_where_it_parts_robots(monkeypatch):
    """Of closures that contradict each other none holds, at a lower truncated cost."""
    graph = two_lines([5.0, -5.0, 5.0, -5.0])
    far = lie.exp(jaxlie.SE2, np.array([100.0, 0.0, 0.0]))
    apart = [lie.as_numpy(one.poses) for one in graph.maps]
    apart[1] = lie.compose(lie.take(lie.stack([far]), np.zeros(30, int)), apart[1])

    def nothing_holds(joint, doubted, reweighting, **_):
        none = np.zeros(len(doubted))
        return Turns(lie.concatenate(apart), none, none, 0.0, 0.0, 1, True)

    monkeypatch.setattr(refining, "reweighted", nothing_holds)
    result = merge(graph, accepted=np.ones(4, bool), refine="gnc")
    assert result.accepted.all()
    assert result.groups == ((0, 1),)


def test_gnc_is_not_taken_where_it_costs_more(monkeypatch):
    def one_holds(joint, doubted, reweighting, **_):
        scale = np.zeros(len(doubted))
        scale[-1] = 1.0
        return Turns(lie.as_numpy(joint.poses), scale, scale, 0.0, 0.0, 1, True)

    monkeypatch.setattr(refining, "reweighted", one_holds)
    result = merge(two_lines([0.0, 0.1, -0.1]), accepted=[0, 1, 2], refine="gnc")
    assert result.accepted.all()
    assert result.refinement.rounds == 0


@pytest.mark.parametrize("mode", ["recall", "gnc"])
def test_the_same_again(mode):
    world = world_of(jaxlie.SE2)
    accepted = world.is_true & (np.arange(len(world.is_true)) % 3 > 0)
    one, other = (merge(world.graph, accepted=accepted, refine=mode) for _ in range(2))
    np.testing.assert_array_equal(one.accepted, other.accepted)
    assert one.solution == other.solution
    assert one.report()["refine"] == other.report()["refine"]


def test_report_tells_what_was_refined():
    graph = two_lines([0.0, 0.1, -0.1, 0.2, 30.0])
    result = merge(graph, accepted=first(3, 5), refine="gnc")
    report = result.report()
    assert report["refine"]["mode"] == "gnc"
    assert report["refine"]["recalled"] == [3]
    assert report["refine"]["joint"]["dof"] == 9
    assert [row["accepted"] for row in report["closures"]] == [True] * 4 + [False]
    assert report["gate"] == pytest.approx(GATE)
    assert "1 closures came back" in repr(result.refinement)
    assert "refine" in report["seconds"]
    assert merge(graph, accepted=first(3, 5)).report().get("refine") is None


def test_bad_arguments():
    graph = two_lines([0.0, 0.1, -0.1])
    with pytest.raises(InputError, match="refine: 'best', expected one of recall, gnc"):
        merge(graph, refine="best")
    for method in ("dcs", "gnc"):
        with pytest.raises(InputError, match=f"refine: not an option of method '{method}'"):
            merge(graph, method=method, refine="recall")
    with pytest.raises(InputError, match="refine: not an option that goes with method 'all'"):
        merge(graph, method="all", refine="gnc")
    with pytest.raises(InputError, match="confidence: not an option that goes with accepted="):
        merge(graph, accepted=[0], confidence=0.9)
    strict = merge(graph, accepted=[0], confidence=0.5, refine="recall")
    assert strict.gate == pytest.approx(float(chi2_gate(0.5, 3)))
    gap = dataclasses.replace(graph.maps[0], tail=graph.maps[0].tail.copy())
    gap.tail[5] = 4
    with pytest.raises(InputError, match="map 'a': no edge joins poses"):
        merge(MultiRobotGraph((gap, graph.maps[1]), graph.closures), accepted=[0], refine="gnc")
