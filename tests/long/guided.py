"""Fuzzing of every reader, guided by coverage: what reaches new code is kept and changed further.

    python -m tests.long.guided --minutes 600 --corpus FOLDER

Seeds, readers and verdict are those of `fuzz`, and so are most of the changes; the others are
libFuzzer's, which Atheris drives (`pip install atheris`, on Linux; the package itself does not need
it). Measured are the modules that read, see `READING`. ROS bags are left out:
they take fifty milliseconds, and are read by modules that are not ours. An input is two bytes, the
seed and the options, and then the file. `--corpus` is a folder that is kept: a later run with it
goes on from there. What is found lies in its folder `found`, and is made again by `--only FILE`.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import pkgutil
import random
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

from ._log import LOGS, ROOT, commit, found_in, machine, table

READING = ("files", "graph", "online", "cli.explain", "cli._reports")
ABSENT = "python -m tests.long.guided: needs Atheris, `pip install atheris`"
BYTES, LONGEST, EVERY = 3 << 30, 1 << 16, 200  # of memory, of a file; inputs between two notes
FRESH = 0.3  # of the inputs are made of a whole seed: what is broken twice is hardly accepted
STATUS = re.compile(r"^#(\d+)\t(\w+).* cov: (\d+) ft: (\d+) corp: (\d+)/", re.MULTILINE)


def is_reading(module: str) -> bool:
    """True for a module whose coverage guides the run."""
    name = module.removeprefix("pcm_jax.")
    return any(name == part or name.startswith(f"{part}.") for part in READING)


def instrumented_fuzz(atheris: Any) -> Any:
    """The module `fuzz`, imported so that what it reads with is measured."""
    package = importlib.util.find_spec("pcm_jax")
    assert package is not None and "pcm_jax" not in sys.modules
    places = package.submodule_search_locations
    modules = [found.name for found in _walk(list(places or ()), "pcm_jax.")]
    others = [name for name in modules if not is_reading(name)]
    with atheris.instrument_imports(include=["pcm_jax"], exclude=["pcm_jax", *others]):
        for name in set(modules) - set(others):
            importlib.import_module(name)
        from . import fuzz
    return fuzz


def _walk(places: list[str], prefix: str) -> list[pkgutil.ModuleInfo]:
    """The modules of a package and of those within, none of them imported."""
    found = []
    for one in pkgutil.iter_modules(places, prefix):
        found.append(one)
        if one.ispkg:
            name = one.name.removeprefix(prefix)
            found += _walk([str(Path(place) / name) for place in places], f"{one.name}.")
    return found


class Target:
    """What libFuzzer calls: one input is read, and new ones are made of those that it kept.

    Args:
        fuzz: the module `fuzz`.
        folder: an empty one for files that come and go.
        corpus: the folder of inputs that are kept.
        count, deadline: whichever comes first ends the process.
    """

    def __init__(self, fuzz: Any, folder: Path, corpus: Path, count: int, deadline: float):
        self.fuzz, self.folder, self.found = fuzz, folder, corpus / "found"
        (folder / "seeds").mkdir()
        self.seeds = [*fuzz.texts(), *fuzz.binaries(folder / "seeds")]
        self.seeds = [one for one in self.seeds if one.name not in fuzz.BAGS]
        self.readers = fuzz.Readers(folder)
        self.count, self.deadline = count, deadline
        self.told: Counter[str] = Counter()
        self.kinds: Counter[str] = Counter()
        for number, one in enumerate(self.seeds):
            (corpus / one.name).write_bytes(bytes((number, 255)) + one.data)

    def __call__(self, data: bytes) -> None:
        """Reads an input; what is found is noted, and the run goes on."""
        one, options, content = self.parts(data)
        path = self.folder / one.name
        wrong, accepted, plain = self.fuzz.verdict(self.readers, one, path, content, options)
        self.told.update(tried=1, accepted=accepted, compared=plain)
        if wrong is not None:
            kind = f"{one.name}: {wrong}".replace(str(self.folder), "").splitlines()[0]
            if kind not in self.kinds:
                self.found.mkdir(exist_ok=True)
                (self.found / f"{len(self.kinds):03}-{one.name}").write_bytes(data)
            self.kinds[kind] += 1
        ends = self.told["tried"] >= self.count or time.monotonic() > self.deadline
        if ends or wrong is not None or self.told["tried"] % EVERY == 0:
            told = {"told": self.told, "kinds": self.kinds}
            (self.folder / "told.json").write_text(json.dumps(told))
        if ends:
            os._exit(0)

    def parts(self, data: bytes) -> tuple[Any, dict[str, Any], bytes]:
        """The seed, the options and the file that an input stands for."""
        head = data[:2].ljust(2, b"\xff")
        options = self.fuzz.OPTIONS
        return (
            self.seeds[head[0] % len(self.seeds)],
            options[head[1]] if head[1] < len(options) else {},
            data[2:],
        )

    def changed(self, atheris: Any, data: bytes, most: int, number: int) -> bytes:
        """An input made of another: by structure or byte by byte, now and then other options."""
        rng = random.Random(number)
        one, _, content = self.parts(data)
        options = rng.randrange(len(self.fuzz.OPTIONS)) if rng.random() < 0.1 else 255
        if rng.random() < 0.8 and len(data) > 1:
            options = data[1]
        head = bytes((self.seeds.index(one), options))
        if rng.random() < FRESH:
            content = self.fuzz.mutated(one, self.seeds, rng)
        elif rng.random() < 0.5:
            content = self.fuzz.mutated(type(one)(one.name, content), self.seeds, rng)
        else:
            content = atheris.Mutate(content, max(1, most - 2))
        return (head + content)[:most]


def attack(given: argparse.Namespace, folder: Path, corpus: Path) -> None:
    """Runs libFuzzer in this process, which it ends."""
    import atheris

    fuzz = instrumented_fuzz(atheris)
    resource.setrlimit(resource.RLIMIT_DATA, (BYTES, BYTES))
    warnings.simplefilter("ignore")
    deadline = time.monotonic() + 60 * given.minutes
    target = Target(fuzz, folder, corpus, given.count, deadline)
    warnings.simplefilter("error")
    warnings.simplefilter("ignore", fuzz.InputWarning)
    signal.signal(signal.SIGALRM, fuzz.hung)
    if given.only is not None:
        target(given.only.read_bytes())
        sys.stderr.write(f"{target.told} {target.kinds}\n")
        return
    settings = ["-timeout=0", f"-max_len={LONGEST}", f"-seed={given.seed}", "-rss_limit_mb=3000"]
    atheris.Setup(
        ["guided", *settings, "-len_control=0", str(corpus)],
        target,
        custom_mutator=lambda data, most, number: target.changed(atheris, data, most, number),
    )
    atheris.Fuzz()


def progress(text: str) -> list[tuple[int, str, int, int, int]]:
    """What libFuzzer tells: inputs so far, why it tells, edges, features, inputs that it keeps."""
    found = [match.groups() for match in STATUS.finditer(text)]
    return [(int(n), why, int(edges), int(ft), int(kept)) for n, why, edges, ft, kept in found]


def run(given: argparse.Namespace, corpus: Path) -> dict[str, Any]:
    """Attacks in a process of its own, and gives what it told."""
    began = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="guided-") as place:
        folder = Path(place)
        (folder / "files").mkdir()
        command = [sys.executable, "-m", "tests.long.guided", *sys.argv[1:]]
        command += ["--corpus", str(corpus), "--within", str(folder / "files")]
        with (folder / "log").open("w+") as log:
            status = subprocess.run(command, check=False, cwd=ROOT, stderr=log).returncode
            log.seek(0)
            lines = log.read()
        told = folder / "files" / "told.json"
        done = json.loads(told.read_text()) if told.exists() else {"told": {}, "kinds": {}}
    if status:
        done["kinds"][f"ended with {status}: {lines[-300:]!r}"] = 1
    return {**done, "steps": progress(lines), "seconds": time.perf_counter() - began}


def told_of(given: argparse.Namespace, done: dict[str, Any]) -> str:
    """The log of a run."""
    told, steps = Counter(done["told"]), done["steps"]
    first = [step for step in steps if step[1] == "INITED"]
    rows: list[list[object]] = [
        [when, *step[:1], *step[2:]]
        for when, step in zip(("the seeds", "in the end"), [*first[:1], *steps[-1:]], strict=False)
    ]
    rate = told["tried"] / done["seconds"]
    return (
        f"# Fuzzed readers, guided by coverage\n\n`python -m tests.long.guided --count"
        f" {told['tried']} --seed {given.seed}`: {told['tried']} inputs, {told['accepted']}"
        f" accepted, {told['compared']} of these compared with the strict reader. Commit"
        f" {commit()}; {machine()}; {done['seconds']:.0f} s, {rate:.0f} inputs a second.\n\n"
        + table(["after", "inputs", "edges", "features", "inputs kept"], rows)
        + found_in([f"{kind} ({n} times)" for kind, n in done["kinds"].items()])
    )


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.long.guided", description=__doc__)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--minutes", type=float, default=float("inf"))
    parser.add_argument("--seed", type=int, default=15)
    parser.add_argument("--corpus", type=Path, help="a folder of inputs, kept and gone on from")
    parser.add_argument("--only", type=Path, help="reads one input that was found")
    parser.add_argument("--within", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, default=LOGS / "guided.md")
    given = parser.parse_args()
    if importlib.util.find_spec("atheris") is None:
        raise SystemExit(ABSENT)
    with tempfile.TemporaryDirectory(prefix="guided-") as place:
        corpus = given.corpus or Path(place) / "corpus"
        corpus.mkdir(parents=True, exist_ok=True)
        if given.only is not None or given.within is not None:
            folder = given.within or Path(place) / "files"
            folder.mkdir(exist_ok=True)
            attack(given, folder, corpus.resolve())
            return
        given.out.write_text(told_of(given, run(given, corpus.resolve())))
        sys.stderr.write(given.out.read_text())


if __name__ == "__main__":
    main()
