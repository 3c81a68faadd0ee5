"""The figures that are promised, in the top README: measured, with the command of each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.suite.harness import ROOT, in_digits
from benchmarks.suite.report import figure_of, metric_of

README = ROOT / "README.md"
MARKERS = "<!-- how fast: generated, do not edit -->", "<!-- end of how fast -->"

ROWS = {
    "Q of 1,000 closures in space, an ordered pair": "distances/SE3-1000/pair",
    "the same of 3,000": "distances/SE3-3000-from-marginals/pair",
    "the same of 1,000, joint covariances read and checked": (
        "distances/SE3-1000-from-marginals/pair_from_marginals"
    ),
    "peak memory over its inputs, 3,000": "distances/SE3-3000-from-marginals/peak_over_inputs",
    "Q in float32, largest change": "distances/float32-SE3/error",
    "20,000 closures in space to a graph": "streaming/SE3-20000/seconds",
    "peak memory of that": "streaming/SE3-20000/peak_memory",
    "growth from 10,000 to 20,000": "streaming/SE3-20000/slope",
    "10,000 worlds of 115 closures, three methods": "world_sweeps/SE2-10000/seconds",
    "15 hard cliques, right": "cliques/hard/right",
    "their times over mcqd's (C++), geometric mean": "cliques/hard/over_mcqd",
    "the worst of them": "cliques/hard/worst_over_mcqd",
    "over networkx's, where that finishes, the worst": "cliques/hard-peers/over_networkx",
    "150 planted in 1,000": "cliques/planted/planted-150",
    "300 planted in 3,000": "cliques/planted/planted-300",
    "500 planted in 10,000": "cliques/planted-10000/planted-500",
    "10,000 cliques in one program over one by one": "cliques/batched/consistency-like",
}


def table(entries: Mapping[str, Mapping[str, Any]]) -> str:
    """The promised figures as Markdown."""
    lines = [("", "to reach", "measured", "`python -m benchmarks --only`"), ("---",) * 4]
    for label, name in ROWS.items():
        entry = entries[name]
        metric = metric_of(name, entry)
        value = in_digits(entry["value"], metric)
        if entry["reached"] is False:
            value = f"**{value}**"
        lines.append((label, figure_of(entry, metric), value, f"`{name.rpartition('/')[0]}`"))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def missed(entries: Mapping[str, Mapping[str, Any]]) -> str:
    """The reasons of those that are missed, a line each."""
    short = [(label, entries[name]) for label, name in ROWS.items()]
    return "\n".join(
        f"- *{label}*: {entry['reason'] or 'not looked into'}."
        for label, entry in short
        if entry["reached"] is False
    )


def with_headlines(text: str, entries: Mapping[str, Mapping[str, Any]]) -> str:
    """A document with both between its markers."""
    before, _, rest = text.partition(MARKERS[0])
    _, _, after = rest.partition(MARKERS[1])
    parts = [part for part in (table(entries), missed(entries)) if part]
    return "\n\n".join([before + MARKERS[0], *parts, MARKERS[1]]) + after


def record(entries: Mapping[str, Mapping[str, Any]]) -> None:
    """Writes them into the README."""
    README.write_text(with_headlines(README.read_text(), entries))
