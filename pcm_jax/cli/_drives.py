"""Drives whose closures keep coming: those of a team, or those of one robot."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.consistency import odometry_edges
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph
from pcm_jax.online import IncrementalPcm, IncrementalWithin


class Drive(Protocol):
    """A drive that is streamed.

    Attributes:
        online: takes in what comes, and is asked.
    """

    online: Any

    def arrivals(self, graph: MultiRobotGraph, order: str) -> Sequence[Callable[[], Any]]:
        """Lists what takes in the closures of a graph, one by one, in the order they come in."""
        ...

    def go_on(self, grown: MultiRobotGraph) -> Drive:
        """Takes in poses and edges that are new in a graph that has grown.

        Returns:
            the drive as it goes on: another one where robots have come to one that was alone.
        """
        ...

    def judged(self, selection: Any) -> dict[str, Any]:
        """An answer as a whole, as JSON has it."""
        ...

    def named(self, row: int) -> dict[str, Any]:
        """One closure: its place in the order in which they came, its poses, where it was read."""
        ...


class Team:
    """Several robots, and closures between them.

    Args:
        graph: whose maps are there at first.
        options: of `IncrementalPcm`.
    """

    def __init__(self, graph: MultiRobotGraph, options: dict[str, Any]) -> None:
        none = MultiRobotGraph(graph.maps, graph.closures[:0])
        self.online = IncrementalPcm(none, **options)

    def arrivals(self, graph: MultiRobotGraph, order: str) -> Sequence[Callable[[], Any]]:
        """Does as `Drive` says."""
        closures = in_order(graph, order)
        return [functools.partial(self.online.add, closures[[row]]) for row in range(len(closures))]

    def go_on(self, grown: MultiRobotGraph) -> Drive:
        """Does as `Drive` says."""
        _replaced(self.online, grown)
        return self

    def judged(self, selection: Any) -> dict[str, Any]:
        """Does as `Drive` says."""
        graph = self.online.graph
        return {"robot_pairs": [_of_pair(graph, pair) for pair in selection.pairs]}

    def named(self, row: int) -> dict[str, Any]:
        """Does as `Drive` says."""
        return _named(self.online.graph, row)


class OneRobot:
    """One robot, and closures inside its map.

    Args:
        graph: whose odometry is there at first.
        options: of `IncrementalWithin`.
    """

    def __init__(self, graph: MultiRobotGraph, options: dict[str, Any]) -> None:
        one, self._options = graph.maps[0], options
        self.online = IncrementalWithin(one.with_edges(odometry_edges(one)), **options)

    def arrivals(self, graph: MultiRobotGraph, order: str) -> Sequence[Callable[[], Any]]:
        """Does as `Drive` says."""
        one = graph.maps[0]
        return [
            functools.partial(self.online.add, **_edges(one, [row], source=one.source[[row]]))
            for row in loops_in_order(one, order)
        ]

    def go_on(self, grown: MultiRobotGraph) -> Drive:
        """Does as `Drive` says."""
        one, *others = grown.maps
        if others:
            return Team(grown, self._options)
        known = self.online.graph.num_poses
        steps = odometry_edges(one)[known - 1 :]
        if len(steps):
            new = np.arange(known, one.num_poses)
            stamps = None if one.stamps is None else one.stamps[new]
            poses = lie.take(lie.as_numpy(one.poses), new)
            self.online.extend(poses, **_edges(one, steps, ids=one.ids[new], stamps=stamps))
        return self

    def judged(self, selection: Any) -> dict[str, Any]:
        """Does as `Drive` says."""
        return {"why": selection.verdict.why, "odometry_scale": selection.odometry_scale}

    def named(self, row: int) -> dict[str, Any]:
        """Does as `Drive` says."""
        graph = self.online.graph
        edge = graph.num_poses - 1 + row
        tail, head = int(graph.tail[edge]), int(graph.head[edge])
        names = {"a": graph.pose_name(tail), "b": graph.pose_name(head)}
        return {"index": row, **names, "source": str(graph.source[edge])}


def in_order(graph: MultiRobotGraph, order: str) -> LoopClosures:
    """The closures in the order in which they come.

    Args:
        graph: maps and closures.
        order: "stamps", "lines", or "auto".

    Raises:
        InputError: for "stamps" where a pose that a closure touches has none.
    """
    closures = graph.closures
    if order == "lines":
        return closures
    ends = ("robot_a", "pose_a"), ("robot_b", "pose_b")
    times = [_stamps(graph, *end) for end in ends]
    at = np.maximum(*times)
    if np.isfinite(at).all():
        return closures[np.argsort(at, kind="stable")]
    if order == "stamps":
        row = int(np.flatnonzero(~np.isfinite(at))[0])
        end = ends[0 if not np.isfinite(times[0][row]) else 1]
        robot, pose = (int(getattr(closures, name)[row]) for name in end)
        name = graph.maps[robot].pose_name(pose)
        raise InputError(f"--order: stamps given, but pose {name} of closure {row} has no time")
    return closures


def _stamps(graph: MultiRobotGraph, robot: str, pose: str) -> Float[np.ndarray, " m"]:
    """The times of the poses at one end of the closures, NaN without one."""
    robots, poses = (np.asarray(getattr(graph.closures, name)) for name in (robot, pose))
    found = np.full(len(robots), np.nan)
    for index, one in enumerate(graph.maps):
        if one.stamps is not None:
            found[robots == index] = one.stamps[poses[robots == index]]
    return found


def loops_in_order(one: PoseGraph, order: str) -> Int[np.ndarray, " m"]:
    """The closures inside a map, as edges, in the order in which they come.

    Args:
        one: odometry and closures.
        order: as for `in_order`.

    Raises:
        InputError: as `in_order`; for consecutive poses that no edge joins.
    """
    rows = np.setdiff1d(np.arange(one.num_edges), odometry_edges(one))
    if order == "lines":
        return rows
    stamps = np.full(one.num_poses, np.nan) if one.stamps is None else one.stamps
    at = np.maximum(stamps[np.asarray(one.tail)[rows]], stamps[np.asarray(one.head)[rows]])
    if np.isfinite(at).all():
        return rows[np.argsort(at, kind="stable")]
    if order == "stamps":
        row = rows[np.flatnonzero(~np.isfinite(at))[0]]
        pose = next(int(p) for p in (one.tail[row], one.head[row]) if not np.isfinite(stamps[p]))
        name = one.pose_name(pose)
        raise InputError(f"--order: stamps given, but pose {name} of edge {row} has no time")
    return rows


def _edges(one: PoseGraph, rows: Any, **also: Any) -> dict[str, Any]:
    return {
        "tail": np.asarray(one.tail)[rows],
        "head": np.asarray(one.head)[rows],
        "measurement": lie.take(lie.as_numpy(one.measurement), np.asarray(rows)),
        "information": np.asarray(one.information)[rows],
        **also,
    }


def _replaced(online: IncrementalPcm, grown: MultiRobotGraph) -> None:
    """Takes the maps that have more poses or edges than before."""
    before = online.graph.maps
    same = [
        one.num_poses == other.num_poses and one.num_edges == other.num_edges
        for one, other in zip(before, grown.maps, strict=False)
    ]
    if all(same) and len(before) == len(grown.maps):
        return
    kept = zip(before, grown.maps, same, strict=False)
    maps = [one if is_same else other for one, other, is_same in kept]
    online.replace_maps([*maps, *grown.maps[len(before) :]])


def _of_pair(graph: MultiRobotGraph, pair: Any) -> dict[str, Any]:
    return {
        "a": graph.maps[pair.robot_a].name,
        "b": graph.maps[pair.robot_b].name,
        "measured": len(pair.accepted),
        "accepted": int(pair.accepted.sum()),
        "why": pair.verdict.why,
    }


def _named(graph: MultiRobotGraph, row: int) -> dict[str, Any]:
    """One closure: its place in the order in which they came, its poses, where it was read."""
    closures = graph.closures
    ends = (closures.robot_a, closures.pose_a), (closures.robot_b, closures.pose_b)
    a, b = (graph.maps[int(robot[row])].pose_name(int(pose[row])) for robot, pose in ends)
    return {"index": row, "a": a, "b": b, "source": str(closures.source[row])}
