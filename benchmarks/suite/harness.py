"""Cases and their metrics; each case runs in a process of its own, and is kept once it is done.

A fresh process per case keeps compilations, caches and peak memory apart. What is done is written
to `cases/` in the output folder, so that a run that was killed goes on where it stopped; results of
other sources, options or packages than the present ones are measured again.
"""

from __future__ import annotations

import multiprocessing
import os
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal, NamedTuple

from benchmarks.suite.measure import Patience, cores, machine, peak_memory
from pcm_jax.store import Store, digest, write_json

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
THREADS = "OPENBLAS_NUM_THREADS"
ENVIRONMENT = {
    # As users have it. The package itself keeps small fronts on one thread; GTSAM has only one.
    THREADS: str(cores()),
    "JAX_PLATFORMS": "cpu",
    "JAX_ENABLE_X64": "true",
    "JAX_ENABLE_COMPILATION_CACHE": "false",
}
"""What every case runs with, unless the caller's environment says otherwise."""


class NotMeasuredError(Exception):
    """A case has nothing to measure on or with: the message says what is missing."""


class Settings(NamedTuple):
    """Settings from the command line.

    Attributes:
        quick: fewer repeats, and no case that takes minutes.
        data: folder of public pose graphs, which may be absent.
    """

    quick: bool = False
    data: Path = DATA

    @property
    def patience(self) -> Patience:
        """Repeats of what takes a fraction of a second."""
        return Patience(3, 0.5) if self.quick else Patience(7, 3.0)


class Metric(NamedTuple):
    """One figure.

    Attributes:
        name: within its case.
        unit: "×" for a ratio to a peer, measured in the same run.
        direction: which way is better; "target": neither.
        figure: what is to be reached; for "target", the least and the largest good value.
        tolerance: relative change against the baseline that is no news; None where the figure
            alone counts, as for rounding errors.
        digits: of the value, in tables.
        reason: why the figure is missed, where it is, as profiling showed it.
    """

    name: str
    unit: str
    direction: Literal["lower", "higher", "target"] = "lower"
    figure: float | tuple[float, float] | None = None
    tolerance: float | None = 0.5
    digits: int = 3
    reason: str = ""

    def reached(self, value: float | None) -> bool | None:
        """Says whether a value is as good as it should be; None where nothing is promised."""
        if self.figure is None or value is None:
            return None
        if isinstance(self.figure, tuple):
            return self.figure[0] <= value <= self.figure[1]
        return value <= self.figure if self.direction == "lower" else value >= self.figure


class Measured(NamedTuple):
    """A metric's value, or None and the reason; the note says how it came about."""

    value: float | None
    note: str = ""


class Case(NamedTuple):
    """Metrics that are measured together.

    Attributes:
        name: "subject/what".
        metrics: what `measure` returns, by name.
        measure: importable, so that another process can call it.
        slow: left out by `--quick`.
        applies: whether there is reason to run it; stand-ins do not apply where real data is.
    """

    name: str
    metrics: Sequence[Metric]
    measure: Callable[[Settings], Mapping[str, Measured]]
    slow: bool = False
    applies: Callable[[Settings], bool] = lambda settings: True


class Outcome(NamedTuple):
    """The outcome of a case.

    Attributes:
        measured: by metric; one whose measurement was not possible has no value.
        seconds: of the whole case, preparation included.
        peak_memory: MB, of the whole process.
        failure: traceback, where the case broke.
    """

    measured: dict[str, Measured]
    seconds: float = 0.0
    peak_memory: float | None = None
    failure: str = ""


def chosen(cases: Iterable[Case], settings: Settings, only: Sequence[str]) -> list[Case]:
    """The cases that apply, and whose names start with one of `only` (all, if there is none)."""
    return [
        case
        for case in cases
        if case.applies(settings)
        and not (case.slow and settings.quick)
        and (not only or case.name.startswith(tuple(only)))
    ]


def run(cases: Sequence[Case], settings: Settings, out: Path) -> dict[str, Outcome]:
    """Runs cases one after the other, and prints what they find; those kept in `out` are read."""
    kept = Store(out / "cases", _stamp(settings))
    threads = os.environ.get(THREADS, ENVIRONMENT[THREADS])
    write_json(out / "machine.json", {**machine(), "blas_threads": threads})
    outcomes = {}
    for number, case in enumerate(cases, 1):
        name = case.name.replace("/", ".")
        outcome = _outcome(kept.read(name))
        print(f"[{number}/{len(cases)}] {case.name} ...", "kept" if outcome else "", flush=True)
        if outcome is None:
            outcome = _in_own_process(case, settings)
            if not outcome.failure and any(m.value is not None for m in outcome.measured.values()):
                kept.write(name, outcome._asdict())
        print(_in_lines(case, outcome), flush=True)
        outcomes[case.name] = outcome
    return outcomes


def in_digits(value: float | None, metric: Metric) -> str:
    """A value with its unit, for people."""
    if value is None:
        return "–"
    text = f"{value:.{metric.digits}g}"
    if "e+" in text:
        text = f"{value:,.0f}"
    return f"{text} {metric.unit}".rstrip()


def _in_lines(case: Case, outcome: Outcome) -> str:
    if outcome.failure:
        return outcome.failure
    lines = []
    for metric in case.metrics:
        value, note = outcome.measured[metric.name]
        verdict = {True: "reached", False: "MISSED", None: ""}[metric.reached(value)]
        line = f"    {metric.name:28} {in_digits(value, metric):>16}  {verdict:8} {note}"
        lines.append(line.rstrip())
    return "\n".join(lines)


def _in_own_process(case: Case, settings: Settings) -> Outcome:
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_reply, args=(sender, case.measure, settings), daemon=True)
    start = time.perf_counter()
    with _environment():
        process.start()
    sender.close()
    try:
        answer: _Answer = receiver.recv()
        process.join()
    except EOFError:
        process.join()
        answer = _Answer(failure=f"the process ended with code {process.exitcode}")
    return _checked(case, answer, time.perf_counter() - start)


@contextmanager
def _environment() -> Iterator[None]:
    """A scope in which `ENVIRONMENT` is set, where the caller's own does not say otherwise."""
    before = dict(os.environ)
    os.environ.update(ENVIRONMENT | before)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


class _Answer(NamedTuple):
    """The other process's answer: measurements, or why there are none, or a traceback."""

    measured: dict[str, Measured] | None = None
    reason: str = ""
    failure: str = ""
    peak_memory: float | None = None


def _reply(sender: Connection, measure: Any, settings: Settings) -> None:
    """Body of the other process."""
    try:
        found = {name: Measured(*each) for name, each in measure(settings).items()}
        answer = _Answer({name: each._replace(value=_plain(each)) for name, each in found.items()})
    except NotMeasuredError as reason:
        answer = _Answer(reason=str(reason))
    except Exception:
        answer = _Answer(failure=traceback.format_exc())
    sender.send(answer._replace(peak_memory=round(peak_memory(), 1)))


def _plain(measured: Measured) -> float | None:
    return None if measured.value is None else float(measured.value)


def _checked(case: Case, answer: _Answer, seconds: float) -> Outcome:
    """The answer, with every metric of the case and no other."""
    names, failure = [metric.name for metric in case.metrics], answer.failure
    measured = answer.measured
    if measured is not None and set(measured) != set(names):
        failure = f"{case.name}: measured {sorted(measured)}, expected {sorted(names)}"
    if measured is None or failure:
        reason = Measured(None, "failed" if failure else answer.reason)
        measured = dict.fromkeys(names, reason)
    return Outcome(measured, round(seconds, 2), answer.peak_memory, failure)


def _stamp(settings: Settings) -> str:
    """Digests what results depend on, but for the machine."""
    sources = [ROOT / folder for folder in ("pcm_jax", "benchmarks/suite")]
    return digest(settings, machine()["packages"], files=sources)


def _outcome(kept: Any) -> Outcome | None:
    """Makes an outcome again of what was kept of one."""
    if kept is None:
        return None
    measured = {name: Measured(*each) for name, each in kept["measured"].items()}
    return Outcome(**{**kept, "measured": measured})
