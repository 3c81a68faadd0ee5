"""Summary, table, baseline, and the table in this folder's README."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.suite.harness import Case, Metric, Outcome, in_digits
from pcm_jax.store import write_json
from pcm_jax.tables import markdown

HERE = Path(__file__).parent
BASELINE = HERE / "baseline.json"
README = HERE.parent / "README.md"
MARKERS = "<!-- results: generated, do not edit -->", "<!-- end of results -->"
HEAD = ("metric", "value", "to reach", "reached", "of baseline", "peak MB", "how")

Entry = dict[str, Any]


def read_baseline(path: Path = BASELINE) -> dict[str, Entry]:
    """The committed metrics, by name; none where there is no file."""
    return json.loads(path.read_text())["metrics"] if path.exists() else {}


def summary(
    cases: Sequence[Case], outcomes: Mapping[str, Outcome], baseline: Mapping[str, Entry]
) -> dict[str, Entry]:
    """Contents of `summary.json`: every metric by its full name, "subject/what/metric"."""
    return {
        f"{case.name}/{metric.name}": _entry(
            metric, outcomes[case.name], baseline.get(f"{case.name}/{metric.name}", {})
        )
        for case in cases
        for metric in case.metrics
    }


def _entry(metric: Metric, outcome: Outcome, before: Entry) -> Entry:
    value, note = outcome.measured[metric.name]
    baseline = before.get("value")
    ratio = None
    if value is not None and baseline and metric.tolerance is not None:
        ratio = value / baseline
    return {
        "value": value,
        "unit": metric.unit,
        "direction": metric.direction,
        "baseline": baseline,
        "tolerance": metric.tolerance,
        "figure": metric.figure,
        "reached": metric.reached(value),
        "ratio": ratio,
        "change": _change(metric, ratio),
        "note": note,
        "case_seconds": outcome.seconds,
        "peak_memory_mb": None if value is None else outcome.peak_memory,
        "digits": metric.digits,
        "reason": metric.reason,
    }


def _change(metric: Metric, ratio: float | None) -> str | None:
    """Says "same", "better" or "worse" than the baseline; "changed" where neither is better."""
    if ratio is None or metric.tolerance is None:
        return None
    if 1 / (1 + metric.tolerance) <= ratio <= 1 + metric.tolerance:
        return "same"
    if metric.direction == "target":
        return "changed"
    return "better" if (ratio < 1) == (metric.direction == "lower") else "worse"


def table(entries: Mapping[str, Entry]) -> str:
    """All entries as a Markdown table with aligned columns; one that is all empty is left out."""
    rows = [_row(name, entry) for name, entry in entries.items()]
    told = [k for k, column in enumerate(zip(*rows, strict=True)) if any(column)]
    chosen = [[row[k] for k in told] for row in (HEAD, *rows)]
    return markdown(chosen[0], chosen[1:], aligned=True)


def _row(name: str, entry: Entry) -> tuple[str, ...]:
    metric = metric_of(name, entry)
    verdict = {True: "yes", False: "**no**", None: ""}[entry["reached"]]
    ratio = "" if entry["ratio"] is None else f"{entry['ratio']:.2f} {entry['change']}"
    memory = "" if entry["peak_memory_mb"] is None else f"{entry['peak_memory_mb']:.0f}"
    value = in_digits(entry["value"], metric)
    return name, value, figure_of(entry, metric), verdict, ratio, memory, entry["note"]


def metric_of(name: str, entry: Entry) -> Metric:
    """The metric that a value of `summary.json` is shown with."""
    return Metric(name, entry["unit"], entry["direction"], digits=entry["digits"])


def figure_of(entry: Entry, metric: Metric) -> str:
    """The figure to reach, in words; empty where nothing is promised."""
    figure = entry["figure"]
    if figure is None:
        return ""
    if metric.direction == "target":
        return f"{figure[0]:.{metric.digits}g} to {in_digits(figure[1], metric)}"
    return f"{'≤' if metric.direction == 'lower' else '≥'} {in_digits(figure, metric)}"


def record(entries: Mapping[str, Entry], machine: Entry) -> None:
    """Makes results the committed baseline, and the table in the README."""
    kept = ("value", "unit", "direction", "tolerance")
    metrics = {
        name: {key: entry[key] for key in kept}
        for name, entry in entries.items()
        if entry["value"] is not None
    }
    write_json(BASELINE, {"machine": machine, "metrics": metrics})
    README.write_text(with_results(README.read_text(), entries, machine))


def with_results(text: str, entries: Mapping[str, Entry], machine: Entry) -> str:
    """A document with the results between its markers."""
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    described = (
        f"Measured on {machine['date']} at commit {machine['commit']}: {machine['processor']},"
        f" {machine['cores']} cores, {machine['memory_gb']} GB; Python {machine['python']},"
        f" {packages}; {machine['blas_threads']} BLAS threads;"
        f" load {machine['load_at_start']} when it started."
    )
    spent = ", ".join(f"{subject} {s:.0f} s" for subject, s in _seconds(entries).items())
    results = table({name: {**entry, "ratio": None} for name, entry in entries.items()})
    generated = f"{described}\nRun time: {spent}.\n\n{results}"
    return with_block(text, MARKERS, generated)


def with_block(text: str, markers: tuple[str, str], block: str) -> str:
    """A document with `block` between its markers, instead of what was there."""
    before, rest = text.split(markers[0])
    _, after = rest.split(markers[1])
    return f"{before}{markers[0]}\n\n{block}\n\n{markers[1]}{after}"


def _seconds(entries: Mapping[str, Entry]) -> dict[str, float]:
    """Run time by subject; the metrics of one case share theirs."""
    cases = {name.rsplit("/", 1)[0]: entry["case_seconds"] for name, entry in entries.items()}
    subjects: dict[str, float] = {}
    for name, seconds in cases.items():
        subject = name.split("/")[0]
        subjects[subject] = subjects.get(subject, 0.0) + seconds
    return subjects
