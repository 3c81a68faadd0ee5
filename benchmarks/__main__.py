"""`python -m benchmarks`: the suite, or part of it."""

from __future__ import annotations

import argparse
import importlib
import json
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.suite import headlines, report
from benchmarks.suite.harness import DATA, Case, Settings, chosen, run
from pcm_jax.store import write_json

SUBJECTS = (
    "optimization",
    "marginals",
    "memory",
    "sweeps",
    "distances",
    "streaming",
    "world_sweeps",
    "calibration",
    "cliques",
    "files",
    "end_to_end",
)


def all_cases() -> list[Case]:
    """The cases of every subject."""
    modules = (importlib.import_module(f"benchmarks.suite.{subject}") for subject in SUBJECTS)
    return [case for module in modules for case in module.CASES]


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the suite; 1 if a case broke (a figure that is missed breaks nothing)."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.record and (options.quick or options.only):
        parser.error("--record: expected the whole suite, without --quick and --only")
    settings = Settings(options.quick, options.data.resolve())
    cases = chosen(all_cases(), settings, options.only)
    if not cases:
        parser.error(f"--only: no case starts so; expected one of {', '.join(SUBJECTS)}, or longer")
    start = time.perf_counter()
    outcomes = run(cases, settings, options.out)
    entries = report.summary(cases, outcomes, report.read_baseline())
    write_json(options.out / "summary.json", entries)
    machine = json.loads((options.out / "machine.json").read_text())
    if options.record:
        report.record(entries, machine)
        headlines.record(entries)
    print(f"\n{report.table(entries)}\n\n{_counts(entries)}")
    print(f"{time.perf_counter() - start:.0f} s; wrote {options.out / 'summary.json'}")
    return int(any(outcome.failure for outcome in outcomes.values()))


def _counts(entries: dict[str, report.Entry]) -> str:
    reached = [entry["reached"] for entry in entries.values()]
    worse = [name for name, entry in entries.items() if entry["change"] == "worse"]
    missed = [name for name, entry in entries.items() if entry["reached"] is False]
    lines = [f"{reached.count(True)} figures reached, {len(missed)} missed"]
    lines += [f"missed: {', '.join(missed)}"] * bool(missed)
    lines += [f"worse than the baseline: {', '.join(worse)}"] * bool(worse)
    return "\n".join(lines)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=main.__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer repeats, no case of minutes")
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="NAME", help="cases whose names start so"
    )
    parser.add_argument(
        "--data", type=Path, default=DATA, help="public pose graphs (default: beside the checkout)"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for results; resumes there")
    parser.add_argument(
        "--record", action="store_true", help="make the results the baseline and README's table"
    )
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
