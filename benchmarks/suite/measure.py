"""Time with compilation apart, memory, and the machine they were measured on."""

from __future__ import annotations

import gc
import importlib.metadata
import math
import os
import platform
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

Call = Callable[[], Any]

PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "optimistix", "sparsax", "gtsam", "networkx")
PACKAGES += ("symforce", "pyceres", "mrob")


class Timing(NamedTuple):
    """Seconds of repeated calls.

    Attributes:
        median: of all.
        fastest, slowest: the extremes, which say how quiet the machine was.
        repeats: how many.
    """

    median: float
    fastest: float
    slowest: float
    repeats: int


class Patience(NamedTuple):
    """Numbers of repeats.

    Attributes:
        least: rounds at least, as long as `most_seconds` are not used up.
        seconds: further rounds until so much time is used.
        most_seconds: no further round after so much time, however few there were.
        most: rounds at most.
    """

    least: int
    seconds: float
    most_seconds: float = 30.0
    most: int = 50

    def enough(self, rounds: int, spent: float) -> bool:
        """Says whether no further round is needed."""
        wanted = rounds >= self.least and spent >= self.seconds
        return wanted or rounds >= self.most or spent >= self.most_seconds


def seconds_of(call: Call) -> float:
    """Wall-clock seconds of one call; it must not return before its result is there."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def race(contestants: Mapping[str, Callable[[], Call]], patience: Patience) -> dict[str, Timing]:
    """Times calls in turn, round by round, so that a busy machine slows all of them alike.

    Args:
        contestants: each gets ready, untimed, and returns the call that is timed. Whatever is
            compiled was compiled before.
        patience: when to stop.
    """
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    spent, rounds = 0.0, 0
    gc.collect()
    while not patience.enough(rounds, spent):
        for name, ready in contestants.items():
            seconds[name].append(seconds_of(ready()))
            spent += seconds[name][-1]
        rounds += 1
    return {
        name: Timing(statistics.median(each), min(each), max(each), rounds)
        for name, each in seconds.items()
    }


def timing_of(call: Call, patience: Patience) -> Timing:
    """Times one call by itself; compile it before."""
    return race({"": lambda: call}, patience)[""]


def geometric_mean(ratios: Sequence[float]) -> float:
    """The mean of ratios: one of 2 and one of 1/2 are 1."""
    return math.exp(statistics.fmean(map(math.log, ratios)))


def in_words(seconds: float) -> str:
    """A duration, with a unit that suits it."""
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= scale:
            return f"{seconds / scale:.3g} {unit}"
    return f"{seconds / 1e-9:.3g} ns"


def against(ours: Timing, theirs: Timing) -> str:
    """Two raced timings in words."""
    return f"{_range(ours)} against {_range(theirs)}, {ours.repeats} rounds"


def alone(timing: Timing) -> str:
    """One timing in words."""
    return f"{_range(timing)}, {timing.repeats} runs"


def _range(timing: Timing) -> str:
    extremes = in_words(timing.fastest), in_words(timing.slowest)
    return f"{in_words(timing.median)} ({' to '.join(extremes)})"


def resident_memory() -> float:
    """The resident size of this process, in MB (10⁶ bytes); Linux only."""
    return _status("VmRSS")


def forget_peak_memory() -> None:
    """Lets `peak_memory` begin anew at the present size; Linux only."""
    Path("/proc/self/clear_refs").write_text("5")


def _status(name: str) -> float:
    status = Path("/proc/self/status").read_text()
    (line,) = (line for line in status.splitlines() if line.startswith(f"{name}:"))
    return int(line.split()[1]) * 1024 / 1e6


def peak_memory() -> float:
    """The largest resident size of this process so far, in MB (10⁶ bytes)."""
    try:  # Linux: unlike `getrusage`, not inherited from the process that started this one
        return _status("VmHWM")
    except (OSError, ValueError):
        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def machine() -> dict[str, Any]:
    """Facts about the machine, on which figures depend besides the code."""
    return {
        "processor": _processor(),
        "cores": cores(),
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        "system": platform.system(),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
        "load_at_start": round(os.getloadavg()[0], 2),
        "commit": _commit(),
        "date": time.strftime("%Y-%m-%d"),
    }


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(
            line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")
        )
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """The checkout's commit, with a plus sign if files differ from it."""
    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty=+"]
    try:
        found = subprocess.run(git, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return found.stdout.strip()
