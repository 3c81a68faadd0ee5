"""Cutting one robot's trajectory into several robots' maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph.loop_closures import LoopClosures
from pcm_jax.graph.multi_robot import MultiRobotGraph
from pcm_jax.graph.pose_graph import PoseGraph
from pcm_jax.graph.spanning_tree import check_connected


def split(pose_graph: PoseGraph, at: int | Sequence[int]) -> MultiRobotGraph:
    """Cuts a pose graph before each of the poses `at`, into robots a, b, c and so on.

    Edges inside a piece stay in its map; edges between pieces become loop closures, in the graph's
    order and orientation; edges between the two poses next to a cut (the odometry) are dropped.
    Poses, ids and sources are kept; the pieces' poses remain in the graph's frame.

    Args:
        pose_graph: the graph.
        at: indices of the poses that start a new robot, each in 1 … n − 1, ascending.

    Raises:
        InputError: for an index out of range or order, and for a piece that its own edges do not
            hold together.
    """
    n = pose_graph.num_poses
    cuts = _checked_cuts(at, n)
    start = np.concatenate([[0], cuts]).astype(np.int64)
    tail, head = np.asarray(pose_graph.tail), np.asarray(pose_graph.head)
    robot_of = np.searchsorted(cuts, np.arange(n), side="right")
    robot_a, robot_b = robot_of[tail], robot_of[head]
    crossing = (robot_a != robot_b) & (np.abs(tail - head) > 1)
    measurement = lie.as_numpy(pose_graph.measurement)
    information = np.asarray(pose_graph.information)
    maps = []
    for robot, (first, last) in enumerate(zip(start, [*start[1:], n], strict=True)):
        inside = np.flatnonzero((robot_a == robot) & (robot_b == robot))
        ids = pose_graph.ids[first:last]
        _check_piece(tail[inside] - first, head[inside] - first, robot, ids)
        maps.append(
            PoseGraph.from_checked(
                poses=lie.take(lie.as_numpy(pose_graph.poses), slice(first, last)),
                tail=tail[inside] - first,
                head=head[inside] - first,
                measurement=lie.take(measurement, inside),
                information=information[inside],
                ids=ids,
                name="",
                source=pose_graph.source[inside],
            )
        )
    closures = LoopClosures.from_checked(
        (
            robot_a[crossing],
            tail[crossing] - start[robot_a[crossing]],
            robot_b[crossing],
            head[crossing] - start[robot_b[crossing]],
        ),
        lie.take(measurement, crossing),
        information[crossing],
        pose_graph.source[crossing],
    )
    return MultiRobotGraph(tuple(maps), closures)


def _checked_cuts(at: Any, n: int) -> np.ndarray:
    cuts = np.atleast_1d(np.asarray(at))
    if not cuts.size:
        raise InputError("at: no pose given, expected at least one")
    if cuts.ndim != 1 or not np.issubdtype(cuts.dtype, np.integer):
        raise InputError(f"at: {at!r} given, expected a pose index or a list of them")
    if (cuts < 1).any() or (cuts >= n).any():
        culprit = cuts[(cuts < 1) | (cuts >= n)][0]
        raise InputError(f"at: pose {culprit} given, expected 1 … {n - 1} (there are {n} poses)")
    if (np.diff(cuts) <= 0).any():
        raise InputError(f"at: {cuts.tolist()} given, expected ascending pose indices")
    return cuts


def _check_piece(tail: np.ndarray, head: np.ndarray, robot: int, ids: np.ndarray) -> None:
    try:
        check_connected(tail, head, len(ids), ids=ids)
    except InputError as error:
        raise InputError(
            f"at: piece {robot + 1} (poses {ids[0]} to {ids[-1]}) cannot be a map: {error}"
        ) from None
