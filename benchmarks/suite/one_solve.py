"""One solve in a process of its own, and what memory that took.

    python -m benchmarks.suite.one_solve {blocks,cholmod,gtsam} GRAPH.npz

GRAPH.npz holds a `gtsam_peer.PlainGraph`. Prints a JSON object of MB (10⁶ bytes): `before`,
resident once everything is imported, compiled and read; `solving`, the largest size from there to
the solution, the library's own form of the graph included; `whole`, the largest of the process.

What JAX compiles is compiled before by a chain of poses of the same padded sizes, which a factor
without fill solves; what that leaves behind in the allocator is given back to the system.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.suite import gtsam_peer
from benchmarks.suite.measure import forget_peak_memory, peak_memory, resident_memory

Solve = Callable[[gtsam_peer.PlainGraph], Any]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("solver", choices=("blocks", "cholmod", "gtsam"))
    parser.add_argument("graph")
    options = parser.parse_args()
    with np.load(options.graph) as file:
        graph = gtsam_peer.PlainGraph(*(file[name] for name in gtsam_peer.PlainGraph._fields))
    solve = _by_gtsam if options.solver == "gtsam" else _compiled(options.solver, graph)
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    before, preparing = resident_memory(), peak_memory()
    forget_peak_memory()
    solve(graph)
    solving = peak_memory()
    print(json.dumps({"before": before, "solving": solving, "whole": max(preparing, solving)}))


def _by_gtsam(graph: gtsam_peer.PlainGraph) -> None:
    gtsam_peer.gauss_newton(*gtsam_peer.factors_and_values(graph, "solve")).optimize()


def _compiled(engine: str, graph: gtsam_peer.PlainGraph) -> Solve:
    """Our solve, compiled for graphs of this one's sizes."""
    from pcm_jax import PoseGraph, optimize

    def solve(graph: gtsam_peer.PlainGraph) -> None:
        optimize(PoseGraph.from_arrays(**graph._asdict()), initial="given", engine=engine)

    solve(_chain_like(graph))
    return solve


def _chain_like(graph: gtsam_peer.PlainGraph) -> gtsam_peer.PlainGraph:
    """As many poses and edges, each edge between neighbours: some of them more than once."""
    tail = np.arange(len(graph.tail)) % (len(graph.poses) - 1)
    unit = np.eye(graph.poses.shape[-1])
    return graph._replace(
        poses=np.broadcast_to(unit, graph.poses.shape),
        tail=tail,
        head=tail + 1,
        measurement=np.broadcast_to(unit, graph.measurement.shape),
    )


if __name__ == "__main__":
    main()
