"""From a multi-robot graph to the closures to believe: steps i to iii for every robot pair."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax.consistency import chi2_gate, consistency_problem, squared_mahalanobis
from pcm_jax.errors import InputError, InputWarning
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph
from pcm_jax.precision import in_float64
from pcm_jax.selection.methods import check_method, choose

STAGES = ("optimize", "marginals", "consistency", "clique")


@dataclass(frozen=True, eq=False)
class PairSelection:
    """What was decided of the k closures between two robots.

    Attributes:
        robot_a: index of the robot with the smaller index.
        robot_b: index of the other.
        closures: int64 [k], their indices among the graph's closures, ascending.
        squared: float64 [k, k], squared Mahalanobis distances (paper, eq. 4), not symmetrised.
        gate: γ².
        accepted: bool [k].
        optimal: whether no larger pairwise consistent set exists; None if the method does not say.
        upper_bound: no pairwise consistent set has more members; None likewise.
    """

    robot_a: int
    robot_b: int
    closures: Int[np.ndarray, " k"]
    squared: Float[np.ndarray, "k k"]
    gate: float
    accepted: Bool[np.ndarray, " k"]
    optimal: bool | None
    upper_bound: int | None


@dataclass(frozen=True, eq=False)
class Selection:
    """Which closures of a graph to believe.

    Attributes:
        inliers: bool [m], in the order of the graph's closures.
        pairs: one `PairSelection` per pair of robots that closures join, by robot index.
        method: as given.
        confidence: as given.
        gate: γ², of all pairs.
        maps: the optimised maps that the distances were measured in.
        seconds: wall-clock time of `"optimize"`, `"marginals"`, `"consistency"` and `"clique"`.
    """

    inliers: Bool[np.ndarray, " m"]
    pairs: tuple[PairSelection, ...]
    method: str
    confidence: float
    gate: float
    maps: tuple[PoseGraph, ...]
    seconds: dict[str, float]


@in_float64
def select(
    graph: MultiRobotGraph,
    *,
    method: str = "pcm-exact",
    confidence: float = 0.99,
    optimized: bool = False,
    minimum_inliers: int = 2,
    time_limit: float | None = None,
    **options: Any,
) -> Selection:
    """Selects the closures to believe, for every pair of robots by itself.

    Each map is optimised on its own; the joint covariance of the poses that a pair's closures
    touch, and from it the squared distances of all pairs of closures, go to the method.

    Args:
        graph: the robots' maps and the closures between them.
        method: see `select_from`.
        confidence: probability that the loop of two right closures passes the gate.
        optimized: whether the maps are at their optimum already.
        minimum_inliers: a pair of robots that accepts fewer closures accepts none: a single one
            is consistent with itself whatever it says.
        time_limit: seconds for each pair's clique; needs a method that has the option.
        **options: the method's own, see `select_from`.

    Returns:
        the selection; float64 whatever the caller's `jax_enable_x64`.

    Raises:
        InputError: for an unknown method or option, a confidence outside (0, 1), a negative
            minimum, and what optimising the maps raises.
    """
    if time_limit is not None:
        options["time_limit"] = time_limit
    check_method(method, options)
    if minimum_inliers < 0:
        raise InputError(f"minimum_inliers: {minimum_inliers}, expected at least 0")
    gate = float(chi2_gate(confidence, graph.tangent_dim))
    watch = _StopWatch()
    with watch("optimize"):
        maps = optimized_maps(graph.maps, optimized)
    distances = _SquaredDistances(maps, watch)
    inliers = np.zeros(len(np.asarray(graph.closures.robot_a)), bool)
    pairs = []
    for a, b in graph.closures.pairs():
        closures, indices = graph.closures.between(a, b)
        squared = distances.between(a, b, closures)
        with watch("clique"):
            choice = choose(squared, gate, method=method, **options)
        enough = np.count_nonzero(choice.members) >= minimum_inliers
        inliers[indices] = accepted = choice.members & enough
        certificate = choice.optimal, choice.upper_bound
        pairs.append(PairSelection(a, b, indices, squared, gate, accepted, *certificate))
    return Selection(inliers, tuple(pairs), method, confidence, gate, maps, watch.seconds)


def optimized_maps(maps: tuple[PoseGraph, ...], optimized: bool) -> tuple[PoseGraph, ...]:
    """Each map at its own optimum; the given ones if they are `optimized` already."""
    return maps if optimized else tuple(map(_optimised, maps))


def _optimised(pose_graph: PoseGraph) -> PoseGraph:
    from pcm_jax.mapping import optimize

    solution = optimize(pose_graph)
    if not solution.converged:
        warnings.warn(
            f"map {pose_graph.name!r}: optimisation stopped after {solution.iterations} steps "
            "before it converged, its covariances are those of where it stopped",
            InputWarning,
            stacklevel=3,
        )
    return solution.graph


class _SquaredDistances:
    """Q of one robot pair after another, in the same maps.

    Joint covariances are those of each pair's own touched poses: their cost grows with the cube
    of the number of poses, so a map in many pairs is better asked several times for few. Pairs
    that touch the same poses of a map share one.
    """

    def __init__(self, maps: tuple[PoseGraph, ...], watch: _StopWatch):
        self.maps, self.watch = maps, watch
        self.known: dict[tuple[int, bytes], np.ndarray] = {}

    def between(self, a: int, b: int, closures: LoopClosures) -> Float[np.ndarray, "k k"]:
        with self.watch("marginals"):
            marginals = self._joint(a, closures.pose_a), self._joint(b, closures.pose_b)
        with self.watch("consistency"):
            problem = consistency_problem(self.maps[a], self.maps[b], closures, marginals=marginals)
            return np.asarray(squared_mahalanobis(problem))

    def _joint(self, robot: int, poses: Any) -> Float[np.ndarray, "kd kd"]:
        from pcm_jax.mapping import joint_marginal_covariance

        touched = np.unique(np.asarray(poses))
        key = robot, touched.tobytes()
        if key not in self.known:
            self.known[key] = joint_marginal_covariance(self.maps[robot], touched)
        return self.known[key]


class _StopWatch:
    """Wall-clock seconds by stage."""

    def __init__(self):
        self.seconds: dict[str, float] = dict.fromkeys(STAGES, 0.0)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] += time.perf_counter() - start
