"""`merge`: from a graph or its evidence to one map per group of robots; all four steps."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from pcm_jax.arrays import as_array, on_host
from pcm_jax.consistency import Evidence, chi2_gate
from pcm_jax.errors import InputError, check_number
from pcm_jax.graph import LoopClosures, MultiRobotGraph
from pcm_jax.merging.compile_time import CompileClock
from pcm_jax.merging.merged import regroup, solve_groups
from pcm_jax.merging.refine import REFINEMENTS
from pcm_jax.merging.refine import refine as refined_merge
from pcm_jax.merging.result import MergeResult
from pcm_jax.merging.robust import ROBUST_METHODS, solve_robustly
from pcm_jax.merging.robust.methods import check_robust_options
from pcm_jax.pipeline.select import OF_WEIGHING, check_graph, select
from pcm_jax.pipeline.stages import STAGES, Progress, silent
from pcm_jax.pipeline.weigh import optimized_maps
from pcm_jax.selection.choose import Method, check_method, name_of
from pcm_jax.selection.weights import check_weights

EVERYTHING = "all"
GIVEN = "given"
CONFIDENCE = 0.99
MINIMUM = 2
OF_ROBUST = ("confidence", "minimum_inliers")


@on_host
def merge(
    graph: MultiRobotGraph | Evidence,
    *,
    method: Method = "pcm-exact",
    confidence: float | None = None,
    accepted: Any = None,
    minimum_inliers: int | str | None = None,
    significance: float | None = None,
    separation: float | None = None,
    on_ambiguous: str | None = None,
    prefer: str | None = None,
    seed: int | None = None,
    time_limit: float | None = None,
    room_for: Any = None,
    solver: str | None = None,
    engine: str = "blocks",
    refine: str | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> MergeResult:
    """Merges the robots' maps by the closures that a method accepts.

    Priors of the maps (`PoseGraph.priors`) enter their own optimum and the merged one, whose frame
    is then theirs. Priors of several robots are used together where the accepted closures allow
    that they are in one frame (see `merging._frames`); robust methods take that for granted.

    A clique of n right closures needs all n(n − 1)/2 pairs to pass the gate, so the more right ones
    there are, the larger a part of them is left out. Of City10000's, calibrated, it keeps 94 % of
    100, 88 % of 1,000 and 84 % of 4,826 at 99 %; at 90 % 63 % of 100 and 56 % of 1,000.
    `refine="recall"` brings these to 99 % and 91 to 92 %: the merged map says of each by itself
    whether it agrees, with the covariance that it has where it ends (`MergeResult.recalled`,
    `.refinement`). That joins no robots and parts none, and false closures that come back let in
    no further ones: `merging.refine` states by which tests. It costs some solves of the merged map.
    `refine="gnc"` may also drop closures, and loops inside the maps: about one in a hundred right
    ones, and many where odometry states its noise too small. Neither is the default: recall lets
    in false closures that happen to agree, and graduated non-convexity loses on such odometry.

        result = pcm_jax.merge(graph)
        result.accepted, result.anchors, result.groups
        evidence = pcm_jax.weigh(graph)                     # or weigh once, and ask again
        strict = pcm_jax.merge(evidence, confidence=0.9)

    Args:
        graph: at least two maps and candidate closures between them, or what `weigh` found of them.
        method: a selection method (see `select_from`), by name or as a function
            `(evidence, gate) -> bool [k]`; "all": every closure is accepted; or a robust one,
            "dcs", "gnc", "switchable" or "max-mixture", which keeps all closures in the solve with
            information scaled by how well they fit (see `merging.robust`).
        confidence: probability that the loop of two right closures passes the gate; of a robust
            method, that one right closure does; 0.99 by default.
        accepted: bool `[m]` or indices: the closures to use instead of selecting any.
        minimum_inliers: when a pair of robots is merged: "chance", the default: if closures of
            which none is right would hardly agree as well, see `select`; or a number: if that many
            closures are accepted. Of robust methods a number, 2 by default.
        significance: with "chance": the probability that any pair of robots is merged none of whose
            closures is right; 0.01 by default.
        separation: metres along the way of either robot between closures that are two witnesses.
        on_ambiguous: with "chance": "split", the default: two robots are not merged where another
            alignment is supported about as well; "largest": they are, by the larger set.
        prefer: with "largest", what counts first, "places" or "closures", see `select`.
        seed: of the shuffles that "chance" makes; 0 by default.
        time_limit: seconds for each robot pair's clique.
        room_for: bool `[m]` or indices: closures for which the merged map's symbolic plan has room
            besides those accepted. Merges of one graph by different closures share one plan if
            all of these are named in each; the results differ by rounding alone. A plan with room
            for false closures is large: name what some merge accepts, not every candidate.
        solver: "gauss-newton" or "levenberg-marquardt", for the merged map; by default the
            first, and the second for robust methods.
        engine: "blocks" or "cholmod", for the merged map.
        refine: "recall": closures between joined robots that were left out, but agree with the
            merged map, come back; "gnc": before that, graduated non-convexity judges all of them,
            and the loops inside the maps (of odometry, see `select_within`), from the merged map.
            See below. With a method that selects, or `accepted`.
        progress: called with a stage ("optimize", "consistency", "clique", "merge", "refine"), how
            many of its parts are done, and how many there are.
        **options: the method's own; of a graph also `optimized` (whether the maps are at their
            optimum already), and where something is selected `metric` and `memory_limit`, see
            `weigh`. Robust methods have `initial`, where the maps start: "identity" (first poses
            coincide) or "closures"; `anchors`, Lie `[robots]`, to start there instead; `phi`
            (dcs), `prior` (switchable), `null_scale`, `null_weight` (max-mixture).

    Returns:
        Merged maps, anchors, groups, what was accepted and why; float64, NumPy.

    Raises:
        InputError: for fewer than two maps, no closures, an unknown method or option, an argument
            that the method cannot use, and what selecting raises.

    Warns:
        ConvergenceWarning: for a map, or a merged map, that did not converge.
        InputWarning: for priors that are not in the frame of the group's first ones and are left
            out, or that leave a motion of the whole map free.
    """
    check_graph(graph)
    given = graph.graph if isinstance(graph, Evidence) else graph
    _check(given)
    asked = {"confidence": confidence, "minimum_inliers": minimum_inliers}
    of_selecting = {
        "significance": significance,
        "separation": separation,
        "on_ambiguous": on_ambiguous,
        "prefer": prefer,
        "seed": seed,
        "time_limit": time_limit,
    }
    asked |= {name: value for name, value in of_selecting.items() if value is not None}
    kind = _checked(method, accepted, asked, options, room_for is not None, refine)
    tell = progress or silent
    with CompileClock() as compiling:
        if kind == "select":
            chosen = _selected(graph, method, asked, options, progress)
        else:
            chosen = _unselected(graph, options, tell, _mask("accepted", accepted, given))
        own = MultiRobotGraph(chosen.maps, given.closures)
        start = time.perf_counter()
        tell("merge", 0, 1)
        gate, robust, refinement = chosen.gate, None, None
        if kind == "robust":
            check_weights(method, given)
            _check_all_said(method, given.closures)
            gate = float(chi2_gate(_or(confidence, CONFIDENCE), given.tangent_dim))
            names = {"method": method, "solver": solver or "levenberg-marquardt", "engine": engine}
            robust = solve_robustly(own, gate=gate, **names, **options)  # type: ignore[arg-type]
            mask = _enough(own.closures, robust.accepted, _or(minimum_inliers, MINIMUM))
            solved = regroup(own, mask, robust)
        else:
            mask = chosen.accepted
            room = mask | _mask("room_for", room_for, given, none=False)
            how: dict[str, Any] = {"solver": solver or "gauss-newton", "engine": engine}
            solved = solve_groups(own, mask, room, **how)
        tell("merge", 1, 1)
        seconds = chosen.seconds | {"merge": time.perf_counter() - start}
        if refine is not None:
            start = time.perf_counter()
            tell("refine", 0, 1)
            level = _or(confidence, CONFIDENCE)
            refined = refined_merge(own, solved, mask, mode=refine, confidence=level, engine=engine)
            mask, refinement = refined.accepted, refined.refinement
            solved = solve_groups(refined.graph, mask, mask, own=own, **how)
            gate = float(chi2_gate(level, given.tangent_dim))
            tell("refine", 1, 1)
            seconds["refine"] = time.perf_counter() - start
    seconds["compile"] = compiling.seconds
    return MergeResult(
        graph=MultiRobotGraph(solved.maps, given.closures[mask]),
        candidates=given.closures,
        accepted=mask,
        anchors=solved.anchors,
        solution=solved.solution,
        groups=solved.groups,
        selection=chosen.selection,
        maps=chosen.maps,
        method=GIVEN if accepted is not None else name_of(method),
        confidence=None if gate is None else _or(confidence, CONFIDENCE),
        gate=gate,
        seconds=seconds,
        robust=robust,
        refinement=refinement,
    )


def _check_all_said(method: Any, closures: LoopClosures) -> None:
    """Raises `InputError` for singular information, of whose rank a robust method knows nothing."""
    lacking = int((closures.rank < closures.tangent_dim).sum())
    if lacking:
        raise InputError(
            f"method: {method!r} with {lacking} closures of singular information, expected a"
            ' selection method (or repair="clip" on reading)'
        )


def _or(value: Any, default: Any) -> Any:
    return default if value is None else value


def _checked(
    method: Method,
    accepted: Any,
    asked: dict[str, Any],
    options: dict[str, Any],
    room: bool,
    refine: str | None,
) -> str:
    """The kind of merge: "select", "robust" or "fixed"; every argument is one that it can use."""
    if refine is not None and refine not in REFINEMENTS:
        raise InputError(f"refine: {refine!r}, expected one of {', '.join(REFINEMENTS)}, or None")
    if isinstance(method, str) and method in ROBUST_METHODS and accepted is None:
        own = {name: value for name, value in options.items() if name != "optimized"}
        check_robust_options(method, own)
        refused = [n for n in asked if n not in OF_ROBUST] + ["room_for"] * room
        refused += ["refine"] * (refine is not None)
        if isinstance(asked["minimum_inliers"], str):
            raise InputError(
                f"minimum_inliers: {asked['minimum_inliers']!r} given with method {method!r},"
                " expected a number"
            )
        kind, what = "robust", ""
    elif accepted is not None or method == EVERYTHING:
        if not isinstance(method, str) or method not in (*ROBUST_METHODS, EVERYTHING):
            check_method(method, {}, (*ROBUST_METHODS, EVERYTHING))
        refused = [name for name, value in asked.items() if value is not None]
        refused += [name for name in options if name != "optimized"]
        if refine is not None and accepted is None:
            refused.append("refine")
        elif refine is not None and "confidence" in refused:
            refused.remove("confidence")
        kind = "fixed"
        what = "accepted=" if accepted is not None else f"method {EVERYTHING!r}"
    else:
        own = {name: value for name, value in options.items() if name not in OF_WEIGHING}
        limit = {name: value for name, value in asked.items() if name == "time_limit"}
        check_method(method, own | limit, (*ROBUST_METHODS, EVERYTHING))
        return "select"
    for name in refused:
        if kind == "robust":
            raise InputError(f"{name}: not an option of method {method!r}")
        raise InputError(f"{name}: not an option that goes with {what}")
    return kind


class _Chosen(NamedTuple):
    """The state before the maps are merged."""

    maps: tuple[Any, ...]
    accepted: Bool[np.ndarray, " m"]
    selection: Any
    gate: float | None
    seconds: dict[str, float]


def _selected(
    graph: MultiRobotGraph | Evidence,
    method: Method,
    asked: dict[str, Any],
    options: dict[str, Any],
    progress: Progress | None,
) -> _Chosen:
    known = {name: value for name, value in asked.items() if value is not None}
    chosen = select(graph, method=method, progress=progress, **known, **options)
    return _Chosen(chosen.maps, chosen.accepted, chosen, chosen.gate, dict(chosen.seconds))


def _unselected(
    graph: MultiRobotGraph | Evidence, options: dict[str, Any], tell: Progress, accepted: Any
) -> _Chosen:
    """The optimised maps alone; takes `optimized` out of the options."""
    seconds: dict[str, float] = dict.fromkeys(STAGES, 0.0)
    if isinstance(graph, Evidence):
        if "optimized" in options:
            raise InputError("optimized: given with evidence, expected with a graph")
        return _Chosen(graph.maps, accepted, None, None, seconds)
    start = time.perf_counter()
    maps = optimized_maps(graph.maps, options.pop("optimized", False), tell)
    seconds["optimize"] = time.perf_counter() - start
    return _Chosen(maps, accepted, None, None, seconds)


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


def _mask(
    name: str, given: Any, graph: MultiRobotGraph, *, none: bool = True
) -> Bool[np.ndarray, " m"]:
    """The mask of a mask or of indices of closures; `none` everywhere for None."""
    count = len(graph.closures)
    if given is None:
        return np.full(count, none)
    chosen = as_array(given, name)
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


def _enough(closures: LoopClosures, accepted: np.ndarray, minimum: int) -> np.ndarray:
    """Without the closures of robot pairs that accept fewer than the minimum."""
    check_number("minimum_inliers", minimum)
    if minimum < 0:
        raise InputError(f"minimum_inliers: {minimum}, expected at least 0")
    kept = accepted.copy()
    for a, b in closures.pairs():
        _, indices = closures.between(a, b)
        kept[indices] &= np.count_nonzero(accepted[indices]) >= minimum
    return kept
