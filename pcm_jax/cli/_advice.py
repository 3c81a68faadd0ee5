"""The one thing to do next, where something about a merge is odd.

Causes come before their effects: a wrong reading of the file makes everything else odd as well.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

UNLIKELY = 1e-3
"""Probability below which the closures of a pair are not right together as they state it."""
OPTION = re.compile(r"\((--[a-z-]+[^)]*)\)")


def advice(report: dict[str, Any]) -> str | None:
    """The thing to do next, as a line; None where nothing is odd.

    Args:
        report: of a merge.
    """
    first = next(_advised(report), None)
    return None if first is None else f"next: {first}"


def _advised(report: dict[str, Any]) -> Iterator[str]:
    for hint in report.get("hints", []):
        option = OPTION.search(hint)
        yield f"try {option[1]}" if option else hint
    pairs = report["robot_pairs"]
    if not report["solution"]["converged"]:
        yield "leave out what contradicts the maps (--clean-maps, or a lower --confidence)"
    yield from _of_pairs(report, [pair for pair in pairs if pair["found"] is not None])
    if any(pair["optimal"] is False for pair in pairs):
        yield "give the search for the largest set more time (--time-limit)"
    if any(cycle["p"] is not None and cycle["p"] < UNLIKELY for cycle in report["team"]):
        yield "look at the pairs of robots in the cycle that does not fit (--plot shows their maps)"


def _of_pairs(report: dict[str, Any], pairs: list[dict[str, Any]]) -> Iterator[str]:
    apart = {name: number for number, names in enumerate(report["groups"]) for name in names}
    for pair in pairs:
        names = f"{pair['a']} and {pair['b']}"
        if pair["ambiguous"]:
            yield (
                f"find closures between {names} that only one of the two alignments explains, or"
                " take the larger set (--on-ambiguous largest)"
            )
        if pair["accepted"] or apart[pair["a"]] == apart[pair["b"]]:
            continue
        if pair["found"] < 2 and pair["measured"] > 1:
            yield (
                f"check how the closures between {names} are written (pcm-jax inspect): no two of"
                f" {pair['measured']} agree"
            )
        elif pair["chance"] is not None:
            yield f"find closures between {names} at other places: those that agree are too few"
        else:
            yield (
                f"if {pair['found']} closures are enough to join {names}, say so"
                f" (--minimum-inliers {pair['found']})"
            )
    for pair in pairs:
        joint = pair["joint"]
        if joint is not None and joint["p"] is not None and joint["p"] < UNLIKELY:
            yield (
                f"weigh the stated covariances (pcm-jax calibrate): between {pair['a']} and"
                f" {pair['b']} the accepted closures are not right together as they state it"
            )
