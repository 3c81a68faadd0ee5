"""Fig. 3: how long each method takes on a world, against the number of its measurements.

Solvers work one world at a time, as the paper timed them, on squared distances that are there
already. A method gives up at the first size where more than `PATIENCE` of the worlds take longer
than a limit, and is not tried on larger ones; enumeration ends at 24 measurements in any case.
Beside it, up to 32 measurements, the time a world when all worlds are one batched program.

Times are of the processor, which a busy machine hardly blurs: one thread for the solvers; for the
batched programs the sum over their threads.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.experiments.one_dimensional import METHODS, Setting, select_timed
from benchmarks.experiments.record import Progress
from pcm_jax import InputError
from pcm_jax.selection import select_from
from pcm_jax.store import Store

SIZES = (6, 8, 12, 16, 20, 24, 28, 32, 48, 64, 96, 128, 192, 256, 384, 512)
SIZES += (768, 1024, 1536, 2048, 3072, 4096)
PATIENCE = 0.01  # share of the worlds that may take longer than the limit
BATCHED_UP_TO = 32  # bits of a word: the limit of the batched enumeration
_LIMITS_OF_WALL_CLOCK = 20  # until the clique search, which could go on for ever, is stopped

Timed = dict[str, dict[str, Any]]
"""By method: `seconds` of each world up to the one it gave up at, `gave_up`, `batched`."""


def time_solvers(
    setting: Setting, sizes: Sequence[int], worlds: int, limit: float, seed: int, steps: Store
) -> dict[int, Timed]:
    """Times by size, of the methods that had not given up before it."""
    tell, results, trying = Progress("sizes", len(sizes)), {}, METHODS
    for done, size in enumerate(sizes):
        task = partial(time_size, setting.of_size(size), trying, worlds, limit, seed)
        results[size] = timed = steps(f"{size:05}", task)
        trying = tuple(method for method in trying if not timed[method]["gave_up"])
        tell(done + 1)
    return results


def time_size(
    setting: Setting, methods: Sequence[str], worlds: int, limit: float, seed: int
) -> Timed:
    """Times of worlds of one size."""
    simulated = setting.worlds(worlds, seed)
    timed: Timed = {method: {"seconds": [], "gave_up": False} for method in methods}
    with threadpool_limits(1):
        for method in methods:  # nobody's first call is timed
            _seconds(method, setting.worlds(1, seed).squared_mahalanobis()[0], setting.gate, limit)
        for world in range(worlds):
            one = type(simulated)(*(values[world : world + 1] for values in simulated))
            squared = one.squared_mahalanobis()[0]
            for method, result in timed.items():
                if not result["gave_up"]:
                    seconds = _seconds(method, squared, setting.gate, limit)
                    result["seconds"] += [] if seconds is None else [seconds]
                    late = sum(each > limit for each in result["seconds"])
                    result["gave_up"] = seconds is None or late > PATIENCE * worlds
    if setting.measurements <= BATCHED_UP_TO:
        squared = simulated.squared_mahalanobis()
        for method in METHODS:
            timed.setdefault(method, {"seconds": [], "gave_up": True})
            timed[method]["batched"] = _batched(method, squared, setting.gate) / worlds
    return timed


def _seconds(method: str, squared: np.ndarray, gate: float, limit: float) -> float | None:
    """Seconds of one world; None where the method cannot do it."""
    options = {"time_limit": _LIMITS_OF_WALL_CLOCK * limit} if method == "pcm-exact" else {}
    start = time.process_time()
    try:
        choice = select_from(squared, gate, method=method, with_certificate=True, **options)
    except InputError:
        return None
    seconds = time.process_time() - start
    return seconds if choice.optimal or method != "pcm-exact" else None


def _batched(method: str, squared: np.ndarray, gate: float) -> float:
    """Seconds of all worlds; the median of three runs."""
    seconds = []
    for _ in range(4):  # the first compiles
        start = time.process_time()
        select_timed(method, squared, gate)
        seconds.append(time.process_time() - start)
    return float(np.median(seconds[1:]))


def timing_rows(results: Mapping[int, Timed]) -> list[dict[str, Any]]:
    """One row for each method and size that it coped with, for `write_csv`; seconds a world."""
    rows = []
    for size, timed in results.items():
        for method, result in timed.items():
            coped, row = not result["gave_up"], {"method": method, "measurements": size}
            quantiles = np.percentile(result["seconds"], (50, 90, 100)) if coped else [None] * 3
            names = ("median", "percentile_90", "largest", "batched")
            values = dict(zip(names, [*quantiles, result.get("batched")], strict=True))
            if any(value is not None for value in values.values()):
                rows.append(row | {name: _short(value) for name, value in values.items()})
    return rows


def _short(seconds: float | None) -> float | None:
    return None if seconds is None else float(f"{seconds:.4g}")


def timing_summary(results: Mapping[int, Timed]) -> dict[str, dict[str, Any]]:
    """By method: the largest size it coped with, its median seconds there, where it gave up."""
    summary = {}
    for method in METHODS:
        tried = {size: timed[method] for size, timed in results.items() if method in timed}
        coped = [size for size, result in tried.items() if not result["gave_up"]]
        gave_up = [size for size, result in tried.items() if result["gave_up"]]
        summary[method] = {
            "largest": max(coped, default=None),
            "median_seconds": float(np.median(tried[max(coped)]["seconds"])) if coped else None,
            "gave_up_at": min(gave_up, default=None),
        }
    return summary


def draw_timing(results: Mapping[int, Timed], path: Path) -> None:
    """Fig. 3, and beside it the same of batched worlds."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    from pcm_jax.plots import plot_seconds

    figure, axes = pyplot.subplots(2, 1, figsize=(7.0, 9.0), dpi=110, layout="constrained")
    sizes, small = np.array(list(results)), [s for s in results if s <= BATCHED_UP_TO]
    alone = {method: _times(results, method) for method in METHODS}
    plot_seconds(sizes, alone, ax=axes[0])
    axes[0].set_title("one world at a time")
    batched = {m: np.array([results[s][m]["batched"] for s in small]) for m in METHODS}
    plot_seconds(np.array(small), batched, ax=axes[1])
    axes[1].set_title("all worlds as one batched program")
    for ax in axes:
        ax.set_ylabel("processor time a world (s)")
        figure.savefig(path)
    pyplot.close(figure)


def _times(results: Mapping[int, Timed], method: str) -> np.ndarray:
    """Seconds [worlds, sizes]; NaN where the method gave up."""
    columns = [timed.get(method, {"gave_up": True}) for timed in results.values()]
    worlds = max(len(column.get("seconds", [])) for column in columns)
    unknown = np.full(worlds, np.nan)
    return np.transpose([unknown if c["gave_up"] else c["seconds"] for c in columns])
