"""Growth of time and memory with the number of closures, to 50,000.

    python -m benchmarks.growth --out DIR

Two simulated sessions in space, 5,000 poses each, and candidates between them, nearly all of them
false (`suite.streaming`). Of each number of closures, in a process of its own, on optimised maps
and from nothing compiled: the consistency graph panel by panel (`stream_consistency_graph`), and a
maximum clique of it. Memory is the whole process's, Python and JAX included, before the clique
search; a graph of 50,000 takes 313 MB as bits.

Writes summary.json, table.md and run.json.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.experiments.command import command_parser, finish, run_tasks
from benchmarks.experiments.record import LIBRARY
from benchmarks.suite.harness import ROOT
from benchmarks.suite.measure import peak_memory
from benchmarks.suite.streaming import streamed, world
from pcm_jax import maximum_clique
from pcm_jax.arrays import on_host
from pcm_jax.store import Store, digest

COUNTS = (2_000, 5_000, 10_000, 20_000, 50_000)
SOURCES = (*LIBRARY, ROOT / "benchmarks" / "suite" / "streaming.py")
COLUMNS = {
    "seconds": "graph, s",
    "microseconds": "µs an unordered pair",
    "slope": "growth, power of m",
    "memory": "peak, MB",
    "edges": "edges",
    "clique_seconds": "clique, s",
    "clique": "its members",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command."""
    parser = command_parser("growth", __doc__)
    parser.add_argument("--closures", type=int, nargs="+", default=COUNTS, metavar="M")
    options = parser.parse_args(arguments)
    start = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    steps = Store(options.out / "steps", digest(options.seeds, files=SOURCES))
    tasks = {
        f"{count}-{seed}": partial(_apart, count, seed)
        for count in sorted(options.closures)
        for seed in options.seeds
    }
    found = list(run_tasks("numbers of closures", tasks, steps).values())
    for before, after in pairwise(found):
        ratios = (after[name] / before[name] for name in ("seconds", "closures"))
        growth, larger = np.log(list(ratios))
        if larger > 0.0:
            after["slope"] = growth / larger
    summary = {str(row["closures"]): row for row in found}
    rows = {f"{row['closures']:,}": row for row in found}
    return finish(options, start, summary, rows, COLUMNS)


def _apart(count: int, seed: int) -> dict[str, Any]:
    """`grown` in a process of its own, whose peak of memory is its own, too."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(grown, (count, seed))


@on_host
def grown(count: int, seed: int) -> dict[str, Any]:
    """Time and memory of the graph of so many closures, and of a maximum clique of it."""
    graph, seconds = streamed(world(count, seed))
    memory, start = peak_memory(), time.perf_counter()
    clique = maximum_clique(graph.dense())
    return {
        "closures": count,
        "seconds": seconds,
        "microseconds": 2e6 * seconds / (count * (count - 1)),
        "memory": memory,
        "edges": int(graph.degree.sum()) // 2,
        "clique": clique.size,
        "clique_seconds": time.perf_counter() - start,
        "optimal": clique.optimal,
    }


if __name__ == "__main__":
    raise SystemExit(main())
