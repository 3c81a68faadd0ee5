"""Time limits of cliques, on graphs up to 20,000 vertices.

    python -m tests.long.limits --sizes 2000 20000 --seconds 0.5 2

A search that is given a limit must answer within it, a tenth and 0.1 s more, whatever else it was
given: weights, ties to break. What it finds must be a clique, no larger than its bound. Only here
a wall clock is read; `clique/test_time_limit.py` has a clock of its own. Other programs on the
machine count too: a limit that did not hold is tried again, twice.
"""

from __future__ import annotations

import argparse
import gc
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pcm_jax.clique import GrowingClique, maximum_clique
from pcm_jax.clique.result import Clique

from ._log import LOGS, commit, found_in, machine, table

MORE, AND = 0.1, 0.1  # of the limit; seconds
TRIES = 3
BLOCK = 1000  # rows that are drawn at once
Search = Callable[[np.ndarray, float], Clique]


def random(size: int, density: float, seed: int) -> np.ndarray:
    """A graph whose pairs are adjacent by chance, made in place."""
    rng = np.random.default_rng([size, seed])
    graph = np.zeros((size, size), bool)
    for start in range(0, size, BLOCK):
        rows = slice(start, start + BLOCK)
        graph[rows] = rng.random((len(graph[rows]), size), np.float32) < density
    for start in range(0, size, BLOCK):  # what is above the diagonal counts
        stop = min(size, start + BLOCK)
        graph[start:stop, start:stop] = np.triu(graph[start:stop, start:stop], 1)
        graph[start:stop, start:stop] |= graph[start:stop, start:stop].T
        graph[stop:, start:stop] = graph[start:stop, stop:].T
    return graph


def planted(size: int) -> np.ndarray:
    """A sparse graph in which a hundredth of the vertices agree."""
    graph = random(size, 0.05, 1)
    members = np.random.default_rng(size).permutation(size)[: size // 100]
    graph[np.ix_(members, members)] = True
    graph[members, members] = False
    return graph


def parts(size: int) -> np.ndarray:
    """Fours of which any two vertices of different ones are adjacent: as many cliques as can be."""
    part = np.arange(size) // 4
    return part[:, None] != part[None]


GRAPHS: dict[str, Callable[[int], np.ndarray]] = {
    "sparse": lambda size: random(size, 0.02, 0),
    "half": lambda size: random(size, 0.5, 0),
    "dense": lambda size: random(size, 0.95, 0),
    "planted": planted,
    "fours": parts,
}


def searches(size: int) -> dict[str, Search]:
    """All that takes a limit, with its options; squared distances are kept for all graphs."""
    rng = np.random.default_rng(size)
    weights = rng.integers(1, 6, size)
    squared = np.empty((size, size))
    for start in range(0, size, BLOCK):
        squared[start : start + BLOCK] = rng.random((len(squared[start : start + BLOCK]), size))
    options: dict[str, dict[str, Any]] = {
        "exact": {},
        "heuristic": {"method": "heuristic"},
        "exact, tie_break": {"tie_break": squared},
        "exact, weights": {"weights": weights},
        "exact, weights that are fractions": {"weights": 0.1 * weights},
        "exact, weights and tie_break": {"weights": weights, "tie_break": squared},
        "heuristic, weights": {"weights": weights, "method": "heuristic"},
    }
    found: dict[str, Search] = {
        name: lambda graph, limit, given=given: maximum_clique(graph, time_limit=limit, **given)
        for name, given in options.items()
    }
    return found


def growing(graph: np.ndarray, limit: float) -> tuple[float, Clique]:
    """What a clique that grows takes: the graph is taken in before the clock starts."""
    state = GrowingClique.of_graph(graph)
    start = time.perf_counter()
    found = state.largest(limit)
    return time.perf_counter() - start, found


def timed(search: Search | None, graph: np.ndarray, limit: float) -> tuple[float, Clique]:
    """Seconds of a search, and its answer; None: of a clique that grows."""
    gc.collect()
    if search is None:
        return growing(graph, limit)
    start = time.perf_counter()
    found = search(graph, limit)
    return time.perf_counter() - start, found


def fault(graph: np.ndarray, found: Clique, seconds: float, limit: float) -> str | None:
    """What is wrong with an answer."""
    members = np.flatnonzero(found.members)
    inside = graph[np.ix_(members, members)].copy()
    np.fill_diagonal(inside, True)
    if not inside.all():
        return "no clique"
    if found.size > found.upper_bound or found.weight > found.weight_bound * (1 + 1e-9):
        return f"larger than its bound: {found.size}, {found.upper_bound}"
    if seconds > limit * (1 + MORE) + AND:
        return f"{seconds:.2f} s where {limit} were given"
    return None


def run(sizes: list[int], limits: list[float], graphs: list[str]) -> tuple[list, list[str]]:
    """Tries everything on every graph; gives a row for each, and what was wrong."""
    rows: list[list[object]] = []
    wrong = []
    for size in sizes:
        ways: dict[str, Search | None] = {**searches(size), "growing": None}
        for kind in graphs:
            graph = GRAPHS[kind](size)
            for name, search in ways.items():
                told: list[object] = [size, kind, name]
                for limit in limits:
                    for _ in range(TRIES):
                        seconds, found = timed(search, graph, limit)
                        problem = fault(graph, found, seconds, limit)
                        if problem is None or " s where " not in problem:
                            break
                    told += [f"{seconds:.2f}", found.size]
                    wrong += [f"{size}, {kind}, {name}: {problem}"] if problem else []
                rows.append([*told])
                sys.stderr.write(f"{rows[-1]} {problem or ''}\n")
    return rows, wrong


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.long.limits", description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[2000, 20_000])
    parser.add_argument("--seconds", type=float, nargs="+", default=[0.5, 2.0])
    parser.add_argument("--graphs", nargs="+", choices=GRAPHS, default=list(GRAPHS))
    parser.add_argument("--out", type=Path, default=LOGS / "limits.md")
    given = parser.parse_args()
    began = time.perf_counter()
    rows, wrong = run(given.sizes, given.seconds, given.graphs)
    head = ["vertices", "graph", "search"]
    for limit in given.seconds:
        head += [f"seconds of {limit:g}", "members"]
    words = [("--sizes", given.sizes), ("--seconds", given.seconds), ("--graphs", given.graphs)]
    command = " ".join(f"{option} {' '.join(map(str, values))}" for option, values in words)
    given.out.write_text(
        f"# Time limits\n\n`python -m tests.long.limits {command}`. Commit {commit()};"
        f" {machine()}; {time.perf_counter() - began:.0f} s.\n\n"
        + table(head, rows)
        + found_in(wrong)
    )


if __name__ == "__main__":
    main()
