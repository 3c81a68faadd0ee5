"""Mutation testing: one small change at a time to a folder of the package; its tests must notice.

    python -m tests.long.mutants --folder clique --count 40

The changes of `_sites` are shuffled by the seed; of those on lines that the folder's tests execute
the first `count` are tried, in a copy of the tree that is removed in the end. Results are appended
to `logs/mutants.jsonl` as they come, and a run goes on after those that are there. Whoever reads a
survivor writes down why it is none, or the test that kills it:

    python -m tests.long.mutants --again              # survivors once more, slow tests included
    python -m tests.long.mutants --killed KEY TEST    # survivors, by a test that is new
    python -m tests.long.mutants --judge KEY "why"    # equivalent: why
    python -m tests.long.mutants --summary            # logs/mutants.md
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

from ._executed import FOLDER, NOTED
from ._log import LOGS, ROOT, commit, machine, table
from ._sites import Change, changes

TESTS = {
    "lie": ["tests/lie"],
    "sparse": ["tests/sparse", "tests/mapping/test_covariance.py"],
    "mapping": ["tests/mapping"],
    "consistency": ["tests/consistency", "tests/pipeline/test_evidence.py"],
    "clique": ["tests/clique"],
    "selection": ["tests/selection", "tests/pipeline/test_select.py"],
    "integrity": ["tests/integrity"],
    "merging": ["tests/merging", "tests/pipeline/test_merge.py"],
}
BYTES = 16 << 30  # of address space, so that a change cannot take the machine's memory
RESULTS = LOGS / "mutants.jsonl"


class Copy:
    """A copy of the tree, with programs that the tests compile kept beside it."""

    def __init__(self, place: Path):
        self.root, self.programs = place / "checkout", place / "programs"
        self.commit = commit()
        for name in ("pcm_jax", "tests", "benchmarks"):
            ignore = shutil.ignore_patterns("__pycache__", "results", "logs")
            shutil.copytree(ROOT / name, self.root / name, ignore=ignore)
        for name in ("pyproject.toml", "README.md"):
            shutil.copy(ROOT / name, self.root)
        if (ROOT.parent / "shared").is_dir():
            (place / "shared").symlink_to((ROOT.parent / "shared").resolve())
        self.programs.mkdir()
        compiled = [sys.executable, "-m", "compileall", "-q", "pcm_jax"]
        subprocess.run(compiled, cwd=self.root, check=True)

    def test(self, tests: list[str], limit: float, *options: str, **environment: str) -> str:
        """Runs tests, and says: passed, failed, or timeout."""
        # Of two versions of one length in one second Python would take the compiled older one.
        kept = {"PYTHONPATH": str(self.root), "PYTHONDONTWRITEBYTECODE": "1"}
        kept |= {"JAX_COMPILATION_CACHE_DIR": str(self.programs), "OPENBLAS_NUM_THREADS": "1"}
        command = [sys.executable, "-m", "pytest", "-x", "-q", "--tb=line", "-o", "addopts="]
        command += ["-p", "no:cacheprovider", *options, *tests]
        process = subprocess.Popen(
            command,
            cwd=self.root,
            env=os.environ | kept | environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        resource.prlimit(process.pid, resource.RLIMIT_AS, (BYTES, BYTES))
        try:
            self.told, _ = process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            return "timeout"
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        return "failed" if process.returncode else "passed"


class Folder:
    """A folder of the package with its tests, which pass as the tree is."""

    def __init__(self, copy: Copy, name: str):
        self.copy, self.name, self.tests = copy, name, TESTS[name]
        noted = copy.root / "lines.json"
        environment = {FOLDER: str(copy.root / "pcm_jax" / name), NOTED: str(noted)}
        options = ["-m", "not slow", "-p", "tests.long._executed"]
        began = time.perf_counter()
        first = copy.test(self.tests, 3600, *options, **environment)
        if first != "passed":
            raise SystemExit(f"{name}: the tests do not pass unchanged\n{copy.told}")
        self.executed = {(file, line): tests for file, line, tests in json.loads(noted.read_text())}
        self.seconds = time.perf_counter() - began

    def changes(self, seed: int) -> list[tuple[str, Change]]:
        """All changes to executed lines, shuffled, each with its module."""
        found = []
        for path in sorted((self.copy.root / "pcm_jax" / self.name).rglob("*.py")):
            module = path.relative_to(self.copy.root).as_posix()
            found += [
                (module, change)
                for change in changes(path.read_text())
                if (str(path), change.line) in self.executed
            ]
        random.Random(f"{seed} {self.name}").shuffle(found)
        return found

    def tried(self, module: str, change: Change, *options: str) -> str:
        """Makes a change, runs the tests, those that execute its line first, and takes it back."""
        path = self.copy.root / module
        text = path.read_text()
        first = [test for test in self.executed.get((str(path), change.line), []) if test]
        try:
            path.write_text(change.applied(text))
            for compiled in path.parent.glob(f"__pycache__/{path.stem}.*.pyc"):
                compiled.unlink()
            limit = 60 + 2 * self.seconds
            options = options or ("-m", "not slow")
            if first and self.copy.test(first, limit, *options) != "passed":
                return "killed"
            done = self.copy.test(self.tests, limit, *options)
        finally:
            path.write_text(text)
        return {"passed": "survived", "failed": "killed"}.get(done, done)


def results() -> dict[str, dict]:
    """What was tried before, by module and change; later lines say more of the same ones."""
    found: dict[str, dict] = {}
    for line in RESULTS.read_text().splitlines() if RESULTS.exists() else []:
        entry = json.loads(line)
        found.setdefault(entry["key"], {}).update(entry)
    return found


def note(**entry: object) -> None:
    """Appends a result."""
    RESULTS.parent.mkdir(exist_ok=True)
    with RESULTS.open("a") as file:
        file.write(json.dumps(entry, ensure_ascii=False) + "\n")


def run(names: list[str], count: int, seed: int, deadline: float) -> None:
    """Tries changes to each folder until `count` of them are in the log, or time is up."""
    with tempfile.TemporaryDirectory(prefix="mutants-") as place:
        copy = Copy(Path(place))
        for name in names:
            known = results()
            open_ = count - sum(entry["folder"] == name for entry in known.values())
            if open_ <= 0 or time.monotonic() > deadline:
                continue
            folder = Folder(copy, name)
            untried = [
                (module, change)
                for module, change in folder.changes(seed)
                if f"{module} {change.key}" not in known
            ]
            for module, change in untried[:open_]:
                if time.monotonic() > deadline:
                    break
                began = time.perf_counter()
                result = folder.tried(module, change)
                seconds = round(time.perf_counter() - began, 1)
                key = f"{module} {change.key}"
                what = {"key": key, "folder": name, "kind": change.kind, "line": change.line}
                how = {"result": result, "seconds": seconds, "seed": seed, "commit": copy.commit}
                note(**what, **how)
                sys.stderr.write(f"{result} {seconds} {module}:{change.line} {change.key}\n")


def again() -> None:
    """Tries the survivors that nobody has judged with today's tests, slow ones included."""
    entries = [e for e in results().values() if e["result"] == "survived" and not e.get("judged")]
    with tempfile.TemporaryDirectory(prefix="mutants-") as place:
        copy = Copy(Path(place))
        for name in dict.fromkeys(entry["folder"] for entry in entries):
            folder = Folder(copy, name)
            all_changes = {f"{module} {c.key}": (module, c) for module, c in folder.changes(0)}
            for entry in entries:
                if entry["folder"] != name:
                    continue
                if entry["key"] not in all_changes:
                    sys.stderr.write(f"no longer there: {entry['key']}\n")
                    continue
                result = folder.tried(*all_changes[entry["key"]], "-m", "slow or not slow")
                sys.stderr.write(f"{result} {entry['key']}\n")
                if result != "survived":
                    note(key=entry["key"], result="killed since", commit=copy.commit)


def killed_by(key: str, test: str) -> None:
    """Notes that one test kills a survivor, if it passes without the change and not with it."""
    module, _, name = key.partition(" ")
    (change,) = (one for one in changes((ROOT / module).read_text()) if one.key == name)
    with tempfile.TemporaryDirectory(prefix="mutants-") as place:
        copy = Copy(Path(place))
        before = copy.test([test], 600)
        path = copy.root / module
        path.write_text(change.applied(path.read_text()))
        for compiled in path.parent.glob(f"__pycache__/{path.stem}.*.pyc"):
            compiled.unlink()
        after = copy.test([test], 600)
    if (before, after) != ("passed", "failed"):
        raise SystemExit(f"{before} without the change, {after} with it\n{copy.told}")
    note(key=key, result="killed since", by=test, commit=copy.commit)


def summary() -> str:
    """The log as a table, and the survivors with why they live."""
    entries = list(results().values())
    rows, listed = [], []
    for name in TESTS:
        own = [entry for entry in entries if entry["folder"] == name]
        told = Counter(entry["result"] for entry in own)
        alive = [entry for entry in own if entry["result"] == "survived"]
        equivalent = sum(bool(entry.get("judged", "").startswith("equivalent")) for entry in alive)
        meant = len(own) - equivalent
        share = f"{(len(own) - len(alive)) / meant:.0%}" if meant else "–"
        numbers = [told[kind] for kind in ("killed", "timeout", "killed since")]
        rows.append([name, len(own), *numbers, equivalent, len(alive) - equivalent, share])
        listed += [f"- `{e['key']}`: {e.get('judged', 'not judged yet')}" for e in alive]
    head = ["folder", "mutants", "killed", "by time", "by a new test or a slow one"]
    head += ["equivalent", "alive", "killed of those that change something"]
    commits = sorted({entry["commit"].split()[0] for entry in entries})
    return (
        "# Mutants\n\n`python -m tests.long.mutants`, of which this is the summary;"
        f" `mutants.jsonl` has each one. Commits {', '.join(commits)}; {machine()};"
        f" {sum(entry.get('seconds', 0) for entry in entries):.0f} s.\n\n"
        + table(head, rows)
        + "\n## Survivors\n\n"
        + "\n".join(listed)
        + "\n"
    )


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.long.mutants", description=__doc__)
    parser.add_argument("--folder", nargs="+", choices=TESTS, default=list(TESTS))
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--minutes", type=float, default=float("inf"))
    parser.add_argument("--seed", type=int, default=15)
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--judge", nargs=2, metavar=("KEY", "WHY"))
    parser.add_argument("--killed", nargs=2, metavar=("KEY", "TEST"))
    parser.add_argument("--summary", action="store_true")
    given = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # shells ignore it in the background
    if given.judge:
        key, why = given.judge
        if key not in results():
            raise SystemExit(f"no such mutant: {key}")
        note(key=key, judged=why)
    elif given.killed:
        killed_by(*given.killed)
    elif given.again:
        again()
    elif not given.summary:
        run(given.folder, given.count, given.seed, time.monotonic() + 60 * given.minutes)
    (LOGS / "mutants.md").write_text(summary())


if __name__ == "__main__":
    main()
