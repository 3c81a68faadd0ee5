"""Steps of an experiment, kept on disk as they are done; tables and progress."""

from __future__ import annotations

import csv
import hashlib
import json
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.suite.harness import write_json

PACKAGE = Path(__file__).resolve().parents[2] / "pcm_jax"


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
        """The step's result, plain data."""
        path = self.folder / f"{name}.json"
        kept = _read(path)
        if kept.get("stamp") != self.stamp:
            kept = {"stamp": self.stamp, "result": compute()}
            write_json(path, kept)
        return kept["result"]


def write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Writes rows that all have the first one's columns."""
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)


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
