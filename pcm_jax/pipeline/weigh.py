"""`weigh`: steps i and ii for every pair of robots, once."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.consistency import (
    Evidence,
    PackedGraph,
    PairEvidence,
    problem_from_covariances,
    stream_from_covariances,
    weighed_on_host,
)
from pcm_jax.consistency.evidence import checked_squared
from pcm_jax.consistency.problem import bytes_needed, check_pair
from pcm_jax.errors import (
    ConvergenceWarning,
    InputError,
    InputWarning,
    check_class,
    check_number,
)
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph
from pcm_jax.mapping import MapCovariance, optimize
from pcm_jax.mapping.optimization import problem_of
from pcm_jax.pipeline.stages import Progress, StopWatch, silent

MEMORY_LIMIT = 2e9
"""Bytes for the distances between two robots' closures."""

Metric = Callable[[PoseGraph, PoseGraph, LoopClosures], Float[np.ndarray, "k k"]]
"""A function of one's own: squared distances of the closures, all from map a to map b."""

AT_REST, AT_REST_SHARE = 1.0, 0.01
"""Change of a map's chi-squared by one more step that is no matter, and its share of the whole."""
MAHALANOBIS = "mahalanobis"


@on_host
def weigh(
    graph: MultiRobotGraph,
    *,
    metric: str | Metric | None = None,
    optimized: bool = False,
    memory_limit: float = MEMORY_LIMIT,
    progress: Progress | None = None,
) -> Evidence:
    """Weighs the closures of every pair of robots against each other: steps i and ii of the paper.

    Each map is optimised and factorised once; the joint covariance of the poses that a pair's
    closures touch gives the squared Mahalanobis distances of all pairs of closures. `select` and
    `merge` take the result in place of the graph, so that asking again with another gate or method
    costs neither.

        evidence = pcm_jax.weigh(graph)
        for confidence in (0.5, 0.9, 0.99):
            print(confidence, pcm_jax.select(evidence, confidence=confidence).accepted.sum())

    Args:
        graph: the robots' maps and the closures between them.
        metric: None or "mahalanobis": the loop error of eq. 4. Or a function of one's own,
            `metric(map_a, map_b, closures) -> [k, k]`, of optimised maps and closures that all run
            from a to b: anything that falls below a gate where two closures agree.
        optimized: whether the maps are at their optimum already.
        memory_limit: bytes for the distances between two robots' closures. Where they take more (at
            2 GB from about 1,500 closures in space or 2,900 in the plane on, all at poses of their
            own), `PairEvidence` has no `squared`; its graph is found panel by panel when a gate is
            known (`stream_consistency_graph`).
        progress: called with a stage ("optimize", "consistency"), how many of its parts are done,
            and how many there are.

    Returns:
        The evidence; float64, on the host, whatever the caller's settings.

    Raises:
        InputError: for another metric, a limit that is no number, what optimising the maps
            raises, and a metric's result of another shape.

    Warns:
        ConvergenceWarning: for a map whose optimisation stopped before it converged.
        InputWarning: for a map said to be `optimized` that is not.
    """
    check_class("graph", graph, "a MultiRobotGraph", MultiRobotGraph)
    metric = _checked_metric(metric)
    memory_limit = checked_limit(memory_limit)
    tell, watch = progress or silent, StopWatch()
    with watch("optimize"):
        maps = optimized_maps(graph.maps, optimized, tell)
        for one in maps if optimized else ():
            _tell_if_not_at_rest(one)
    covariances = tuple(map(MapCovariance, maps))
    pairs, between = [], graph.closures.pairs()
    for number, (a, b) in enumerate(between):
        tell("consistency", number, len(between))
        closures, indices = graph.closures.between(a, b)
        both = covariances[a], covariances[b]
        found: dict[str, Any] = {}
        if callable(metric):
            own = functools.partial(_measured, metric, maps[a], maps[b])
            with watch("consistency"):
                found |= {"_squared": own(closures), "_metric": own}
        elif bytes_needed(closures) > memory_limit:
            found["_stream"] = functools.partial(_streamed, *both, closures, progress=tell)
        else:
            squared, freedom = _weighed(*both, closures, watch)
            found |= {"_squared": squared, "_freedom": freedom}
        pairs.append(PairEvidence(a, b, indices, closures, both, **found))
    tell("consistency", len(between), len(between))
    name = getattr(metric, "__name__", "function") if callable(metric) else MAHALANOBIS
    return Evidence(graph, maps, covariances, tuple(pairs), name, watch.seconds)


def optimized_maps(
    maps: tuple[PoseGraph, ...],
    optimized: bool,
    tell: Progress = silent,
    *,
    initial: str = "chordal",
) -> tuple[PoseGraph, ...]:
    """Each map at its own optimum; the given ones if they are `optimized` already.

    Args:
        maps: of the robots.
        optimized: whether there is nothing to do.
        tell: of progress.
        initial: where `optimize` starts.
    """
    if optimized:
        return maps
    found = []
    for number, one in enumerate(maps):
        tell("optimize", number, len(maps))
        found.append(_optimised(one, initial))
    tell("optimize", len(maps), len(maps))
    return tuple(found)


def _tell_if_not_at_rest(pose_graph: PoseGraph) -> None:
    """Warns where one step of Gauss-Newton still moves a map by more than its uncertainty."""
    if pose_graph.num_edges == 0:
        return
    step = problem_of(pose_graph).solve(lie.as_numpy(pose_graph.poses), max_steps=2)
    changed = 2.0 * abs(step.initial_cost - step.cost)
    if not changed <= max(AT_REST, AT_REST_SHARE * 2.0 * step.initial_cost):
        warnings.warn(
            InputWarning(
                f"optimized: map {pose_graph.name!r} is not at its optimum, a step changes its"
                f" chi-squared of {2.0 * step.initial_cost:.4g} by {changed:.2g}; expected maps as"
                " pcm_jax.optimize returns them, else distances are wrong"
            ),
            stacklevel=3,
        )


def checked_limit(memory_limit: float) -> float:
    """Bytes of at least 0; `InputError` for anything else."""
    check_number("memory_limit", memory_limit)
    if not memory_limit >= 0:
        raise InputError(f"memory_limit: {memory_limit}, expected bytes, at least 0")
    return memory_limit


def _optimised(pose_graph: PoseGraph, initial: str) -> PoseGraph:
    solution = optimize(pose_graph, initial=initial)
    if not solution.converged:
        warnings.warn(
            f"map {pose_graph.name!r}: optimisation stopped after {solution.iterations} steps "
            "before it converged, its covariances are those of where it stopped",
            ConvergenceWarning,
            stacklevel=3,
        )
    return solution.graph


def _weighed(
    a: MapCovariance, b: MapCovariance, closures: LoopClosures, watch: StopWatch
) -> tuple[Float[np.ndarray, "k k"], Int[np.ndarray, "k k"] | None]:
    """Squared distances, and the degrees of freedom where some have fewer than d."""
    with watch("marginals"):
        problem = problem_from_covariances(a, b, closures)
    with watch("consistency"):
        return weighed_on_host(problem)


def _streamed(
    a: MapCovariance, b: MapCovariance, closures: LoopClosures, gate: float, *, progress: Progress
) -> PackedGraph:
    return stream_from_covariances(a, b, closures, gate, progress=progress)


def _checked_metric(metric: Any) -> Any:
    if metric is None or metric == MAHALANOBIS:
        return MAHALANOBIS
    if not callable(metric):
        raise InputError(
            f"metric: {metric!r}, expected None, {MAHALANOBIS!r} or a function of two maps and the "
            "closures between them"
        )
    return metric


def _measured(
    metric: Metric, map_a: PoseGraph, map_b: PoseGraph, closures: LoopClosures
) -> Float[np.ndarray, "k k"]:
    check_pair(map_a, map_b, closures)
    name, count = getattr(metric, "__name__", "function"), len(closures)
    squared = checked_squared(metric(map_a, map_b, closures), f"metric: {name!r} returned")
    if len(squared) != count:
        raise InputError(
            f"metric: {name!r} returned shape {squared.shape}, expected {(count, count)}"
        )
    return squared
