"""Determinism: the command line's files, byte by byte, in whatever process they are written.

    python -m tests.long.determinism --worlds 10

Each world is merged again in another process, under other hash seeds, numbers of threads and of
XLA's devices, by clocks that jump a day back and forth, and with its files in another order. All
but the last must give the same bytes of the merged g2o, the report, the page and the pictures; the
last the same closures and costs. Only stopwatches stand still, as what they show is in the files.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from ._log import LOGS, ROOT, commit, found_in, machine, table

START = """
import random, sys, time
time.perf_counter = lambda: 0.0
if {jumps}:
    now = time.time
    time.time = lambda: now() + random.choice((-86400.0, 0.0, 86400.0))
from pcm_jax.cli import main
sys.exit(main(sys.argv[1:-1]) or main([*sys.argv[1:-2], sys.argv[-1]]))
"""
NAMES = ("m.g2o", "r.json", "r.html", "p.svg", "p.pdf")
OPTIONS = ("--output", "--report", "--html", "--plot")
DEVICES = "XLA_FLAGS=--xla_force_host_platform_device_count="
SETTINGS: dict[str, tuple[str, ...]] = {
    "again": (),
    "hash seed 0": ("PYTHONHASHSEED=0",),
    "hash seed 1": ("PYTHONHASHSEED=1",),
    "hash seed 2": ("PYTHONHASHSEED=2",),
    "one thread": ("OPENBLAS_NUM_THREADS=1", "OMP_NUM_THREADS=1"),
    "two threads": ("OPENBLAS_NUM_THREADS=2", "OMP_NUM_THREADS=2"),
    "one device": (f"{DEVICES}1",),
    "two devices": (f"{DEVICES}2",),
    "jumping clock": ("JUMPS=1",),
}
ORDER = "other order of files"
COSTS = 1e-9  # relative: another order of robots is another order of sums


def world(folder: Path, seed: int) -> list[str]:
    """Simulates a team of three in files, and gives these as the arguments of `merge`."""
    from contextlib import redirect_stdout

    from pcm_jax.cli import main

    rng = random.Random(f"determinism {seed}")
    kind = "sessions" if seed % 3 == 2 else "city"
    robots = ["--sessions" if kind == "sessions" else "--robots", "3"]
    sizes = ["--poses", str(rng.randrange(40, 80)), "--inliers", str(rng.randrange(8, 12))]
    wrong = ["--aliased-groups", str(rng.randrange(2)), "--random", str(rng.randrange(5, 20))]
    command = ["simulate", kind, "--csv", "--output", str(folder), "--seed", str(seed)]
    with redirect_stdout(None):
        status = main([*command, *robots, *sizes, *wrong])
    if status:
        raise SystemExit(f"simulate: exit {status}")
    maps = sorted(str(path) for path in folder.glob("*.g2o"))
    return [*maps, "--closures", str(folder / "candidates.csv")]


def merged(files: list[str], out: Path, settings: tuple[str, ...] = ()) -> dict[str, bytes]:
    """Merges in a process of its own, and gives the bytes of what it wrote by name."""
    pairs = dict(one.split("=", 1) for one in settings)
    jumps = pairs.pop("JUMPS", None) is not None
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONHASHSEED"}
    if "XLA_FLAGS" in pairs:
        pairs["XLA_FLAGS"] = f"{kept.get('XLA_FLAGS', '')} {pairs['XLA_FLAGS']}".strip()
    environment = kept | {"PYTHONPATH": str(ROOT), **pairs}
    command = ["merge", *files, "--seed", "3"]
    for option, name in zip(OPTIONS, NAMES, strict=False):
        command += [option, str(out / name)]
    command.append(str(out / NAMES[-1]))  # the picture of a second merge in that process
    start = [sys.executable, "-c", START.format(jumps=jumps), *command]
    done = subprocess.run(start, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"merge: exit {done.returncode}: {done.stderr}")
    return {name: (out / name).read_bytes() for name in NAMES} | {"print": done.stdout.encode()}


def answer(report: bytes) -> tuple[set[tuple[Any, bool]], float]:
    """What a report says but for the order of robots: closures by their line, and the cost."""
    told = json.loads(report)
    closures = {(one["source"], one["accepted"]) for one in told["closures"]}
    return closures, told["solution"]["cost"]


def same_answer(first: bytes, second: bytes) -> bool:
    """True for the same closures and, up to rounding, the same cost."""
    one, other = answer(first), answer(second)
    return one[0] == other[0] and bool(np.isclose(one[1], other[1], rtol=COSTS, atol=1e-9))


def run(worlds: range, settings: list[str]) -> tuple[Counter[str], list[str]]:
    """Merges each world under each setting; gives how often each was tried, and what differed."""
    tried: Counter[str] = Counter()
    wrong = []
    for seed in worlds:
        with tempfile.TemporaryDirectory(prefix="determinism-") as place:
            folder = Path(place)
            (folder / "out").mkdir()
            files = world(folder / "world", seed)
            first = merged(files, folder / "out")
            for name in settings:
                tried[name] += 1
                if name == ORDER:
                    turned = [*files[:-2][::-1], *files[-2:]]
                    other = merged(turned, folder / "out")
                    if not same_answer(first["r.json"], other["r.json"]):
                        wrong.append(f"world {seed}, {name}: another answer")
                    continue
                other = merged(files, folder / "out", SETTINGS[name])
                differ = [one for one in first if first[one] != other[one]]
                wrong += [f"world {seed}, {name}: {', '.join(differ)}"] if differ else []
    return tried, wrong


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.long.determinism", description=__doc__)
    parser.add_argument("--worlds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--out", type=Path, default=LOGS / "determinism.md")
    given = parser.parse_args()
    began = time.perf_counter()
    tried, wrong = run(range(given.first, given.first + given.worlds), [*SETTINGS, ORDER])
    rows: list[list[object]] = [
        [name, count, sum(f", {name}: " in one for one in wrong)] for name, count in tried.items()
    ]
    given.out.write_text(
        f"# The same bytes\n\n`python -m tests.long.determinism --first {given.first} --worlds"
        f" {given.worlds}`: {', '.join(NAMES)} and what is printed, of each world and setting."
        f" Commit {commit()}; {machine()}; {time.perf_counter() - began:.0f} s.\n\n"
        + table(["setting", "worlds", "that differ"], rows)
        + found_in(wrong)
    )
    sys.stderr.write(given.out.read_text())


if __name__ == "__main__":
    main()
