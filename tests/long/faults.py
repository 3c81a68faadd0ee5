"""Faults around the whole command line: kill -9, full disks, folders that must not be written to.

    python -m tests.long.faults --moments 200

Whatever the command writes is afterwards what it was before, absent or the old file, or the whole
new file. Half of the moments are drawn over the whole run, half over the part of it in which files
are written. What a killed process leaves beside them begins with a dot.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pcm_jax.errors import FileFormatError
from pcm_jax.online._saved import read as read_state

from ._log import LOGS, ROOT, commit, found_in, machine, table
from ._seeds import write_team

OLD = b"what was here before\n"
FOLDER = "folder"  # the name of outputs that are folders
THEIRS = "theirs.txt"  # a file of others in it
COMMANDS = {
    "merge, all its files": (
        "merge TEAM --minimum-inliers 2 --output OUT/m.g2o --report OUT/r.json --html OUT/r.html"
        " --rejected OUT/no.csv --plot OUT/m.png"
    ),
    "merge --output DIR/": f"merge TEAM --minimum-inliers 2 --output OUT/{FOLDER}/",
    "stream --save": "stream TEAM --minimum-inliers 2 --save OUT/state.npz",
    "calibrate --output": "calibrate TEAM --output OUT/c.g2o",
    "simulate --csv": f"simulate city --csv --poses 30 --output OUT/{FOLDER}",
}
NAMES = {
    "merge, all its files": ["m.g2o", "r.json", "r.html", "no.csv", "m.png"],
    "merge --output DIR/": [FOLDER],
    "stream --save": ["state.npz"],
    "calibrate --output": ["c.g2o"],
    "simulate --csv": [FOLDER],
}
CHANGING = ("seconds", "version")  # what a report says of its own run


@dataclass
class Writer:
    """A command that writes, with what it writes when nothing disturbs it."""

    name: str
    place: Path
    seconds: float = 0.0
    writing: float = 0.0  # seconds after the start at which the first file appears
    whole: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.place.mkdir()
        (self.place / "out").mkdir()
        (self.place / "team").mkdir()
        team = write_team(self.place / "team", 30, 10)
        words = COMMANDS[self.name].split()
        self.words = [
            part
            for word in words
            for part in (team if word == "TEAM" else [word.replace("OUT", str(self.out))])
        ]
        for _ in range(2):  # the first one compiles
            began = time.time()
            done = self.start().wait()
            self.seconds = time.time() - began
        if done:
            raise SystemExit(f"{self.name}: exit {done}")
        self.whole = self.found()
        times = [path.stat().st_mtime for path in self.out.rglob("*") if path.is_file()]
        self.writing = max(0.0, min(times) - began - 0.1)

    @property
    def out(self) -> Path:
        return self.place / "out"

    def start(self, *before: str, **options: object) -> subprocess.Popen:
        """Starts the command, its programs kept in a folder of its own."""
        environment = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
        environment |= {"PCM_JAX_CACHE": str(self.place / "programs"), "HOME": str(self.place)}
        command = [*before, sys.executable, "-m", "pcm_jax", *self.words]
        settings = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, **options}
        return subprocess.Popen(command, env=environment, cwd=self.place, **settings)

    def found(self) -> dict[str, Any]:
        """What is there by name: files as far as they do not tell of their run, folders' files."""
        return {path.name: told(path) for path in self.out.iterdir()}

    def reset(self, old: bool) -> None:
        """Empties the folder, and puts old files there, in folders one of others too."""
        subprocess.run(["rm", "-rf", str(self.out)], check=True)
        self.out.mkdir()
        for name in NAMES[self.name] if old else ():
            if name == FOLDER:
                (self.out / name).mkdir()
            for path in self.files(name):
                path.write_bytes(OLD)

    def files(self, name: str) -> list[Path]:
        """The old files at an output's name."""
        if name != FOLDER:
            return [self.out / name]
        return [self.out / name / one for one in (*self.whole[FOLDER], THEIRS)]

    def is_before(self, name: str, value: object) -> bool:
        """True if what is there is what was there."""
        if name == FOLDER:
            return value == dict.fromkeys([*self.whole[FOLDER], THEIRS], OLD)
        return value == OLD

    def is_new(self, name: str, value: object, old: bool) -> bool:
        """True if what is there is the whole of the new, in a folder beside files of others."""
        whole = self.whole.get(name)
        return value == (whole | {THEIRS: OLD} if old and name == FOLDER else whole)

    def faults(self, old: bool) -> list[str]:
        """What is neither as before nor whole."""
        found, wrong = self.found(), []
        for name, value in found.items():
            before = old and self.is_before(name, value)
            if not name.startswith(".") and not before and not self.is_new(name, value, old):
                wrong.append(f"{name} is neither the old one nor the whole new one")
        lost = [name for name in NAMES[self.name] if name not in found]
        return wrong + [f"{name} is lost" for name in lost if old]


def told(path: Path) -> object:
    """A file's content, but for what differs from run to run; of a folder that of its files."""
    if path.is_dir():
        return {one.name: told(one) for one in path.iterdir()}
    data = path.read_bytes()
    if path.name.startswith(".") or data == OLD:
        return data
    if path.suffix == ".json":
        try:
            whole = json.loads(data)
        except ValueError:
            return data
        return {key: value for key, value in whole.items() if key not in CHANGING}
    if path.suffix == ".npz":  # its own reader refuses what is cut short or changed
        try:
            return read_state(path, "IncrementalPcm")[1].keys()
        except FileFormatError:
            return data
    if path.suffix == ".html":  # holds seconds
        return data.rstrip().endswith(b"</html>") and data.count(b"<html") == 1
    return data


def kill(writer: Writer, moments: int, rng: random.Random) -> tuple[Counter[str], list[str]]:
    """Kills the command at random moments, and says what it left."""
    left: Counter[str] = Counter()
    wrong = []
    for number in range(moments):
        old = rng.random() < 0.5
        writer.reset(old)
        start = writer.writing if number % 2 else 0.0
        after = rng.uniform(start, writer.seconds + 0.1)
        process = writer.start()
        try:
            process.wait(after)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
        faults = writer.faults(old)
        wrong += [f"{writer.name}, after {after:.3f} s: {fault}" for fault in faults]
        found = writer.found()
        new = [n for n in NAMES[writer.name] if n in found and writer.is_new(n, found[n], old)]
        left["all new" if len(new) == len(writer.whole) else "some new" if new else "none"] += 1
        left["with an unfinished one"] += any(name.startswith(".") for name in found)
    writer.reset(False)
    if writer.start().wait() or writer.found() != writer.whole:
        wrong.append(f"{writer.name}: does not run any more after the kills")
    return left, wrong


def full(writer: Writer, sizes: list[int]) -> tuple[int, list[str]]:
    """Lets no file grow beyond some sizes: the command must say so and leave all as it was."""
    wrong, refused = [], 0
    for size in sizes:
        for old in (False, True):
            writer.reset(old)
            process = writer.start(stderr=subprocess.PIPE, text=True)
            resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (size, size))
            _, errors = process.communicate()
            refused += process.returncode != 0
            case = f"{writer.name}, no file beyond {size} bytes"
            wrong += [f"{case}: {fault}" for fault in writer.faults(old)]
            wrong += _said(case, process.returncode, errors)
            hidden = [name for name in writer.found() if name.startswith(".")]
            wrong += [f"{case}: {name} is left" for name in hidden]
    return refused, wrong


def read_only(writer: Writer) -> tuple[int, list[str]]:
    """Runs the command without the right to write there."""
    rights = [] if os.getuid() else ["setpriv", "--bounding-set", "-all", "--inh-caps", "-all"]
    wrong = []
    for old in (False, True):
        writer.reset(old)
        for path in (*writer.out.rglob("*"), writer.out):
            path.chmod(0o555 if path.is_dir() else 0o444)
        process = writer.start(*rights, stderr=subprocess.PIPE, text=True)
        _, errors = process.communicate()
        case = f"{writer.name}, in a folder that must not be written to"
        wrong += [f"{case}: {fault}" for fault in writer.faults(old)]
        wrong += _said(case, process.returncode, errors)
        wrong += [f"{case}: exit 0"] if process.returncode == 0 else []
        for path in (writer.out, *filter(Path.is_dir, writer.out.iterdir())):
            path.chmod(0o755)
    return 2, wrong


def _said(case: str, status: int, errors: str) -> list[str]:
    lines = errors.splitlines()
    if status == 0:
        return []
    one = len([line for line in lines if line.startswith("error: ")]) == 1
    traced = "Traceback" in errors
    return [] if status == 2 and one and not traced else [f"{case}: exit {status}, {lines[-1:]}"]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.long.faults", description=__doc__)
    parser.add_argument("--moments", type=int, default=200, help="of each writer")
    parser.add_argument("--seed", type=int, default=15)
    parser.add_argument("--writers", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    parser.add_argument("--out", type=Path, default=LOGS / "faults.md")
    given = parser.parse_args()
    began = time.perf_counter()
    rows: list[list[object]] = []
    wrong: list[str] = []
    with tempfile.TemporaryDirectory(prefix="faults-") as place:
        for number, name in enumerate(given.writers):
            writer = Writer(name, Path(place) / str(number))
            left, killed = kill(writer, given.moments, random.Random(f"{given.seed} {name}"))
            largest = max(path.stat().st_size for path in writer.out.rglob("*") if path.is_file())
            refused, filled = full(writer, [0, 100, largest // 2, largest - 1])
            runs, denied = read_only(writer)
            wrong += [*killed, *filled, *denied]
            kinds = ("none", "some new", "all new", "with an unfinished one")
            row = [name, f"{writer.seconds:.1f}", given.moments, *(left[kind] for kind in kinds)]
            rows.append([*row, f"{refused} of 8", runs, len(killed + filled + denied)])
            sys.stderr.write(f"{rows[-1]} {killed + filled + denied}\n")
            given.out.write_text(told_of(given, rows, wrong, time.perf_counter() - began))


def told_of(given: Any, rows: list[list[object]], wrong: list[str], seconds: float) -> str:
    """The log of what is done so far."""
    head = ["writer", "seconds", "kills", "nothing new", "some files new", "all new"]
    head += ["with a dot file left", "disks too small", "read-only", "faults"]
    return (
        f"# Faults around the command line\n\n`python -m tests.long.faults --moments"
        f" {given.moments} --seed {given.seed}`. Commit {commit()}; {machine()};"
        f" {seconds:.0f} s.\n\n" + table(head, rows) + found_in(wrong)
    )


if __name__ == "__main__":
    main()
