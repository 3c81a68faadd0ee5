"""The maps merged by the closures that are believed now, from where they were merged last.

A solve starts where the one before ended, pose by pose; poses that have come since are where their
own map has them from the last one of before. Robots that join a group are put there by their
closures (`aligned_anchors`), and so is a group that is parted. Of the two starts, that and the one
of a merge anew, a group takes the better, by cost: an answer that has turned over is not solved
from where the wrong one ended. What is solved is the same, so the optimum is.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph import MultiRobotGraph, PoseGraph
from pcm_jax.mapping.optimization import problem_of
from pcm_jax.merging import MergeResult
from pcm_jax.merging.alignment import aligned_anchors
from pcm_jax.merging.groups import closures_within, robot_groups
from pcm_jax.merging.joint import gone_on, joint_graph
from pcm_jax.merging.merged import solve_groups
from pcm_jax.selection import Selection

OF_MERGING = ("solver", "engine", "refine", "progress")


def merged_by(
    selection: Selection, options: dict[str, Any], last: MergeResult | None
) -> MergeResult:
    """Merges the maps of an answer, as `merge` of the same graph does.

    Args:
        selection: the answer.
        options: `solver`, `engine`, `refine` and `progress` of `merge`.
        last: how robots of the same order, or the first of them, were merged before.

    Raises:
        InputError: as `merge`, and for other options.
    """
    from pcm_jax.pipeline import merge

    for name in options:
        if name not in OF_MERGING:
            expected = ", ".join(OF_MERGING)
            raise InputError(f"{name}: not an option of merge here, expected one of {expected}")
    if options.get("refine") is not None:
        options = {**options, "confidence": selection.confidence}
    evidence, accepted = selection.evidence, selection.accepted
    own = MultiRobotGraph(evidence.maps, evidence.graph.closures)
    if last is None or options.get("refine") or not _may_be_warm(own):
        merged = merge(evidence, accepted=accepted, **options)
    else:
        merged = _from_last(own, accepted, options, last)
    return dataclasses.replace(
        merged,
        selection=selection,
        method=selection.method,
        confidence=selection.confidence,
        gate=selection.gate,
        seconds=merged.seconds | selection.seconds,
    )


def _may_be_warm(own: MultiRobotGraph) -> bool:
    """True where the frames of groups are the robots' own: without priors, for a merge at all."""
    plain = all(one.priors is None or not len(one.priors) for one in own.maps)
    return plain and len(own.maps) > 1 and len(own.closures) > 0


def _from_last(
    own: MultiRobotGraph,
    accepted: Bool[np.ndarray, " m"],
    options: dict[str, Any],
    last: MergeResult,
) -> MergeResult:
    tell = options.get("progress") or (lambda *_: None)
    start = time.perf_counter()
    tell("merge", 0, 1)
    groups = robot_groups(len(own.maps), own.closures, accepted)
    anchors = aligned_anchors(own, accepted, groups)
    placed = list(own.maps)
    for members in groups:
        for robot, one in zip(members, _placed(own, accepted, anchors, members, last), strict=True):
            placed[robot] = one
    how = {
        "solver": options.get("solver") or "gauss-newton",
        "engine": options.get("engine") or "blocks",
    }
    there = MultiRobotGraph(tuple(placed), own.closures)
    solved = solve_groups(there, accepted, accepted, own=own, **how)
    tell("merge", 1, 1)
    return dataclasses.replace(
        last,
        graph=MultiRobotGraph(solved.maps, own.closures[accepted]),
        candidates=own.closures,
        accepted=accepted,
        anchors=solved.anchors,
        solution=solved.solution,
        groups=solved.groups,
        maps=own.maps,
        seconds={"merge": time.perf_counter() - start},
        robust=None,
        refinement=None,
    )


def _placed(
    own: MultiRobotGraph,
    accepted: Bool[np.ndarray, " m"],
    anchors: Any,
    members: Sequence[int],
    last: MergeResult,
) -> list[PoseGraph]:
    """The maps of a group in its frame: where they were, or where their closures put them."""
    anew = [
        own.maps[robot].with_poses(
            lie.compose(lie.take(anchors, robot), lie.as_numpy(own.maps[robot].poses))
        )
        for robot in members
    ]
    together = any(set(members) <= set(group) for group in last.groups)
    if len(members) == 1 or not together:
        return anew
    were = [gone_on(last.graph.maps[robot].poses, own.maps[robot].poses) for robot in members]
    first = lie.take(lie.as_numpy(own.maps[members[0]].poses), 0)
    back = lie.compose(first, lie.inverse(lie.take(were[0], 0)))
    before = [
        own.maps[robot].with_poses(lie.compose(back, poses))
        for robot, poses in zip(members, were, strict=True)
    ]
    used = closures_within(tuple(members), own.closures, accepted)
    costs = [_cost(own, members, used, maps) for maps in (before, anew)]
    return before if costs[0] <= costs[1] else anew


def _cost(
    own: MultiRobotGraph, members: Sequence[int], used: Any, maps: Sequence[PoseGraph]
) -> float:
    """0.5 Σ rᵀΩr of a group's edges and closures."""
    placed = list(own.maps)
    for robot, one in zip(members, maps, strict=True):
        placed[robot] = one
    here = lie.identity(own.group, (len(placed),))
    joint = joint_graph(MultiRobotGraph(tuple(placed), own.closures), members, used, here)
    return problem_of(joint).cost(joint.poses)
