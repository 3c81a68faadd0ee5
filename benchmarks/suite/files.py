"""Reading a large file: City10000, compressed as it is shared."""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmarks.suite import maps
from benchmarks.suite.harness import Case, Measured, Metric, Settings
from benchmarks.suite.measure import alone, seconds_of, timing_of
from pcm_jax import MultiRobotGraph, read_graph, write_g2o
from pcm_jax.graph import LoopClosures

CITY = "city10000"


def real(settings: Settings) -> dict[str, Measured]:
    """The public file, xz-compressed."""
    return _read(maps.required(maps.FILES[CITY], settings), settings)


def simulated(settings: Settings) -> dict[str, Measured]:
    """A simulated city of the same size, plain text."""
    city = maps.read_map("simulated-city", settings)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "city.g2o"
        write_g2o(path, MultiRobotGraph((city,), LoopClosures.empty(city.group)))
        return _read(path, settings)


def _read(path: Path, settings: Settings) -> dict[str, Measured]:
    first = seconds_of(lambda: read_graph(path))
    timing = timing_of(lambda: read_graph(path), settings.patience)
    note = f"{alone(timing)}; the first in the process {first:.2f} s"
    return {"read": Measured(timing.median, note)}


CASES = [
    Case("files/city10000", (Metric("read", "s", figure=0.5),), real),
    Case(
        "files/simulated-city",
        (Metric("read", "s", figure=0.5),),
        simulated,
        applies=maps.stand_ins_needed,
    ),
]
