"""Every method on thousands of simulated worlds, to Parquet.

SE(2) worlds of 115 closures as in the paper: 15 true, two aliased groups of 5, 90 random; Q,
PCM-HeuPatt, RANSAC and SCGP at one gate. Times are those of one call of `sweep` in a fresh process,
on one device of the host: the worlds are drawn and the files written in them.
"""

from __future__ import annotations

import functools
import tempfile
import time

import numpy as np
import pyarrow.parquet

from benchmarks.suite.harness import Case, Measured, Metric, Settings
from pcm_jax import sweep

FEW, MANY = 1_000, 10_000


def sweeping(worlds: int, settings: Settings) -> dict[str, Measured]:
    """One sweep, compilation and all; and the time of a world without that."""
    with tempfile.TemporaryDirectory() as folder:
        marks = [(0, time.perf_counter())]
        sweep(folder, worlds=worlds, batch=512, progress=lambda _, done, __: _mark(marks, done))
        table = pyarrow.parquet.read_table(folder)
    (_, start), (first, compiled), *_, (_, end) = marks
    each = (end - compiled) / (worlds - first)
    status = np.array(table["status"].to_pylist())
    return {
        "seconds": Measured(end - start, f"{table.num_rows:,} rows"),
        "compilation": Measured(compiled - start - first * each, "first batch without its run"),
        "world": Measured(1e3 * each, "drawn, weighed, decided on by three methods"),
        "failed": Measured(float((status != "ok").sum()), "rows"),
    }


def _mark(marks: list[tuple[int, float]], done: int) -> None:
    marks.append((done, time.perf_counter()))


CASES = [
    Case(
        f"world_sweeps/SE2-{worlds}",
        (
            Metric("seconds", "s", figure=figure),
            Metric("compilation", "s"),
            Metric("world", "ms", figure=12.0),
            Metric("failed", "", figure=0.0, tolerance=None),
        ),
        functools.partial(sweeping, worlds),
        slow=worlds > FEW,
    )
    for worlds, figure in ((FEW, None), (MANY, 120.0))
]
