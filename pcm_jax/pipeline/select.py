"""From a multi-robot graph to the closures to believe: steps i to iii for every robot pair."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from jaxtyping import Float

from pcm_jax.arrays import on_host
from pcm_jax.consistency import (
    PackedGraph,
    chi2_gate,
    consistency_problem,
    squared_mahalanobis,
    stream_consistency_graph,
)
from pcm_jax.consistency.problem import bytes_needed
from pcm_jax.errors import ConvergenceWarning, InputError
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph
from pcm_jax.selection.choice import Choice
from pcm_jax.selection.methods import OF_A_GRAPH, check_method, choose
from pcm_jax.selection.result import PairSelection, Selection

STAGES = ("optimize", "marginals", "consistency", "clique")


@on_host
def select(
    graph: MultiRobotGraph,
    *,
    method: str = "pcm-exact",
    confidence: float = 0.99,
    optimized: bool = False,
    minimum_inliers: int = 2,
    time_limit: float | None = None,
    memory_limit: float = 2e9,
    progress: Callable[[str], None] | None = None,
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
        memory_limit: bytes for the distances between two robots' closures. Where it takes more (at
            2 GB from about 1,500 closures in space or 2,900 in the plane on, all at poses of their
            own), PCM's methods get the same graph by `stream_consistency_graph`, panel by panel.
            The others need the distances (so does `tie_break="distance"`), whatever they take.
        progress: called with a line of text, every tenth of such a stream.
        **options: the method's own, see `select_from`.

    Returns:
        the selection; float64 whatever the caller's `jax_enable_x64`.

    Raises:
        InputError: for an unknown method or option, a confidence outside (0, 1), a negative
            minimum or limit, and what optimising the maps raises.
    """
    if time_limit is not None:
        options["time_limit"] = time_limit
    check_method(method, options)
    if minimum_inliers < 0:
        raise InputError(f"minimum_inliers: {minimum_inliers}, expected at least 0")
    if not memory_limit >= 0:
        raise InputError(f"memory_limit: {memory_limit}, expected bytes, at least 0")
    gate = float(chi2_gate(confidence, graph.tangent_dim))
    watch = _StopWatch()
    with watch("optimize"):
        maps = optimized_maps(graph.maps, optimized)
    judge = _Judge(maps, gate, method, options, memory_limit, watch, progress)
    accepted = np.zeros(len(np.asarray(graph.closures.robot_a)), bool)
    pairs = []
    for a, b in graph.closures.pairs():
        closures, indices = graph.closures.between(a, b)
        choice, evidence = judge(a, b, closures)
        enough = np.count_nonzero(choice.members) >= minimum_inliers
        accepted[indices] = of_pair = choice.members & enough
        certificate = choice.optimal, choice.upper_bound
        pairs.append(PairSelection(a, b, indices, evidence, gate, of_pair, *certificate))
    return Selection(accepted, tuple(pairs), method, confidence, gate, maps, watch.seconds)


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
            ConvergenceWarning,
            stacklevel=3,
        )
    return solution.graph


class _Judge:
    """What a method keeps between one robot pair after another, all in the same maps.

    Joint covariances are those of each pair's own touched poses: their cost grows with the cube
    of the number of poses, so a map in many pairs is better asked several times for few. Pairs
    that touch the same poses of a map share one.
    """

    def __init__(
        self,
        maps: tuple[PoseGraph, ...],
        gate: float,
        method: str,
        options: dict[str, Any],
        memory_limit: float,
        watch: _StopWatch,
        progress: Callable[[str], None] | None,
    ):
        self.maps, self.gate, self.method, self.options = maps, gate, method, options
        self.watch, self.tell = watch, progress or (lambda text: None)
        by_distance = options.get("tie_break", "index") != "index"
        needs_distances = method not in OF_A_GRAPH or by_distance
        self.memory_limit = np.inf if needs_distances else memory_limit
        self.known: dict[tuple[int, bytes], np.ndarray] = {}

    def __call__(
        self, a: int, b: int, closures: LoopClosures
    ) -> tuple[Choice, Float[np.ndarray, "k k"] | PackedGraph]:
        """The choice and its evidence."""
        if bytes_needed(closures) > self.memory_limit:
            with self.watch("consistency"):
                graph = self._streamed(a, b, closures)
            with self.watch("clique"):
                limit = self.options.get("time_limit")
                return OF_A_GRAPH[self.method](graph.dense(), time_limit=limit), graph
        squared = self._squared(a, b, closures)
        with self.watch("clique"):
            return choose(squared, self.gate, method=self.method, **self.options), squared

    def _streamed(self, a: int, b: int, closures: LoopClosures) -> PackedGraph:
        told = -1

        def progress(done: int, pairs: int) -> None:
            nonlocal told
            if (tenth := 10 * done // max(pairs, 1)) > told:
                told = tenth
                self.tell(f"weighing the pairs of {len(closures)} closures: {10 * tenth} %")

        maps = self.maps[a], self.maps[b]
        return stream_consistency_graph(*maps, closures, self.gate, progress=progress)

    def _squared(self, a: int, b: int, closures: LoopClosures) -> Float[np.ndarray, "k k"]:
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
