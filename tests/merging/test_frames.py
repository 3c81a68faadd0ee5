"""Merges of maps with priors: whose frame the group is in, and that all of them are used."""

import dataclasses

import jaxlie
import numpy as np
import pytest

from pcm_jax import lie, merge, merge_differentiable
from pcm_jax.errors import InputError, InputWarning
from pcm_jax.files import to_gtsam
from pcm_jax.graph import MultiRobotGraph, PoseGraph, Priors, split
from pcm_jax.merging.joint import joint_graph

SIGMA = 0.01
MOST = 5  # of the six true closures: each of 15 pairs passes in 99 of 100
LEVER = 40  # metres, twice from a prior's rotation to the farthest pose


def world(group, seed=0, n=24):
    """A walk with loops, cut in two at its middle: six closures, all true."""
    rng, d = np.random.default_rng(seed), lie.tangent_dim(group)
    steps = rng.normal(scale=0.3, size=(n - 1, d))
    steps[:, 0] += 1.0
    truth = [lie.identity(group)]
    for step in steps:
        truth.append(lie.compose(truth[-1], lie.exp(group, step)))
    truth = lie.stack(truth)
    loops = np.array([[0, 6], [2, 9], [14, 20], [13, 22]])
    closures = np.array([[1, 14], [3, 16], [5, 19], [7, 21], [9, 13], [11, 23]])
    ends = np.concatenate([np.stack([np.arange(n - 1), np.arange(1, n)], 1), loops, closures])
    between = lie.between(lie.take(truth, ends[:, 0]), lie.take(truth, ends[:, 1]))
    noise = lie.exp(group, SIGMA * rng.normal(size=(len(ends), d)))
    graph = PoseGraph.from_arrays(
        poses=truth,
        tail=ends[:, 0],
        head=ends[:, 1],
        measurement=lie.compose(between, noise),
        information=np.broadcast_to(np.eye(d) / SIGMA**2, (len(ends), d, d)),
    )
    return split(graph, n // 2), truth


def priors_at(poses, truth, seed, sigma=SIGMA):
    """Measurements of some of the true poses, `[n]`."""
    rng, d = np.random.default_rng(seed), lie.tangent_dim(truth)
    there = lie.take(truth, np.array(poses))
    noise = lie.exp(lie.group_of(truth), sigma * rng.normal(size=(len(poses), d)))
    information = np.broadcast_to(np.eye(d) / sigma**2, (len(poses), d, d))
    return lie.compose(there, noise), information


def with_priors(graph, truth, each, seed=1):
    """The graph with priors on the poses of each robot that `each` names."""
    maps, start = [], 0
    for robot, own in enumerate(graph.maps):
        if each[robot]:
            at = np.array(each[robot])
            measured, information = priors_at(at + start, truth, seed + robot)
            priors = Priors.from_arrays(pose=at, measurement=measured, information=information)
            maps.append(dataclasses.replace(own, priors=priors))
        else:
            maps.append(own)
        start += own.num_poses
    return MultiRobotGraph(tuple(maps), graph.closures)


def moved(own, by):
    far = lie.exp(own.group, np.full((own.num_poses, own.tangent_dim), by))
    return own.with_poses(lie.compose(far, lie.as_numpy(own.poses)))


def farthest(result, truth):
    found = lie.concatenate([lie.as_numpy(own.poses) for own in result.graph.maps])
    return np.abs(np.asarray(lie.log(lie.between(truth, found)))).max()


def test_both_maps_priors_are_used(group):
    """The cost is GTSAM's of what is written, and the maps lie in the priors' frame."""
    pytest.importorskip("gtsam")
    graph, truth = world(group)
    given = with_priors(graph, truth, [[2, 9], [4, 10]])
    given = MultiRobotGraph(tuple(moved(own, 0.7) for own in given.maps), given.closures)
    result = merge(given)
    assert result.accepted.all()
    assert [len(own.priors) for own in result.graph.maps] == [2, 2]
    assert farthest(result, truth) < 6 * SIGMA
    factors, values = to_gtsam(result.graph)
    assert factors.size() == sum(own.num_edges for own in graph.maps) + len(graph.closures) + 4
    assert result.solution.cost == pytest.approx(factors.error(values), rel=1e-9)
    rows = (factors.size()) * graph.tangent_dim
    freedom = rows - len(lie.parameters(truth)) * graph.tangent_dim
    assert result.solution.normalized_chi2 == pytest.approx(2 * result.solution.cost / freedom)
    assert 0.3 < result.solution.normalized_chi2 < 2.0


def test_anchors_have_the_priors_uncertainty(group):
    graph, truth = world(group)
    result = merge(with_priors(graph, truth, [[2, 9], [4, 10]]))
    variances = np.diagonal(result.anchor_covariance, axis1=1, axis2=2)
    assert (variances > 0.0).all()
    held = merge(graph).anchor_covariance
    assert not held[0].any() and held[1].any()


def test_a_robot_without_priors_is_moved_to_the_others_frame(group):
    graph, truth = world(group)
    given = with_priors(graph, truth, [[], [2, 8]])
    given = MultiRobotGraph((moved(given.maps[0], 1.1), given.maps[1]), given.closures)
    result = merge(given)
    assert result.accepted.sum() >= MOST and result.solution.converged
    assert result.solution.initial_cost < 1e3 * result.solution.cost  # the start is in that frame
    assert farthest(result, truth) < LEVER * SIGMA


def test_priors_of_two_frames_are_told_apart(group):
    """Each robot's prior holds its own first pose: the second's is no measurement of the group."""
    graph, truth = world(group)
    given = with_priors(graph, truth, [[0], [0]])
    second = given.maps[1]
    far = lie.exp(group, np.full((1, graph.tangent_dim), 0.8))
    own = dataclasses.replace(
        second.priors, measurement=lie.compose(far, second.priors.measurement)
    )
    maps = given.maps[0], dataclasses.replace(moved(second, 0.8), priors=own)
    with pytest.warns(InputWarning, match="map 'b': its priors are left out"):
        result = merge(MultiRobotGraph(maps, given.closures))
    assert result.graph.maps[1].priors is None and result.graph.maps[0].priors is not None
    assert result.accepted.sum() >= MOST
    assert farthest(result, truth) < LEVER * SIGMA
    assert result.solution.normalized_chi2 < 2.0


def test_robots_apart_stay_in_their_priors_frames(group):
    graph, truth = world(group)
    given = with_priors(graph, truth, [[2, 9], [4, 10]])
    result = merge(given, accepted=np.zeros(len(given.closures), bool))
    assert result.groups == ((0,), (1,))
    assert farthest(result, truth) < 6 * SIGMA


@pytest.mark.parametrize("method", ["gnc", "dcs"])
def test_robust_methods_take_priors_too(method):
    graph, truth = world(jaxlie.SE2)
    given = with_priors(graph, truth, [[2, 9], [4, 10]])
    result = merge(given, method=method)
    assert result.accepted.all()
    assert farthest(result, truth) < 6 * SIGMA
    without = merge(graph, method=method)
    assert result.solution.cost > without.solution.cost
    assert 0.3 < result.solution.normalized_chi2 < 2.0


def test_the_differentiable_merge_refuses_them(group):
    graph, truth = world(group)
    given = with_priors(graph, truth, [[2], []])
    with pytest.raises(InputError, match=r"priors: map 'a' has 1, .*without_priors"):
        merge_differentiable(given, np.ones(len(given.closures)))


def test_an_empty_batch_of_priors_is_none():
    """A merge is the same with it, wherever the robots' own frames are, and takes it."""
    graph, _ = world(jaxlie.SE2)
    graph = MultiRobotGraph((graph.maps[0], moved(graph.maps[1], 1.1)), graph.closures)
    nothing = Priors.from_arrays(
        pose=np.zeros(0, int), measurement=np.zeros((0, 3, 3)), information=np.zeros((0, 3, 3))
    )
    maps = tuple(dataclasses.replace(own, priors=nothing) for own in graph.maps)
    given, every = MultiRobotGraph(maps, graph.closures), np.arange(len(graph.closures))
    here = lie.identity(jaxlie.SE2, (2,))
    assert joint_graph(given, (0, 1), every, here).priors is None
    for method in ("pcm-exact", "dcs"):
        one, other = (merge(each, method=method).solution for each in (given, graph))
        assert one.initial_cost == pytest.approx(other.initial_cost, rel=1e-9)
        assert one.cost == pytest.approx(other.cost, rel=1e-9)
    with pytest.raises(InputError, match="weights: "):  # and nothing of priors
        merge_differentiable(given, np.ones(len(every) + 1))
