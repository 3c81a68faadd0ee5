"""Frames of groups whose maps have priors: whose they are, and whether they are one.

Priors hold in their map's own frame. Where several maps of a group have priors (GPS, say), the
frame may be one for all, and then all priors are used; or each robot has a prior on its first pose
that only stands for its own gauge. The closures tell: with the priors of the first such robot alone
every other map comes to lie at P, by its own priors it lies at X, and in one frame

    Log(X⁻¹ P)ᵀ (Σ_P + Σ_X)⁻¹ Log(X⁻¹ P)

is at most chi-squared with d degrees of freedom (the two share the map's own measurements, so their
sum is more than their difference's covariance). Priors that leave a motion of their map free are
taken as they are.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pcm_jax import lie
from pcm_jax.consistency import chi2_gate
from pcm_jax.errors import InputWarning
from pcm_jax.graph import MultiRobotGraph, PoseGraph
from pcm_jax.mapping import MapCovariance, Solution
from pcm_jax.mapping.priors import free_directions, priors_of
from pcm_jax.merging.joint import cut_apart

CONTRADICTED = 1.0 - 1e-6
"""Mass of chi-squared beyond which two frames are not one."""


def with_priors(graph: MultiRobotGraph, members: Sequence[int]) -> list[int]:
    """The robots of a group whose maps have priors."""
    return [robot for robot in members if priors_of(graph.maps[robot]) is not None]


def in_frame_of_priors(graph: MultiRobotGraph, members: Sequence[int], anchors: Any) -> Any:
    """Anchors `[robots]` in the frame of the group's first robot with priors, if there is one."""
    known = with_priors(graph, members)
    if not known:
        return anchors
    back = lie.inverse(lie.take(anchors, known[0]))
    return lie.stack(
        [
            lie.compose(back, lie.take(anchors, robot))
            if robot in members
            else lie.take(anchors, robot)
            for robot in range(len(graph.maps))
        ]
    )


def without_priors(graph: MultiRobotGraph, robots: Sequence[int]) -> MultiRobotGraph:
    """The same graph, the priors of some robots left out."""
    maps = [
        own.without_priors() if robot in robots else own for robot, own in enumerate(graph.maps)
    ]
    return MultiRobotGraph(tuple(maps), graph.closures, graph.truth)


def of_one_frame(
    graph: MultiRobotGraph,
    members: Sequence[int],
    solve: Callable[[MultiRobotGraph], Solution],
) -> MultiRobotGraph:
    """The graph with those priors of a group that can be in the frame of its first ones.

    Args:
        graph: optimised maps and all closures.
        members: the group's robots.
        solve: merges the group by the priors of the graph that it is given.

    Warns:
        InputWarning: for priors that are left out.
    """
    known = with_priors(graph, members)
    if len(known) < 2:
        return graph
    first, *others = known
    solution = solve(without_priors(graph, others))
    covariance, apart = MapCovariance(solution.graph), []
    starts = dict(
        zip(members, np.cumsum([0, *(graph.maps[r].num_poses for r in members[:-1])]), strict=True)
    )
    placed = dict(cut_apart(graph, members, lie.as_numpy(solution.graph.poses)))
    for robot in others:
        squared = _distance(graph.maps[robot], placed[robot], covariance, int(starts[robot]))
        if squared > float(chi2_gate(CONTRADICTED, graph.tangent_dim)):
            apart.append(robot)
            warnings.warn(
                InputWarning(
                    f"map {graph.names[robot]!r}: its priors are left out: they are not in the"
                    f" frame of those of map {graph.names[first]!r}, or the accepted closures"
                    f" contradict both (chi-squared {squared:.3g} of {graph.tangent_dim})"
                ),
                stacklevel=4,
            )
    return without_priors(graph, apart)


def _distance(own: PoseGraph, placed: Any, joint: MapCovariance, start: int) -> float:
    """Chi-squared of a map's place by the first priors and by its own; 0 if these leave it free."""
    priors = priors_of(own)
    if priors is None or free_directions(priors, own.poses)[0].shape[1]:
        return 0.0
    pose = np.array([priors.pose[len(priors) // 2]], np.int64)
    covariance = joint.diagonal(pose + start)[0] + MapCovariance(own).diagonal(pose)[0]
    here = lie.take(lie.as_numpy(own.poses), pose)
    apart = np.asarray(lie.log(lie.between(here, lie.take(placed, pose))))[0]
    return float(apart @ np.linalg.solve(covariance, apart))
