"""`merge`: from a multi-robot graph to one map per group of robots (the paper, all four steps)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.consistency import chi2_gate
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures, MultiRobotGraph
from pcm_jax.mapping import Solution
from pcm_jax.merging._alignment import aligned_anchors
from pcm_jax.merging.compile_time import CompileClock
from pcm_jax.merging.groups import closures_within, robot_groups
from pcm_jax.merging.joint import joint_graph, solve_joint
from pcm_jax.merging.result import MergeResult, MergeSolution
from pcm_jax.merging.robust.methods import ROBUST_METHODS, check_robust_options
from pcm_jax.merging.robust.solve import RobustSolution, solve_robustly
from pcm_jax.pipeline.select import STAGES, optimized_maps, select
from pcm_jax.selection import Selection
from pcm_jax.selection.methods import ALL_METHODS

EVERYTHING = "all"
GIVEN = "given"


@on_host
def merge(
    graph: MultiRobotGraph,
    *,
    method: str = "pcm-exact",
    confidence: float = 0.99,
    accepted: Any = None,
    room_for: Any = None,
    optimized: bool = False,
    minimum_inliers: int = 2,
    time_limit: float | None = None,
    solver: str | None = None,
    engine: str = "blocks",
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> MergeResult:
    """Merges the robots' maps by the closures that a method accepts.

    Args:
        graph: at least two maps, and candidate closures between them.
        method: a selection method (see `select_from`); "all": every closure is accepted; or a
            robust one, "dcs", "gnc", "switchable" or "max-mixture", which keeps all closures in
            the solve with information scaled by how well they fit (see `merging.robust`).
        confidence: probability that the loop of two right closures passes the gate; of a robust
            method, that one right closure does.
        accepted: bool `[m]` or indices: the closures to use instead of selecting any.
        room_for: bool `[m]` or indices: closures for which the merged map's symbolic plan has room
            besides those accepted. Merges of one graph by different closures share one plan if
            all of these are named in each; the results differ by rounding alone. A plan with room
            for false closures is large: name what some merge accepts, not every candidate.
        optimized: whether the maps are at their optimum already.
        minimum_inliers: a pair of robots that accepts fewer closures accepts none.
        time_limit: seconds for each robot pair's clique.
        solver: "gauss-newton" or "levenberg-marquardt", for the merged map; by default the
            first, and the second for robust methods.
        engine: "blocks" or "cholmod", for the merged map.
        progress: called with a line of text when a stage begins.
        **options: the method's own; of a selection method also `memory_limit`, see `select`. Robust
            methods have `initial`, where the maps start: "identity" (first poses coincide) or
            "closures"; `anchors`, Lie `[robots]`, to start there instead; `phi` (dcs), `prior`
            (switchable), `null_scale`, `null_weight` (max-mixture).

    Returns:
        Merged maps, anchors, groups, what was accepted and why.

    Raises:
        InputError: for fewer than two maps, no closures, an unknown method or option, and what
            selecting raises.
    """
    _check(graph)
    method = _checked_method(method, options, time_limit, accepted)
    tell = progress or (lambda text: None)
    selection = robust = None
    with CompileClock() as compiling:
        if method in ALL_METHODS:
            selection = _select(
                graph, method, confidence, optimized, minimum_inliers, time_limit, tell, options
            )
            accepted, maps = selection.accepted, selection.maps
            seconds = dict(selection.seconds)
        else:
            start = time.perf_counter()
            tell(f"optimising {len(graph.maps)} maps")
            maps = optimized_maps(graph.maps, optimized)
            seconds = dict.fromkeys(STAGES, 0.0) | {"optimize": time.perf_counter() - start}
            everything = np.ones(len(graph.closures), bool)
            accepted = everything if accepted is None else _mask("accepted", accepted, graph)
        own = MultiRobotGraph(maps, graph.closures)
        start = time.perf_counter()
        if method in ROBUST_METHODS:
            tell(f"merging with {len(accepted)} scaled closures")
            gate = float(chi2_gate(confidence, graph.tangent_dim))
            names = {"method": method, "solver": solver or "levenberg-marquardt", "engine": engine}
            robust = solve_robustly(own, gate=gate, **names, **options)
            accepted = _enough(graph.closures, robust.accepted, minimum_inliers)
            solved = _regroup(own, accepted, robust)
        else:
            tell(f"merging with {int(accepted.sum())} of {len(accepted)} closures")
            room = accepted if room_for is None else accepted | _mask("room_for", room_for, graph)
            solved = _solve(own, accepted, room, solver or "gauss-newton", engine)
    merged, anchors, solution, groups = solved
    seconds |= {"merge": time.perf_counter() - start, "compile": compiling.seconds}
    return MergeResult(
        merged, accepted, anchors, solution, groups, selection, maps, method, seconds, robust
    )


def _checked_method(
    method: str, options: dict[str, Any], time_limit: float | None, accepted: Any
) -> str:
    """The method's name, or "given". What selection methods take is checked by `select`."""
    known = (*ALL_METHODS, *ROBUST_METHODS, EVERYTHING)
    if method not in known:
        raise InputError(f"method: {method!r}, expected one of {', '.join(known)}")
    if accepted is not None:
        method = GIVEN
    if method in ROBUST_METHODS:
        check_robust_options(method, options)
        if time_limit is not None:
            raise InputError(f"time_limit: not an option of method {method!r}")
    elif options and method not in ALL_METHODS:
        what = "accepted=" if method == GIVEN else f"method {method!r}"
        raise InputError(f"{next(iter(options))}: not an option that goes with {what}")
    return method


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
        progress=tell,
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


def _mask(name: str, given: Any, graph: MultiRobotGraph) -> np.ndarray:
    """The mask of a mask or of indices of closures."""
    count, chosen = len(graph.closures), np.asarray(given)
    if chosen.dtype == bool:
        if chosen.shape != (count,):
            raise InputError(f"{name}: shape {chosen.shape}, expected [{count}], one per closure")
        return chosen.copy()
    mask = np.zeros(count, bool)
    if chosen.size == 0:
        return mask
    if chosen.dtype.kind not in "iu" or chosen.ndim != 1:
        raise InputError(f"{name}: dtype {chosen.dtype}, expected bool [m] or integer indices")
    outside = chosen[(chosen < 0) | (chosen >= count)]
    if outside.size:
        raise InputError(f"{name}: index {outside[0]}, expected 0 … {count - 1}")
    mask[chosen] = True
    return mask


def _solve(
    graph: MultiRobotGraph, accepted: np.ndarray, room: np.ndarray, solver: str, engine: str
) -> tuple[MultiRobotGraph, Any, MergeSolution, tuple[tuple[int, ...], ...]]:
    """Aligns and solves every group; puts the poses back into the robots' maps."""
    groups = robot_groups(len(graph.maps), graph.closures, accepted)
    start = aligned_anchors(graph, accepted, groups)
    poses: list[Any] = [None] * len(graph.maps)
    solutions, rows, columns = [], 0, 0
    for members in groups:
        planned = closures_within(members, graph.closures, room)
        joint = joint_graph(graph, members, planned, start)
        solution = solve_joint(joint, accepted[planned], method=solver, engine=engine)
        solutions.append(solution)
        rows += solution.graph.num_edges
        columns += joint.num_poses - 1
        merged, first = lie.as_numpy(solution.graph.poses), 0
        if len(members) == 1:  # at its optimum already, and to stay as it is
            merged = lie.as_numpy(graph.maps[members[0]].poses)
        for robot in members:
            size = graph.maps[robot].num_poses
            poses[robot] = lie.take(merged, slice(first, first + size))
            first += size
    merged_graph, anchors = _placed(graph, poses)
    return merged_graph, anchors, _summary(graph, solutions, rows - columns), groups


def _regroup(
    graph: MultiRobotGraph, accepted: np.ndarray, robust: RobustSolution
) -> tuple[MultiRobotGraph, Any, MergeSolution, tuple[tuple[int, ...], ...]]:
    """Robots that only rejected closures connect get frames of their own again."""
    groups = robot_groups(len(graph.maps), graph.closures, accepted)
    poses: list[Any] = [lie.as_numpy(own.poses) for own in graph.maps]
    for members in groups:
        if len(members) == 1:
            continue
        own, moved = poses[members[0]], lie.as_numpy(robust.maps[members[0]].poses)
        back = lie.compose(lie.take(own, 0), lie.inverse(lie.take(moved, 0)))
        for robot in members:
            poses[robot] = lie.compose(back, lie.as_numpy(robust.maps[robot].poses))
    rows = sum(own.num_edges for own in graph.maps) + int(accepted.sum())
    columns = sum(own.num_poses for own in graph.maps) - len(groups)
    merged_graph, anchors = _placed(graph, poses)
    return merged_graph, anchors, _summary(graph, [robust], rows - columns), groups


def _placed(graph: MultiRobotGraph, poses: list[Any]) -> tuple[MultiRobotGraph, Any]:
    """The maps at new poses, and the anchors that follow from their first ones."""
    anchors = [
        lie.compose(lie.take(new, 0), lie.inverse(lie.take(lie.as_numpy(own.poses), 0)))
        for new, own in zip(poses, graph.maps, strict=True)
    ]
    placed = [own.with_poses(new) for own, new in zip(graph.maps, poses, strict=True)]
    return MultiRobotGraph(tuple(placed), graph.closures), lie.stack(anchors)


def _enough(closures: LoopClosures, accepted: np.ndarray, minimum: int) -> np.ndarray:
    """Without the closures of robot pairs that accept fewer than the minimum."""
    if minimum < 0:
        raise InputError(f"minimum_inliers: {minimum}, expected at least 0")
    kept = accepted.copy()
    for a, b in closures.pairs():
        _, indices = closures.between(a, b)
        kept[indices] &= np.count_nonzero(accepted[indices]) >= minimum
    return kept


def _summary(
    graph: MultiRobotGraph, solutions: Sequence[Solution | RobustSolution], blocks: int
) -> MergeSolution:
    """Of all groups; `blocks` are edges less free poses."""
    cost = sum(solution.cost for solution in solutions)
    freedom = blocks * graph.tangent_dim
    return MergeSolution(
        cost=cost,
        initial_cost=sum(solution.initial_cost for solution in solutions),
        normalized_chi2=2.0 * cost / freedom if freedom > 0 else None,
        iterations=sum(solution.iterations for solution in solutions),
        converged=all(solution.converged for solution in solutions),
    )
