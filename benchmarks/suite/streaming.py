"""Tens of thousands of closures straight to a bit-packed consistency graph.

Two simulated sessions of 5,000 poses each in space; nearly all closures between them are false, as
place recognition leaves them. Times are those of one call on optimised maps, factors and
compilation included. Nothing smaller can stand for the largest case, which takes minutes.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks.suite.harness import Case, Measured, Metric, Settings
from benchmarks.suite.measure import in_words, peak_memory
from pcm_jax import (
    PackedGraph,
    chi2_gate,
    consistency_graph,
    consistency_problem,
    maximum_clique,
    optimize,
    squared_mahalanobis,
    stream_consistency_graph,
)
from pcm_jax.simulation import simulate_sessions

POSES, INLIERS, GROUP = 5_000, 400, 50
SMALL, HALF, FULL = 2_000, 10_000, 20_000
CONFIDENCE = 0.99


def against_dense(settings: Settings) -> dict[str, Measured]:
    """As many closures as the dense path takes: the same bits?"""
    small = world(SMALL)
    gate = float(chi2_gate(CONFIDENCE, 6))
    graph, seconds = streamed(small)
    peak = peak_memory()
    start = time.perf_counter()
    squared = squared_mahalanobis(consistency_problem(*small))
    dense = np.asarray(consistency_graph(squared, gate))
    taken = time.perf_counter() - start
    note = f"dense path {in_words(taken)}, {peak_memory():.0f} MB"
    return {
        "seconds": Measured(seconds, note),
        "peak_memory": Measured(peak, "whole process"),
        "bits_that_differ": Measured(
            float((graph.dense() != dense).sum()), f"{int(dense.sum()) // 2} edges"
        ),
    }


def full(settings: Settings) -> dict[str, Measured]:
    """The figure that is promised, how time grows, and the clique search on the result."""
    *maps, closures = world(FULL)
    some = np.sort(np.random.default_rng(0).permutation(FULL)[:HALF])
    _, seconds_some = streamed((*maps, closures[some]))
    graph, seconds = streamed((*maps, closures))
    peak = peak_memory()
    start = time.perf_counter()
    clique = maximum_clique(graph.dense())
    searched = time.perf_counter() - start
    slope = np.log(seconds / seconds_some) / np.log(FULL / HALF)
    note = f"{int(graph.degree.sum()) // 2:,} edges, {graph.bits.nbytes / 1e6:.0f} MB of bits"
    return {
        f"seconds_{HALF}": Measured(seconds_some),
        "seconds": Measured(seconds, note),
        "peak_memory": Measured(peak, "whole process"),
        "slope": Measured(slope, f"of log time against log m, from {HALF:,} closures"),
        "clique": Measured(searched, f"{clique.size} closures, proven: {clique.optimal}"),
    }


def world(count: int, seed: int = 0) -> tuple[Any, Any, Any]:
    """Two optimised maps, and candidates between them."""
    random = count - INLIERS - 4 * GROUP
    graph = simulate_sessions(
        seed=seed,
        poses=POSES,
        inliers=INLIERS,
        aliased_groups=4,
        aliased_size=GROUP,
        random=random,
    ).graph
    map_a, map_b = (optimize(one).graph for one in graph.maps)
    return map_a, map_b, graph.closures


def streamed(given: tuple[Any, Any, Any]) -> tuple[PackedGraph, float]:
    """The graph of what `world` gives, and the seconds that it took."""
    start = time.perf_counter()
    graph = stream_consistency_graph(*given, float(chi2_gate(CONFIDENCE, 6)))
    return graph, time.perf_counter() - start


CASES = [
    Case(
        f"streaming/as-dense-{SMALL}",
        (
            Metric("seconds", "s"),
            Metric("peak_memory", "MB", figure=2000.0, tolerance=0.2),
            Metric("bits_that_differ", "", figure=0.0, tolerance=None),
        ),
        against_dense,
        slow=True,
    ),
    Case(
        f"streaming/SE3-{FULL}",
        (
            Metric(f"seconds_{HALF}", "s"),
            Metric("seconds", "s", figure=300.0),
            Metric("peak_memory", "MB", figure=2000.0, tolerance=0.2),
            Metric("slope", "", figure=2.0, tolerance=0.2),
            Metric("clique", "s"),
        ),
        full,
        slow=True,
    ),
]
