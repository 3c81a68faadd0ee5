"""Every group of robots at its optimum, and its poses back in the robots' maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from pcm_jax import lie
from pcm_jax.graph import MultiRobotGraph, PoseGraph
from pcm_jax.mapping import Solution
from pcm_jax.mapping.priors import freedom_added
from pcm_jax.merging._frames import in_frame_of_priors, of_one_frame, with_priors
from pcm_jax.merging.alignment import aligned_anchors
from pcm_jax.merging.groups import closures_within, robot_groups
from pcm_jax.merging.joint import cut_apart, joint_graph, solve_joint
from pcm_jax.merging.result import MergeSolution
from pcm_jax.merging.robust import RobustSolution
from pcm_jax.merging.untied import untied


class Merged(NamedTuple):
    """The maps at their merged poses, and what `MergeResult` says of them."""

    maps: tuple[PoseGraph, ...]
    anchors: Any
    solution: MergeSolution
    groups: tuple[tuple[int, ...], ...]


def solve_groups(
    graph: MultiRobotGraph,
    accepted: Bool[np.ndarray, " m"],
    room: Bool[np.ndarray, " m"],
    *,
    solver: str,
    engine: str,
    own: MultiRobotGraph | None = None,
) -> Merged:
    """Aligns and solves every group; puts the poses back into the robots' maps.

    Args:
        graph: maps at their own optima and all closures; maps that lie in their groups' frames
            already, if `own` is given.
        accepted: the closures that hold.
        room: those for which the plans have room besides.
        solver, engine: of the least squares.
        own: the maps that anchors are told of, where these are not those of `graph`.
    """
    groups = robot_groups(len(graph.maps), graph.closures, accepted)
    here = lie.identity(graph.group, (len(graph.maps),))
    start = aligned_anchors(graph, accepted, groups) if own is None else here
    before = graph if own is None else own
    poses: list[Any] = [None] * len(graph.maps)
    solutions, freedom = [], 0
    for members in groups:
        planned = closures_within(members, graph.closures, room)

        def joined(
            graph: MultiRobotGraph, members: Any = members, planned: Any = planned
        ) -> Solution:
            joint = joint_graph(graph, members, planned, in_frame_of_priors(graph, members, start))
            return solve_joint(joint, accepted[planned], method=solver, engine=engine)

        graph = of_one_frame(graph, members, joined)
        solution = joined(graph)
        solutions.append(solution)
        freedom += freedom_of(solution.graph)
        merged = lie.as_numpy(solution.graph.poses)
        if len(members) == 1:  # at its optimum already, and to stay as it is
            merged = lie.as_numpy(graph.maps[members[0]].poses)
        for robot, each in cut_apart(graph, members, merged):
            poses[robot] = each
    maps, anchors = _placed(graph, poses, before)
    used = graph.closures[accepted]
    freedom -= int((used.tangent_dim - used.rank).sum())
    free = untied(MultiRobotGraph(maps, used), groups)
    freedom += sum(len(directions) for directions in free.values())
    return Merged(maps, anchors, _summary(solutions, freedom), groups)


def regroup(
    graph: MultiRobotGraph, accepted: Bool[np.ndarray, " m"], robust: RobustSolution
) -> Merged:
    """Gives robots that only rejected closures connect frames of their own again."""
    groups = robot_groups(len(graph.maps), graph.closures, accepted)
    poses: list[Any] = [lie.as_numpy(own.poses) for own in graph.maps]
    here = lie.identity(graph.group, (len(graph.maps),))
    freedom = int(accepted.sum()) * graph.tangent_dim
    none = np.zeros(0, np.int64)
    for members in groups:
        framed = bool(with_priors(graph, members))
        for one in (graph.maps[robot] for robot in members):
            freedom += (one.num_edges - one.num_poses) * graph.tangent_dim
        freedom += graph.tangent_dim + freedom_added(joint_graph(graph, members, none, here))
        if len(members) == 1:
            continue
        own, moved = poses[members[0]], lie.as_numpy(robust.maps[members[0]].poses)
        back = lie.compose(lie.take(own, 0), lie.inverse(lie.take(moved, 0)))
        back = lie.identity(graph.group) if framed else back
        for robot in members:
            poses[robot] = lie.compose(back, lie.as_numpy(robust.maps[robot].poses))
    maps, anchors = _placed(graph, poses, graph)
    return Merged(maps, anchors, _summary([robust], freedom), groups)


def freedom_of(joint: PoseGraph) -> int:
    """Degrees of freedom of a map's cost at its optimum."""
    blocks = joint.num_edges - joint.num_poses + 1
    return blocks * joint.tangent_dim + freedom_added(joint)


def _placed(
    graph: MultiRobotGraph, poses: list[Any], before: MultiRobotGraph
) -> tuple[tuple[PoseGraph, ...], Any]:
    """The maps at new poses, and the anchors that follow from the first ones before."""
    anchors = [
        lie.compose(lie.take(new, 0), lie.inverse(lie.take(lie.as_numpy(own.poses), 0)))
        for new, own in zip(poses, before.maps, strict=True)
    ]
    placed = [own.with_poses(new) for own, new in zip(graph.maps, poses, strict=True)]
    return tuple(placed), lie.stack(anchors)


def _summary(solutions: Sequence[Solution | RobustSolution], freedom: int) -> MergeSolution:
    """Sums over all groups."""
    cost = sum(solution.cost for solution in solutions)
    return MergeSolution(
        cost=cost,
        initial_cost=sum(solution.initial_cost for solution in solutions),
        normalized_chi2=2.0 * cost / freedom if freedom > 0 else None,
        iterations=sum(solution.iterations for solution in solutions),
        converged=all(solution.converged for solution in solutions),
    )
