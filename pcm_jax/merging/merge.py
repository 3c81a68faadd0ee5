"""`merge`: from a multi-robot graph to one map per group of robots (the paper, all four steps)."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.mapping import Solution
from pcm_jax.merging.alignment import aligned_anchors
from pcm_jax.merging.compile_time import CompileClock
from pcm_jax.merging.groups import robot_groups
from pcm_jax.merging.joint import joint_graph, solve_joint
from pcm_jax.merging.result import MergeResult, MergeSolution
from pcm_jax.precision import in_float64
from pcm_jax.selection import Selection, select
from pcm_jax.selection.robot_pairs import optimized_maps

EVERYTHING = "all"


@in_float64
def merge(
    graph: MultiRobotGraph,
    *,
    method: str = "pcm-exact",
    confidence: float = 0.99,
    inliers: Any = None,
    optimized: bool = False,
    minimum_inliers: int = 2,
    time_limit: float | None = None,
    solver: str = "gauss-newton",
    engine: str = "blocks",
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> MergeResult:
    """Merges the robots' maps by the closures that a method accepts.

    Args:
        graph: at least two maps, and candidate closures between them.
        method: a selection method (see `select_from`), or "all": every closure is accepted.
        confidence: probability that the loop of two right closures passes the gate.
        inliers: bool `[m]` or indices: the closures to use instead of selecting any.
        optimized: whether the maps are at their optimum already.
        minimum_inliers: a pair of robots that accepts fewer closures accepts none.
        time_limit: seconds for each robot pair's clique.
        solver: "gauss-newton" or "levenberg-marquardt", for the merged map.
        engine: "blocks" or "cholmod", for the merged map.
        progress: called with a line of text when a stage begins.
        **options: the selection method's own.

    Returns:
        Merged maps, anchors, groups, what was accepted and why.

    Raises:
        InputError: for fewer than two maps, no closures, and what selecting raises.
    """
    _check(graph)
    tell = progress or (lambda text: None)
    with CompileClock() as compiling:
        if inliers is not None or method == EVERYTHING:
            accepted = _given(inliers, len(graph.closures))
            method = EVERYTHING if inliers is None else "given"
            start = time.perf_counter()
            tell(f"optimising {len(graph.maps)} maps")
            maps, selection = optimized_maps(graph.maps, optimized), None
            seconds = dict.fromkeys(("optimize", "marginals", "consistency", "clique"), 0.0)
            seconds["optimize"] = time.perf_counter() - start
        else:
            selection = _select(
                graph, method, confidence, optimized, minimum_inliers, time_limit, tell, options
            )
            accepted, maps = selection.inliers, selection.maps
            seconds = dict(selection.seconds)
        start = time.perf_counter()
        tell(f"merging with {int(accepted.sum())} of {len(accepted)} closures")
        merged, anchors, solution, groups = _solve(
            MultiRobotGraph(maps, graph.closures), accepted, solver, engine
        )
    seconds |= {"merge": time.perf_counter() - start, "compile": compiling.seconds}
    return MergeResult(
        merged, accepted, anchors, solution, groups, selection, maps, method, seconds
    )


def _select(
    graph: MultiRobotGraph,
    method: str,
    confidence: float,
    optimized: bool,
    minimum_inliers: int,
    time_limit: float | None,
    tell: Callable[[str], None],
    options: dict[str, Any],
) -> Selection:
    tell(f"selecting among {len(graph.closures)} closures")
    return select(
        graph,
        method=method,
        confidence=confidence,
        optimized=optimized,
        minimum_inliers=minimum_inliers,
        time_limit=time_limit,
        **options,
    )


def _check(graph: MultiRobotGraph) -> None:
    if len(graph.maps) < 2:
        raise InputError(
            f"graph: one robot ({graph.names[0]!r}) given, expected at least two maps to merge;"
            " split(pose_graph, at) cuts one trajectory into several (--split on the command line)"
        )
    if len(graph.closures) == 0:
        raise InputError(
            f"graph: {len(graph.maps)} robots but no closure between them, expected at least one"
            " (from edges between robots, or a file of candidates: closures=, --closures)"
        )


def _given(inliers: Any, count: int) -> np.ndarray:
    """The mask of a mask or of indices; all, where None."""
    if inliers is None:
        return np.ones(count, bool)
    chosen = np.asarray(inliers)
    if chosen.dtype == bool:
        if chosen.shape != (count,):
            raise InputError(f"inliers: shape {chosen.shape}, expected [{count}], one per closure")
        return chosen.copy()
    mask = np.zeros(count, bool)
    if chosen.size == 0:
        return mask
    if chosen.dtype.kind not in "iu" or chosen.ndim != 1:
        raise InputError(f"inliers: dtype {chosen.dtype}, expected bool [m] or integer indices")
    outside = chosen[(chosen < 0) | (chosen >= count)]
    if outside.size:
        raise InputError(f"inliers: index {outside[0]}, expected 0 … {count - 1}")
    mask[chosen] = True
    return mask


def _solve(
    graph: MultiRobotGraph, accepted: np.ndarray, solver: str, engine: str
) -> tuple[MultiRobotGraph, Any, MergeSolution, tuple[tuple[int, ...], ...]]:
    """Aligns and solves every group; puts the poses back into the robots' maps."""
    groups = robot_groups(len(graph.maps), graph.closures, accepted)
    start = aligned_anchors(graph, accepted, groups)
    poses: list[Any] = [None] * len(graph.maps)
    solutions, rows, columns = [], 0, 0
    robot_of = np.asarray(graph.closures.robot_a)
    for members in groups:
        used = np.flatnonzero(accepted & np.isin(robot_of, members))
        joint = joint_graph(graph, members, used, start)
        solution = solve_joint(joint, len(used), method=solver, engine=engine)
        solutions.append(solution)
        rows += joint.num_edges
        columns += joint.num_poses - 1
        merged, first = lie.as_numpy(solution.graph.poses), 0
        if len(members) == 1:  # at its optimum already, and to stay as it is
            merged = lie.as_numpy(graph.maps[members[0]].poses)
        for robot in members:
            size = graph.maps[robot].num_poses
            poses[robot] = lie.take(merged, slice(first, first + size))
            first += size
    anchors = lie.stack(
        [
            lie.compose(lie.take(new, 0), lie.inverse(lie.take(lie.as_numpy(own.poses), 0)))
            for new, own in zip(poses, graph.maps, strict=True)
        ]
    )
    placed = [
        own.with_poses(lie.as_device(new)) for own, new in zip(graph.maps, poses, strict=True)
    ]
    freedom = (rows - columns) * graph.tangent_dim
    merged_graph = MultiRobotGraph(tuple(placed), graph.closures)
    return merged_graph, lie.as_device(anchors), _summary(solutions, freedom), groups


def _summary(solutions: list[Solution], freedom: int) -> MergeSolution:
    cost = sum(solution.cost for solution in solutions)
    return MergeSolution(
        cost=cost,
        initial_cost=sum(solution.initial_cost for solution in solutions),
        normalized_chi2=2.0 * cost / freedom if freedom > 0 else None,
        iterations=sum(solution.iterations for solution in solutions),
        converged=all(solution.converged for solution in solutions),
    )
