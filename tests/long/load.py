"""Load: merges of random small worlds one after another in one process.

    python -m tests.long.load --count 10000

After a tenth of them, memory must stay within five percent, and hardly one more program may be
compiled. The plans of factorisations, which are kept up to a bound, have a smaller one here, so
that it is reached early; that bounds hold is tested in `tests/sparse/test_pattern_cache.py`.
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np

import pcm_jax as pcm
from pcm_jax.simulation import simulate_city, simulate_sessions
from pcm_jax.sparse import registry

from ._log import LOGS, commit, found_in, machine, table

COMPILED = "backend_compile_duration"
FLAT, MORE = 0.05, 10  # of memory; programs after the warm-up
KEPT = 50  # plans, in place of 2048


@contextmanager
def few_plans() -> Iterator[None]:
    """A scope in which few plans of factorisations are kept."""
    caches: Any = (registry.trees, registry.plans, registry.systems)
    sizes = [cache._size for cache in caches]
    try:
        for cache in caches:
            cache.clear()
            cache._size = KEPT
        yield
    finally:
        for cache, size in zip(caches, sizes, strict=True):
            cache._size = size


def world(seed: int) -> Any:
    """A small world whose kind and sizes follow from the seed."""
    rng = np.random.default_rng([15, seed])
    wrong = {"aliased_groups": int(rng.integers(0, 3)), "aliased_size": int(rng.integers(2, 5))}
    sizes = {"poses": int(rng.integers(20, 60)), "inliers": int(rng.integers(3, 9)), **wrong}
    sizes |= {"random": int(rng.integers(0, 25)), "reach": 30.0}
    if rng.random() < 0.3:
        return simulate_sessions(seed=seed, sessions=2, **sizes)
    return simulate_city(seed=seed, robots=int(rng.integers(2, 4)), **sizes)


def resident() -> int:
    """Bytes of this process in memory."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def run(count: int, deadline: float = float("inf")) -> dict[str, Any]:
    """Merges worlds, and says how memory and programs grew: `[done, bytes, programs]` in ten."""
    programs: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, _, **__: programs.append(event) if event.endswith(COMPILED) else None
    )
    marks, accepted, fault = [], 0, []
    began = time.perf_counter()
    for seed in range(count):
        if seed % max(1, count // 20) == 0 or time.monotonic() > deadline:
            marks.append((seed, resident(), len(programs)))
        if time.monotonic() > deadline:
            break
        result = pcm.merge(world(seed).graph)
        accepted += int(result.accepted.sum())
        if not result.solution.converged or not np.isfinite(result.solution.cost):
            fault.append(f"world {seed}: not converged")
    else:
        marks.append((count, resident(), len(programs)))
    warm = marks[min(2, len(marks) - 1)]
    growth = marks[-1][1] / warm[1] - 1
    more = marks[-1][2] - warm[2]
    fault += [f"memory grew by {growth:.1%}"] if growth > FLAT else []
    fault += [f"{more} more programs"] if more > MORE else []
    seconds = time.perf_counter() - began
    return {
        **{"marks": marks, "accepted": accepted, "fault": fault, "seconds": seconds},
        **{"growth": growth, "more": more},
    }


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.long.load", description=__doc__)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--minutes", type=float, default=float("inf"))
    parser.add_argument("--out", type=Path, default=LOGS / "load.md")
    given = parser.parse_args()
    with few_plans():
        done = run(given.count, time.monotonic() + 60 * given.minutes)
    rows: list[list[object]] = [[at, f"{size >> 20} MiB", n] for at, size, n in done["marks"]]
    given.out.write_text(
        f"# Merges one after another\n\n`python -m tests.long.load --count {given.count}`:"
        f" {done['marks'][-1][0]} merges; after a tenth of them memory grew by"
        f" {done['growth']:.1%} and {done['more']} programs were compiled; {done['accepted']}"
        f" closures accepted. Commit {commit()}; {machine()}; {done['seconds']:.0f} s.\n\n"
        + table(["merges", "in memory", "programs compiled"], rows)
        + found_in(done["fault"])
    )
    sys.stderr.write(given.out.read_text())


if __name__ == "__main__":
    main()
