"""The page's sentences: the answer, and why each closure was accepted or not."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from pcm_jax.report._facts import ACCEPTED, REFUSED, RIVAL, UNKNOWN, Facts

SAID = 2
"""Refused pairs of robots whose reasons the answer gives itself."""
USABLE = 1.0 - 1e-6
"""Confidence above which a gate lets nearly everything in."""
CLOSE = "\N{NO-BREAK SPACE}"
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
FOUND = "closure found to agree", "closures found to agree"


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


def closure_sentence(row: dict[str, Any], facts: Facts, pair: dict[str, Any] | None) -> str:
    """Says in a sentence or two why a closure was accepted or not.

    Args:
        row: of the report; its own `why` is taken where it has one.
        facts: on all closures.
        pair: the report's row on its two robots.
    """
    if row.get("why"):
        return row["why"]
    index = row["index"]
    fate, others = facts.fate[index], int(facts.others[index])
    off = off_by(facts, index)
    if fate == ACCEPTED:
        if others == UNKNOWN:
            return f"Accepted{off and f': in the merged maps it is off by {off}'}."
        together = f"it agrees with all {others} others" if others else "it stands alone"
        return f"Accepted: {together}{off and f', and in the merged maps it is off by {off}'}."
    if fate == REFUSED:
        return f"Refused with the {others + 1} closures found that agree: {_reason(pair)}."
    start = "In the rival set: it and others agree on another alignment. " if fate == RIVAL else ""
    return start + _rejection(index, facts, pair, off)


def _reason(pair: dict[str, Any] | None) -> str:
    return (pair or {}).get("why") or "none was accepted"


def _rejection(index: int, facts: Facts, pair: dict[str, Any] | None, off: str) -> str:
    others = int(facts.others[index])
    if others == UNKNOWN:
        return f"Rejected{off and f': in the merged maps it is off by {off}'}."
    if others == 0:
        return f"Rejected, as all closures of its two robots: {_reason(pair)}."
    agreeing, ratio = int(facts.agreeing[index]), float(facts.ratio[index])
    kind = ("accepted closure",) if pair and pair["accepted"] else FOUND
    told = f"Rejected: it agrees with {agreeing or 'none'} of {counted(others, *kind)}"
    if not math.isnan(ratio) and agreeing < others:
        told += (
            f". It contradicts closure {facts.worst[index]} most: the two are {number(ratio, 2)}"
            " times further apart than their uncertainty allows"
        )
    return f"{told}.{off and f' If these are right, it is off by {off}.'}"


def more(row: dict[str, Any]) -> list[list[str]]:
    """What a report's row has besides of a closure, as terms and texts; nothing of an old report.

    Args:
        row: of `MergeResult.report()["closures"]`, where its loops were explained.
    """
    told, worst, fit = [], row.get("worst_conflict"), row.get("fit")
    if row.get("standing"):
        told.append(["Standing", row["standing"]])
    if worst:
        miss = f"{number(worst['translation'], 2)} m, {number(worst['rotation'], 2)}°"
        if "translation_sigma" in worst:
            sigmas = (
                f"{number(worst['translation_sigma'], 2)} m, {number(worst['rotation_sigma'], 2)}°"
            )
            miss += f" (standard deviations {sigmas})"
        told.append([f"Loop with {worst['with']}", f"misses by {miss}"])
        if worst.get("shares"):
            shares = ", ".join(f"{k} {100.0 * v:.0f} %" for k, v in worst["shares"].items())
            told.append(["Uncertainty from", shares])
    if row.get("enters_at") is not None:
        told.append(["Enters at", _confidence(row["enters_at"])])
    if fit:
        told.append(["In the merged map", f"χ² {number(fit['chi2'])}, p = {number(fit['p'], 2)}"])
    return told


def _confidence(value: float) -> str:
    return "no usable confidence" if value > USABLE else f"confidence {number(value, 6)}"


def off_by(facts: Facts, index: int) -> str:
    """The miss of a closure in the merged maps; nothing where they are not in one frame."""
    away, turned = float(facts.away[index]), float(facts.turned[index])
    return "" if math.isnan(away) else f"{number(away, 2)}{CLOSE}m, {number(turned, 2)}°"
