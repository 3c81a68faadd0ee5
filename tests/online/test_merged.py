"""Merges anew from where the last one ended, robots that come, robots that are renamed."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from online_worlds import assert_same_answer, begun, edges_at, without_closures

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.mapping import covariance
from pcm_jax.online import IncrementalPcm, _merged, _pair
from pcm_jax.pipeline import merge, select
from pcm_jax.simulation import simulate_city

RULE = {"minimum_inliers": 2}


@pytest.fixture(scope="module")
def graph():
    return simulate_city(
        seed=2, poses=60, robots=3, inliers=8, aliased_groups=1, aliased_size=3, random=9
    ).graph


def assert_same_merge(found, batch):
    np.testing.assert_array_equal(found.accepted, batch.accepted)
    assert found.groups == batch.groups and found.solution.converged
    np.testing.assert_allclose(found.solution.cost, batch.solution.cost, rtol=1e-6, atol=1e-9)
    assert found.solution.normalized_chi2 == pytest.approx(batch.solution.normalized_chi2, rel=1e-6)
    for one, other in zip(found.graph.maps, batch.graph.maps, strict=True):
        apart = np.asarray(lie.log(lie.between(lie.as_numpy(one.poses), lie.as_numpy(other.poses))))
        np.testing.assert_allclose(apart, 0.0, atol=1e-5)
    apart = np.asarray(lie.log(lie.between(found.anchors, batch.anchors)))
    np.testing.assert_allclose(apart, 0.0, atol=1e-5)
    assert len(found.graph.closures) == len(batch.graph.closures)
    assert found.candidates is not None and found.maps is not None


def counting_cold(monkeypatch):
    """Counts the merges that begin anew."""
    import pcm_jax.pipeline

    real, calls = pcm_jax.pipeline.merge, []

    def counted(*args, **kwargs):
        calls.append(args)
        return real(*args, **kwargs)

    monkeypatch.setattr(pcm_jax.pipeline, "merge", counted)
    return calls


def test_from_where_the_last_one_ended(graph, monkeypatch):
    cold = counting_cold(monkeypatch)
    online = IncrementalPcm(without_closures(graph), **RULE)
    order = np.random.default_rng(0).permutation(len(graph.closures))
    for part in np.array_split(order, 6):
        online.add(graph.closures[part])
        found = online.merge()
        assert_same_merge(found, merge(online.graph, **RULE))
        assert found.selection is online.result() and found.method == "pcm-exact"
    assert len(cold) == 1
    assert max(map(len, online.merge().groups)) == 3


def test_the_same_again_takes_no_more_than_a_look(graph):
    online = IncrementalPcm(graph, **RULE)
    first = online.merge()
    again = online.merge()
    assert again.solution.initial_cost == pytest.approx(again.solution.cost, rel=1e-6)
    assert again.solution.iterations < first.solution.iterations
    assert_same_merge(again, first)


def test_each_map_keeps_its_own_frame(graph):
    """Groups lie where their first robot's map does, wherever other maps begin."""
    maps = []
    for number, one in enumerate(graph.maps):
        motion: Any = np.array([[3.0 * number - 2.0, 1.0, 0.4 * number + 0.2]])
        there = lie.exp(one.group, np.repeat(motion, one.num_poses, axis=0))
        maps.append(one.with_poses(lie.compose(there, lie.as_numpy(one.poses))))
    online = IncrementalPcm(dataclasses.replace(graph, maps=tuple(maps)), **RULE)
    online.merge()
    found = online.merge()
    assert found.solution.initial_cost == pytest.approx(found.solution.cost, rel=1e-6)
    assert_same_merge(found, merge(online.graph, **RULE))


def test_maps_that_grow_and_move(graph):
    maps = tuple(begun(one, 50) for one in graph.maps)
    closures = graph.closures
    there = (closures.pose_a < 50) & (closures.pose_b < 50)
    short = dataclasses.replace(graph, maps=maps, closures=closures[there])
    online = IncrementalPcm(short, **RULE)
    online.merge()
    for pose in (50, 51):
        online.extend(0, **edges_at(graph.maps[0], pose, odometry=True))
    assert_same_merge(online.merge(), merge(online.graph, **RULE))
    one = online.graph.maps[1]
    stiffer = dataclasses.replace(one, information=2.0 * one.information)
    online.replace_maps([online.graph.maps[0], stiffer, online.graph.maps[2]])
    assert_same_merge(online.merge(), merge(online.graph, **RULE))


def test_a_group_that_is_parted_and_one_that_joins(graph):
    online = IncrementalPcm(graph, **RULE)
    assert online.merge().groups == ((0, 1, 2),)
    ends = np.stack([graph.closures.robot_a, graph.closures.robot_b])
    rows = np.flatnonzero((ends == 0).any(axis=0))
    gone = graph.closures[rows]
    online.remove(rows)
    found = online.merge()
    assert found.groups == ((0,), (1, 2))
    assert_same_merge(found, merge(online.graph, **RULE))
    online.add(gone)
    assert online.merge().groups == ((0, 1, 2),)
    assert_same_merge(online.merge(), merge(online.graph, **RULE))


def test_an_answer_that_turned_over_is_solved_from_anew():
    made = simulate_city(seed=2, poses=60, inliers=6, aliased_groups=1, aliased_size=4, random=0)
    order = np.argsort(made.is_true, kind="stable")
    closures = made.graph.closures[order]
    online = IncrementalPcm(dataclasses.replace(made.graph, closures=closures[:4]), **RULE)
    assert online.merge().accepted.all()
    online.add(closures[4:])
    found = online.merge()
    assert found.accepted.tolist() == [False] * 4 + [True] * 6
    assert_same_merge(found, merge(online.graph, **RULE))


def test_options_are_those_of_merge(graph):
    online = IncrementalPcm(graph, **RULE)
    online.merge()
    assert_same_merge(online.merge(solver="levenberg-marquardt"), merge(graph, **RULE))
    found, batch = online.merge(refine="recall"), merge(graph, refine="recall", **RULE)
    np.testing.assert_array_equal(found.accepted, batch.accepted)
    with pytest.raises(InputError, match="accepted: not an option of merge here"):
        online.merge(accepted=[0])
    told = []
    online.merge(progress=lambda *each: told.append(each))
    assert told == [("merge", 0, 1), ("merge", 1, 1)]


def test_maps_with_priors_are_merged_anew(graph, monkeypatch):
    monkeypatch.setattr(_merged, "_may_be_warm", lambda own: False)
    cold = counting_cold(monkeypatch)
    online = IncrementalPcm(graph, **RULE)
    online.merge()
    online.merge()
    assert len(cold) == 2


def test_a_robot_that_comes_is_merged_with_the_others(graph):
    two = dataclasses.replace(without_closures(graph), maps=graph.maps[:2])
    between = (graph.closures.robot_a < 2) & (graph.closures.robot_b < 2)
    online = IncrementalPcm(dataclasses.replace(two, closures=graph.closures[between]), **RULE)
    assert online.merge().groups == ((0, 1),)
    named = dataclasses.replace(graph.maps[2], name=graph.maps[0].name)
    assert online.add_robot(named) == 2
    assert online.graph.names[2] == f"{graph.maps[0].name}-2"
    found = online.merge()
    assert found.groups == ((0, 1), (2,))
    assert_same_merge(found, merge(online.graph, **RULE))
    online.add(graph.closures[~between])
    assert_same_merge(online.merge(), merge(online.graph, **RULE))
    with pytest.raises(InputError, match="pose_graph"):
        online.add_robot(None)  # type: ignore[arg-type]


def test_a_robot_that_is_renamed_keeps_what_is_known(graph, monkeypatch, tmp_path):
    online = IncrementalPcm(graph, **RULE)
    before = online.result()
    factors, rebuilt = [], []
    monkeypatch.setattr(covariance, "covariance_factor", factors.append)
    monkeypatch.setattr(_pair.HeldPair, "rebuilt", lambda *_: rebuilt.append(1))
    online.rename("b", "rover")
    assert online.graph.names == ("a", "rover", "c")
    assert factors == rebuilt == []
    monkeypatch.undo()
    found = online.result()
    np.testing.assert_array_equal(found.accepted, before.accepted)
    assert_same_answer(found, select(online.graph, **RULE))
    assert [one.name for one in found.evidence.maps] == ["a", "rover", "c"]
    assert online.merge().graph.names == ("a", "rover", "c")
    online.save(tmp_path / "state.npz")
    other = IncrementalPcm.load(tmp_path / "state.npz")
    other.rename(1, "b")
    assert other.graph.names == ("a", "b", "c")
    other.extend("b", **_step(graph, 1))
    assert other.graph.maps[1].num_poses == 61


def _step(graph, robot):
    step = edges_at(graph.maps[robot], 20, odometry=True)
    del step["tail"], step["head"]
    return step


@pytest.mark.parametrize("name", ["a", "", 3])
def test_a_name_that_cannot_be_meant(graph, name):
    online = IncrementalPcm(graph)
    with pytest.raises(InputError, match="expected one that no other robot has"):
        online.rename(1, name)
    with pytest.raises(InputError, match="robot: 'z' given"):
        online.rename("z", "y")
    assert online.graph.names == ("a", "b", "c")
