"""The figures that are promised, in this folder's README, and six of them in the top one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from fnmatch import fnmatchcase

from benchmarks.suite.harness import ROOT, Metric, in_digits
from benchmarks.suite.report import README, Entry, figure_of, metric_of, with_block
from pcm_jax.tables import markdown

MARKERS = "<!-- how fast: generated, do not edit -->", "<!-- end of how fast -->"
TOP = ROOT / "README.md"
TOP_MARKERS = "<!-- six figures: generated, do not edit -->", "<!-- end of six figures -->"

ROWS = {
    "Q of 1,000 closures in space, an ordered pair": "distances/SE3-1000/pair",
    "… of 3,000": "distances/SE3-3000-from-marginals/pair",
    "… cores kept busy": "distances/SE3-*/cores",
    "… of 1,000, given covariances checked and gathered": (
        "distances/SE3-1000-from-marginals/pair_from_marginals"
    ),
    "… peak memory over the inputs, 3,000": "distances/SE3-3000-from-marginals/peak_over_inputs",
    "… in float32, the largest change": "distances/float32-*/error",
    "20,000 closures in space straight to a graph": "streaming/SE3-20000/seconds",
    "… peak memory": "streaming/SE3-20000/peak_memory",
    "… growth from 10,000, power of m": "streaming/SE3-20000/slope",
    "exact clique, 15 hard graphs right": "cliques/hard/right",
    "… time over mcqd's (C++), geometric mean": "cliques/hard/over_mcqd",
    "… the worst": "cliques/hard/worst_over_mcqd",
    "… the worst over networkx's, where that finishes": "cliques/hard-peers/over_networkx",
    "exact clique, 150 planted in 1,000": "cliques/planted/planted-150",
    "… 300 in 3,000": "cliques/planted/planted-300",
    "… 500 in 10,000": "cliques/planted-10000/planted-500",
    "10,000 cliques in one program, over one by one": "cliques/batched/*",
    "Gauss–Newton over GTSAM's, the slowest of eight graphs": "optimization/*/blocks_over_gtsam",
    "… geometric mean": "optimization/all-graphs/blocks_over_gtsam",
    "… by CHOLMOD, geometric mean": "optimization/all-graphs/cholmod_over_gtsam",
    "… peak memory of the solve over GTSAM's, the largest": "memory/*_solving",
    "… of the whole process": "memory/*_process",
    "first `optimize` in a process, compilation included, the slowest": "optimization/*/first_call",
    "symbolic plan of City10000": "optimization/plan-city10000/first_call",
    "… of torus3D": "optimization/plan-torus3D/first_call",
    "City10000 in one go over GTSAM's LAGO + Gauss–Newton": (
        "optimization/one-shot-city10000/over_gtsam"
    ),
    "joint marginals of 300 poses over GTSAM's": "marginals/*-300/*over_gtsam",
    "… of 1,000": "marginals/*-1000/*over_gtsam",
    "a merge in a sweep, 10,000 poses": "sweeps/merges-city10000/blocks",
    "… by CHOLMOD": "sweeps/merges-city10000/cholmod",
    "10,000 worlds of 115 closures, Q and three methods": "world_sweeps/SE2-10000/seconds",
    "`import pcm_jax`": "end_to_end/import/pcm_jax",
    "… and all that a merge needs, over `import jax, numpy, scipy`": (
        "end_to_end/import/merge_over_foundations"
    ),
    "`pcm-jax merge` of four robots, nothing cached, over that import": (
        "end_to_end/commands/merge_over_import"
    ),
    "… the second time": "end_to_end/commands/merge_again_over_import",
    "`pcm-jax demo`, with its picture": "end_to_end/commands/demo_over_import",
    "`pcm-jax --help`": "end_to_end/commands/help",
    "first merge in a process, two maps of 1,000 in the plane": "end_to_end/merge-SE2/first",
    "… in space": "end_to_end/merge-SE3/first",
    "… compilation for another size": "end_to_end/merge-*/other_size_compiles",
}
"""A metric's name, or a pattern, of whose metrics the worst counts."""

SIX = {
    "two maps of 1,000 poses and 115 candidates, from odometry to one map": (
        "{} the first time in a process, then {}",
        ("end_to_end/merge-SE2/first", "end_to_end/merge-SE2/again"),
    ),
    "the same in space, 108 candidates": (
        "{}, then {}",
        ("end_to_end/merge-SE3/first", "end_to_end/merge-SE3/again"),
    ),
    "20,000 candidates in space straight to a consistency graph": (
        "{}, {}",
        ("streaming/SE3-20000/seconds", "streaming/SE3-20000/peak_memory"),
    ),
    "the largest consistent set of 10,000 candidates, with a proof (500 planted)": (
        "{}",
        ("cliques/planted-10000/planted-500",),
    ),
    "Gauss–Newton against GTSAM's on eight public graphs": (
        "{} its time in the mean, {} on the slowest",
        ("optimization/all-graphs/blocks_over_gtsam", "optimization/*/blocks_over_gtsam"),
    ),
    "memory of such a solve against GTSAM's": ("up to {}", ("memory/*_solving",)),
}
"""Figures in users' units: a sentence, and the metrics whose values it takes."""

Entries = Mapping[str, Entry]


def table(entries: Entries) -> str:
    """The promised figures as Markdown."""
    lines = []
    for label, pattern in ROWS.items():
        name, entry = _worst(entries, pattern)
        metric = metric_of(name, entry)
        value = in_digits(entry["value"], metric)
        if entry["reached"] is False:
            value = f"**{value}**"
        only = pattern.partition("*")[0].rpartition("/")[0]
        lines.append((label, figure_of(entry, metric), value, f"`{only}`"))
    return markdown(("", "to reach", "measured", "`python -m benchmarks --only`"), lines)


def six(entries: Entries) -> str:
    """Six figures in users' units, as Markdown."""
    rows = []
    for label, (sentence, patterns) in SIX.items():
        found = [entries[_worst(entries, pattern)[0]] for pattern in patterns]
        values = [in_digits(each["value"], _two_digits(each)) for each in found]
        rows.append((label, sentence.format(*values)))
    return markdown(("", "measured"), rows)


def _two_digits(entry: Entry) -> Metric:
    return Metric("", entry["unit"], entry["direction"], digits=2)


def missed(entries: Entries) -> str:
    """Figures that are missed, by reason, a line each."""
    by_reason: dict[str, list[str]] = {}
    for name, entry in entries.items():
        promised = any(fnmatchcase(name, pattern) for pattern in ROWS.values())
        if entry["reached"] is False and promised:
            value = in_digits(entry["value"], metric_of(name, entry))
            by_reason.setdefault(entry["reason"], []).append(f"`{name}` ({value})")
    return "\n".join(
        f"- {', '.join(names)}: {reason or 'not looked into'}."
        for reason, names in by_reason.items()
    )


def _worst(entries: Entries, pattern: str) -> tuple[str, Entry]:
    """The metric farthest from its figure, of those that have a value, and one."""
    found = {name: entry for name, entry in entries.items() if fnmatchcase(name, pattern)}

    def by_how_much(name: str) -> float:
        value = found[name]["value"]
        if value is None or found[name].get("figure", 0.0) is None:
            return -math.inf
        return value if found[name]["direction"] == "lower" else -value

    name = max(found, key=by_how_much)
    return name, found[name]


def with_headlines(text: str, entries: Entries) -> str:
    """A document with both between its markers."""
    parts = [part for part in (table(entries), missed(entries)) if part]
    return with_block(text, MARKERS, "\n\n".join(parts))


def record(entries: Entries) -> None:
    """Writes them into both READMEs."""
    README.write_text(with_headlines(README.read_text(), entries))
    TOP.write_text(with_block(TOP.read_text(), TOP_MARKERS, six(entries)))
