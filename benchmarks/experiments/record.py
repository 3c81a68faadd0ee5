"""Steps of an experiment, kept on disk as they are done; tables and progress."""

from __future__ import annotations

import csv
import hashlib
import json
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.suite.harness import write_json

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
] + [PACKAGE / "simulation", PACKAGE / "experiments" / "comparison.py"]
"""What the results of every comparison of methods depend on."""

Figures = Mapping[str, float]


class Steps:
    """Results by name in a folder: each is computed once, and read after that.

    Results of other options or other sources than the present ones are computed again.

    Args:
        folder: where they are kept; made if it is absent.
        options: what they depend on; its `repr` counts.
        sources: the package's folders and the files that they depend on.
    """

    def __init__(self, folder: Path, options: Any, sources: Iterable[Path]):
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.stamp = folder, _stamp(options, sources)

    def __call__(self, name: str, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The step's result, plain data; computed if none is kept."""
        result = self.kept(name)
        return self.keep(name, compute()) if result is None else result

    def kept(self, name: str) -> dict[str, Any] | None:
        """The step's result if one of these options and sources is kept."""
        kept = _read(self._path(name))
        return kept["result"] if kept.get("stamp") == self.stamp else None

    def keep(self, name: str, result: dict[str, Any]) -> dict[str, Any]:
        """Writes a step's result, and returns it as it will be read."""
        write_json(self._path(name), {"stamp": self.stamp, "result": result})
        return _read(self._path(name))["result"]

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.json"


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


def _stamp(options: Any, sources: Iterable[Path]) -> str:
    digest = hashlib.blake2b(repr(options).encode(), digest_size=16)
    for source in sources:
        for path in sorted(source.rglob("*.py")) if source.is_dir() else [source]:
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _read(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
