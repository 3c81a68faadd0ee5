"""Small worlds whose closures and poses come one after another, and what equal answers are."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from pcm_jax import lie
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph


def begun(pose_graph: PoseGraph, count: int) -> PoseGraph:
    """The map as it was when it had so many poses."""
    tail, head = np.asarray(pose_graph.tail), np.asarray(pose_graph.head)
    some = pose_graph.with_edges((tail < count) & (head < count))
    return dataclasses.replace(
        some,
        poses=lie.take(lie.as_numpy(pose_graph.poses), np.arange(count)),
        ids=pose_graph.ids[:count],
    )


def edges_at(pose_graph: PoseGraph, count: int, *, odometry: bool) -> dict[str, Any]:
    """What `extend` is told when pose `count` comes: its odometry, or its loops."""
    low = np.minimum(pose_graph.tail, pose_graph.head)
    high = np.maximum(pose_graph.tail, pose_graph.head)
    step = low == high - 1
    rows = np.flatnonzero((high == count) & (step if odometry else ~step))
    return {
        "tail": np.asarray(pose_graph.tail)[rows],
        "head": np.asarray(pose_graph.head)[rows],
        "measurement": lie.take(lie.as_numpy(pose_graph.measurement), rows),
        "information": np.asarray(pose_graph.information)[rows],
    }


def turned(closures: LoopClosures) -> LoopClosures:
    """The same closures, said from the other end."""
    inverse = lie.inverse(lie.as_numpy(closures.measurement))
    back = np.asarray(lie.adjoint(inverse))
    return dataclasses.replace(
        closures,
        robot_a=closures.robot_b,
        pose_a=closures.pose_b,
        robot_b=closures.robot_a,
        pose_b=closures.pose_a,
        measurement=inverse,
        information=np.swapaxes(back, 1, 2) @ np.asarray(closures.information) @ back,
    )


def without_closures(graph: MultiRobotGraph) -> MultiRobotGraph:
    """The maps alone."""
    return dataclasses.replace(graph, closures=LoopClosures.empty(graph.group))


def assert_same_answer(online: Any, batch: Any) -> None:
    """Asserts that two selections are equal: sets, certificates, verdicts, cycles."""
    np.testing.assert_array_equal(online.accepted, batch.accepted)
    assert (online.method, online.confidence, online.gate) == (
        batch.method,
        batch.confidence,
        batch.gate,
    )
    assert len(online.pairs) == len(batch.pairs)
    for one, other in zip(online.pairs, batch.pairs, strict=True):
        assert (one.robot_a, one.robot_b) == (other.robot_a, other.robot_b)
        np.testing.assert_array_equal(one.closures, other.closures)
        np.testing.assert_array_equal(one.accepted, other.accepted)
        np.testing.assert_array_equal(one.members, other.members)
        assert certificate(one) == certificate(other)
        np.testing.assert_array_equal(one.consistent(), other.consistent())
        assert_same_verdict(one.verdict, other.verdict)
    assert [cycle.robots for cycle in online.team] == [cycle.robots for cycle in batch.team]
    for one, other in zip(online.team, batch.team, strict=True):
        np.testing.assert_allclose(one.chi2, other.chi2, rtol=1e-4, atol=1e-6)


def certificate(pair: Any) -> tuple[Any, ...]:
    return pair.optimal, pair.upper_bound, pair.found, pair.weight, pair.weight_bound


def assert_same_verdict(one: Any, other: Any) -> None:
    assert (one.believed, one.why, one.places) == (other.believed, other.why, other.places)
    np.testing.assert_allclose(one.separation, other.separation, rtol=1e-6, atol=1e-9)
    assert (one.chance is None) == (other.chance is None)
    if one.chance is not None:
        assert one.chance.p_value == other.chance.p_value
        np.testing.assert_array_equal(one.chance.null, other.chance.null)
    assert (one.rival is None) == (other.rival is None)
    if one.rival is not None:
        np.testing.assert_array_equal(one.rival.members, other.rival.members)
        assert one.rival.ambiguous == other.rival.ambiguous
