"""The page's words: the answer in sentences, numbers, and what is told of a closure."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from pcm_jax.integrity import STANDINGS
from pcm_jax.report._facts import Facts

SAID = 2
"""Refused pairs of robots whose reasons the answer gives itself."""
USABLE = 1.0 - 1e-6
"""Confidence above which a gate lets nearly everything in."""
CLOSE = "\N{NO-BREAK SPACE}"
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 3) -> str:
    """A number for people: three significant digits, no exponent where it can be helped."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value == 0 or 1e-4 <= abs(value) < 1e6:
        text = f"{value:.{digits}g}"
        text = f"{float(text):,.0f}" if "e" in text else text
    else:
        mantissa, _, power = f"{value:.{digits - 1}e}".partition("e")
        text = f"{mantissa} × 10{str(int(power)).translate(RAISED)}"
    return text.replace("-", "−")


def counted(count: int, one: str, several: str | None = None) -> str:
    """A number with its noun: "1 closure", "3 closures"."""
    return f"{count:,} {one if count == 1 else several or one + 's'}"


def listed(names: list[str]) -> str:
    """Names as a list in a sentence: "a, b and c"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def headline(report: dict[str, Any]) -> str:
    """Says whether the maps were merged, in a few words."""
    groups = [group for group in report["groups"] if len(group) > 1]
    total = len(report["robots"])
    if not groups:
        return f"The maps of {listed(_names(report))} were not merged"
    if len(groups) == 1 and len(groups[0]) == total:
        return f"The maps of {listed(_names(report))} were merged into one"
    return (
        f"{len(groups[0])} of {total} maps were merged"
        if len(groups) == 1
        else (f"{total} maps were merged into {len(report['groups'])}")
    )


def _names(report: dict[str, Any]) -> list[str]:
    names = [robot["name"] for robot in report["robots"]]
    return names if len(names) <= 4 else [*names[:3], f"{len(names) - 3} others"]


def answer(report: dict[str, Any]) -> Iterator[str]:
    """Says what was accepted, what was not, and which maps stand alone."""
    total = len(report["closures"])
    kept = sum(row["accepted"] for row in report["closures"])
    if not kept:
        yield (
            f"None of the {counted(total, 'measured closure')} between them is accepted, so every"
            " map stays as it was, in a frame of its own."
        )
    else:
        rest = f"; the other {total - kept} were rejected" if kept < total else ""
        yield f"{kept} of {counted(total, 'measured closure')} were accepted{rest}."
    apart = [group for group in report["groups"] if len(group) == 1]
    if kept and apart:
        names = [group[0] for group in apart]
        yield f"No accepted closure leads to {listed(names)}: {_it(names)} a frame of its own."
    refused = [
        pair
        for pair in report["robot_pairs"]
        if not pair["accepted"] and pair.get("why") and not pair["ambiguous"]
    ]
    if len(refused) > SAID:
        yield f"Why not, of {len(refused)} pairs of robots, stands below, robot by robot."
    else:
        for pair in refused:
            yield f"{pair['a']} and {pair['b']}: {pair['why']}."


def _it(names: list[str]) -> str:
    return "it has" if len(names) == 1 else "each has"


def more(row: dict[str, Any]) -> list[list[str]]:
    """The rest of what a report explains of a closure, as terms and texts.

    Args:
        row: of `MergeResult.report()["closures"]`.
    """
    standing, worst, fit = row["standing"], row["worst_conflict"], row["fit"]
    told = [["Standing", f"{standing}: {STANDINGS[standing]}"]]
    if worst:
        sizes = (worst["translation"], worst["rotation"])
        sigmas = (worst["translation_sigma"], worst["rotation_sigma"])
        miss = f"misses by {_pose(*sizes)} (standard deviations {_pose(*sigmas)})"
        shares = ", ".join(f"{name} {100.0 * x:.0f} %" for name, x in worst["shares"].items())
        told += [[f"Loop with {worst['with']}", miss], ["Uncertainty from", shares]]
    if row["enters_at"] is not None:
        told.append(["Let in by a gate of", _confidence(row["enters_at"])])
    if fit:
        expected = f"{len(fit['residual'])} expected of a right one"
        told.append(["In the merged map", f"χ² {number(fit['chi2'])}, {expected}"])
    return told


def _pose(metres: float, degrees: float) -> str:
    return f"{number(metres, 2)}{CLOSE}m, {number(degrees, 2)}°"


def _confidence(value: float) -> str:
    return (
        "no use: it would let in nearly anything"
        if value > USABLE
        else f"confidence {number(value, 6)}"
    )


def off_by(facts: Facts, index: int) -> str:
    """The miss of a closure in the merged maps; nothing where they are not in one frame."""
    away, turned = float(facts.away[index]), float(facts.turned[index])
    return "" if math.isnan(away) else _pose(away, turned)
