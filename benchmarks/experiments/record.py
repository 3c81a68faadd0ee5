"""Rows and means of an experiment, the sources that results depend on, and progress."""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

PACKAGE = Path(__file__).resolve().parents[2] / "pcm_jax"
LIBRARY = [
    PACKAGE / layer
    for layer in (
        "lie",
        "graph",
        "sparse",
        "mapping",
        "consistency",
        "clique",
        "selection",
        "merging",
        "pipeline",
    )
] + [PACKAGE / "simulation", PACKAGE / "experiments"]
"""What the results of every comparison of methods depend on."""

Figures = Mapping[str, float]


def write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Writes rows that all have the first one's columns."""
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)


def means_by_method(runs: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Means of every figure over the runs, each `{"methods": {method: figures}}`."""
    methods: list[Mapping[str, Figures]] = [run["methods"] for run in runs]
    return {
        name: {
            figure: float(np.mean([each[name][figure] for each in methods]))
            for figure in methods[0][name]
        }
        for name in methods[0]
    }


def rows_by_method(runs: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row for each run and method, for `write_csv`."""
    return [
        {"run": run, "method": name, **figures}
        for run, result in runs.items()
        for name, figures in result["methods"].items()
    ]


class Progress:
    """One line on standard error, rewritten at each step; a line a step where it is no terminal."""

    def __init__(self, what: str, total: int):
        self.what, self.total, self.start = what, total, time.perf_counter()

    def __call__(self, done: int) -> None:
        """Says that so many of all steps are done."""
        seconds = time.perf_counter() - self.start
        line = f"{self.what} {done}/{self.total}  {seconds:.0f} s"
        end = "\r" if sys.stderr.isatty() and done < self.total else "\n"
        print(line, end=end, file=sys.stderr, flush=True)
