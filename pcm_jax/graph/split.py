"""Cutting one robot's trajectory into several robots' maps."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from pcm_jax import lie
from pcm_jax.arrays import as_array
from pcm_jax.errors import InputError, check_class
from pcm_jax.graph.copies import counted_once
from pcm_jax.graph.loop_closures import LoopClosures
from pcm_jax.graph.multi_robot import MultiRobotGraph
from pcm_jax.graph.pose_graph import PoseGraph
from pcm_jax.graph.priors import Priors
from pcm_jax.graph.spanning_tree import check_connected


def split(pose_graph: PoseGraph, at: int | Sequence[int]) -> MultiRobotGraph:
    """Cuts a pose graph before each of the poses `at`, into robots a, b, c and so on.

        sessions = pcm_jax.split(pcm_jax.read_graph("trajectory.g2o").maps[0], [150])

    Edges inside a piece stay in its map; edges between pieces become loop closures, in the graph's
    order and orientation, each once however often the graph states it; edges between the two poses
    next to a cut (the odometry) are dropped. Poses, ids, sources, times and priors are kept; the
    pieces' poses remain in the graph's frame.

    Args:
        pose_graph: the graph.
        at: indices of the poses that start a new robot, each in 1 … n − 1, ascending.

    Raises:
        InputError: for an index out of range or order, and for a piece that its own edges do not
            hold together.
    """
    check_class("pose_graph", pose_graph, "a PoseGraph", PoseGraph)
    n = pose_graph.num_poses
    cuts = _checked_cuts(at, n)
    start = np.concatenate([[0], cuts]).astype(np.int64)
    bounds = enumerate(pairwise([*start, n]))
    maps = tuple(_piece(pose_graph, robot, first, last) for robot, (first, last) in bounds)
    tail, head = np.asarray(pose_graph.tail), np.asarray(pose_graph.head)
    robot_of = np.searchsorted(cuts, np.arange(n), side="right")
    crossing = np.flatnonzero((robot_of[tail] != robot_of[head]) & (np.abs(tail - head) > 1))
    tail, head = tail[crossing], head[crossing]
    robot_a, robot_b = robot_of[tail], robot_of[head]
    closures = counted_once(
        LoopClosures.from_checked(
            (robot_a, tail - start[robot_a], robot_b, head - start[robot_b]),
            lie.take(lie.as_numpy(pose_graph.measurement), crossing),
            np.asarray(pose_graph.information)[crossing],
            pose_graph.source[crossing],
        )
    )[0]
    return MultiRobotGraph(maps, closures)


def stretch(pose_graph: PoseGraph, first: int, last: int) -> PoseGraph:
    """The map of poses `first` … `last` − 1 and the edges between them, in their order."""
    ends = np.stack([np.asarray(pose_graph.tail), np.asarray(pose_graph.head)])
    inside = np.flatnonzero(((ends >= first) & (ends < last)).all(axis=0))
    tail, head = ends[:, inside] - first
    return PoseGraph.from_checked(
        poses=lie.take(lie.as_numpy(pose_graph.poses), slice(first, last)),
        tail=tail,
        head=head,
        measurement=lie.take(lie.as_numpy(pose_graph.measurement), inside),
        information=np.asarray(pose_graph.information)[inside],
        ids=pose_graph.ids[first:last],
        name=pose_graph.name,
        source=pose_graph.source[inside],
        stamps=None if pose_graph.stamps is None else pose_graph.stamps[first:last],
        priors=_priors_within(pose_graph, first, last),
    )


def _piece(pose_graph: PoseGraph, robot: int, first: int, last: int) -> PoseGraph:
    """A stretch that holds together, as a robot's map."""
    one = stretch(pose_graph, first, last)
    ids = one.ids
    try:
        check_connected(np.asarray(one.tail), np.asarray(one.head), len(ids), ids=ids)
    except InputError as error:
        raise InputError(
            f"at: piece {robot + 1} (poses {ids[0]} to {ids[-1]}) cannot be a map: {error}"
        ) from None
    return dataclasses.replace(one, name="")


def _priors_within(pose_graph: PoseGraph, first: int, last: int) -> Priors | None:
    priors = pose_graph.priors
    if priors is None:
        return None
    rows = np.flatnonzero((priors.pose >= first) & (priors.pose < last))
    return priors[rows].shifted(-first) if len(rows) else None


def _checked_cuts(at: Any, n: int) -> np.ndarray:
    cuts = np.atleast_1d(as_array(at, "at"))
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
