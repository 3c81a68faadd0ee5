"""The table of closures: a row for each, to be sorted and filtered."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pcm_jax.merging import MergeResult
from pcm_jax.report._elements import Markup, element
from pcm_jax.report._facts import FATES, Facts
from pcm_jax.report._words import CLOSE, counted, number, off_by

TOLD = {
    "accepted": "● accepted",
    "refused": "○ refused",
    "rival": "◆ rival",
    "rejected": "✕ rejected",
}
COLUMNS = (
    ("Closure", "number", "index"),
    ("Between", None, "ends"),
    ("Fate", None, "fate"),
    ("Why", "none", "why"),
    ("Agrees with", "number", "number"),
    ("Worst conflict", "number", "number"),
    ("Off by", "number", "number"),
)


def closures_section(result: MergeResult, report: dict[str, Any], facts: Facts) -> Markup:
    """The table of all closures with the controls that filter it."""
    pair_of = {pair: k for k, pair in enumerate(result.candidates.pairs())}
    ends = np.sort([np.asarray(getattr(result.candidates, f"robot_{end}")) for end in "ab"], axis=0)
    pairs = [pair_of[a, b] for a, b in ends.T.tolist()]
    return element(
        "section",
        element("h2", "Every closure, and why", id="closures-title"),
        element(
            "p",
            "Press a closure’s number to see it on the maps, with those it contradicts.",
            element(
                "span",
                " “Agrees with” counts accepted closures of the same two robots; “Worst conflict”"
                " names the one of these that it is furthest from, as a multiple of what may be"
                " (over 1 × they contradict each other); “Off by” is how far it misses in the"
                " merged maps.",
                class_="wide",
            ),
            class_="how",
        ),
        _controls(report, facts),
        element(
            "div",
            element(
                "table",
                element("caption", "Closures", class_="unseen"),
                element("thead", element("tr", *map(_head, COLUMNS))),
                element(
                    "tbody",
                    *(
                        _row(row, facts, k, report["gate"])
                        for row, k in zip(report["closures"], pairs, strict=True)
                    ),
                ),
                id="closures-table",
            ),
            class_="scroll tall",
            tabindex="0",
            role="region",
            aria_label="Closures, table",
        ),
        id="closures",
        aria_labelledby="closures-title",
    )


def _controls(report: dict[str, Any], facts: Facts) -> Markup:
    counts = {fate: int((facts.fate == k).sum()) for k, fate in enumerate(FATES)}
    fates = [element("option", f"all ({len(facts.fate)})", value="")]
    fates += [
        element("option", f"{fate} ({count})", value=fate)
        for fate, count in counts.items()
        if count
    ]
    pairs = [element("option", "all", value="")]
    pairs += [
        element("option", f"{pair['a']} – {pair['b']}", value=k)
        for k, pair in enumerate(report["robot_pairs"])
    ]
    return element(
        "div",
        _labelled("Find", element("input", type="search", id="find", autocomplete="off")),
        _labelled("Fate", element("select", *fates, id="fate")),
        _labelled("Robots", element("select", *pairs, id="pair")) if len(pairs) > 2 else None,
        element(
            "p",
            counted(len(facts.fate), "closure") + " shown",
            id="shown",
            role="status",
            class_="status",
        ),
        class_="controls",
    )


def _labelled(label: str, control: Markup) -> Markup:
    return element("label", element("span", label), control)


def _head(column: tuple[str, str | None, str]) -> Markup:
    name, method, kind = column
    inside = name if method == "none" else element("button", name, type="button")
    return element("th", inside, scope="col", data_sort_method=method, class_=kind)


def _row(row: dict[str, Any], facts: Facts, pair: int, gate: float | None) -> Markup:
    index = row["index"]
    fate = FATES[facts.fate[index]]
    agrees = f"{row['agrees_with']} of {row['of']}" if row["of"] else "–"
    conflict, ratio = _conflict(row["worst_conflict"], gate)
    return element(
        "tr",
        element(
            "th",
            element("button", index, type="button", class_="pick", aria_pressed="false"),
            scope="row",
            data_sort=index,
            class_="index",
        ),
        element("td", row["a"], " → ", row["b"], class_="ends", data_source=row["source"] or None),
        element("td", TOLD[fate], class_=f"fate {fate}"),
        element("td", row["why"], class_="why"),
        _number(agrees, row["agrees_with"] or 0),
        _number(conflict, ratio),
        _number(off_by(facts, index) or "–", float(facts.away[index])),
        id=f"closure-{index}",
        data_closure=index,
        data_fate=fate,
        data_pair=pair,
    )


def _conflict(worst: dict[str, Any] | None, gate: float | None) -> tuple[str, float]:
    """The worst conflict, as text and as the multiple q / γ of what may be."""
    if worst is None or gate is None:
        return "–", math.nan
    squared = worst["squared"]
    ratio = math.inf if math.isnan(squared) else math.sqrt(max(squared, 0.0) / gate)
    return f"{number(ratio, 2)}{CLOSE}× with{CLOSE}{worst['with']}", ratio


def _number(text: str, value: float) -> Markup:
    key = "-1" if math.isnan(value) else f"{min(value, 1e15):.6f}"
    return element("td", text, class_="number", data_sort=key)
