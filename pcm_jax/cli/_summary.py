"""The text that `pcm-jax merge` prints: its report, read for what a person wants to know first."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pcm_jax.cli._advice import advice
from pcm_jax.tables import columns_of_text

NOTHING = "Nothing to merge: no closure between robots is believed; the table says why."
SHOWN = 5
"""Rejected closures that are shown."""
USABLE = 1.0 - 1e-9
"""Confidence above which a gate lets nearly everything in."""


def summary(report: dict[str, Any]) -> str:
    """A report as the text that `pcm-jax merge` prints."""
    told = [*report.get("warnings", []), *report.get("hints", [])]
    fit = "\n".join([*_refined(report.get("refine")), _fit(report["solution"]), *told])
    parts = [_robots(report), _pairs(report["robot_pairs"]), fit]
    if report.get("input", {}).get("cuts"):
        parts.insert(0, "\n".join(report["input"]["cuts"]))
    if report.get("calibration"):
        parts.append(report["calibration"]["advice"])
    if "cleaned" in report:
        parts.insert(0, _maps(report["cleaned"]))
    if not any(pair["accepted"] for pair in report["robot_pairs"]):
        parts.insert(0, NOTHING)
    more = _evidence(report), _surprises(report["closures"]), advice(report)
    return "\n\n".join([*parts, *(part for part in more if part)])


def _maps(cleaned: list[dict[str, Any]]) -> str:
    rows = [[row["robot"], row["measured"], row["accepted"], _optimal(row)] for row in cleaned]
    table = columns_of_text(["inside robot", "measured", "accepted", "largest set"], rows)
    return "\n".join([table, *(f"{row['robot']}: {row['why']}" for row in cleaned if _odd(row))])


def _odd(row: dict[str, Any]) -> bool:
    """True for a map that was not judged as its file says, or accepts nothing of what it has."""
    return row["odometry_scale"] != 1.0 or (row["measured"] > 0 and row["accepted"] == 0)


def _robots(report: dict[str, Any]) -> str:
    group_of = {name: number for number, names in enumerate(report["groups"], 1) for name in names}
    rows = [
        [robot["name"], robot["poses"], robot["edges"], group_of[robot["name"]], _pose(anchor)]
        for robot, anchor in zip(report["robots"], report["anchors"], strict=True)
    ]
    return columns_of_text(["robot", "poses", "edges", "group", "anchor (m, rad)"], rows)


def _pose(anchor: dict[str, float] | None) -> str:
    if anchor is None:
        return "none: no accepted closure leads to this robot"
    return "  ".join(f"{name} {value:.4g}" for name, value in anchor.items())


def _pairs(pairs: list[dict[str, Any]]) -> str:
    rows = [
        [f"{p['a']} - {p['b']}", p["measured"], p["accepted"], _optimal(p), p["why"] or ""]
        for p in pairs
    ]
    return columns_of_text(["robots", "measured", "accepted", "largest set", "why"], rows)


def _optimal(pair: dict[str, Any]) -> str:
    if pair["optimal"] is None:
        return "not looked for"
    most = f"weight {pair['weight_bound']:.6g}" if "weight" in pair else pair["upper_bound"]
    return "proven" if pair["optimal"] else f"not proven, at most {most}"


def _refined(refined: dict[str, Any] | None) -> Iterator[str]:
    """Lines on what refining changed."""
    if refined is None:
        return
    back, lost = len(refined["recalled"]), len(refined["dropped"])
    yield f"recalled {back} more that agree with the merged map" + (
        "" if refined["settled"] else f" (not settled after {refined['rounds']} rounds)"
    )
    if lost or refined["loops_dropped"]:
        loops = len(refined["loops_dropped"])
        yield f"dropped {lost} closures, and {loops} loops inside the maps, that do not"


def _fit(solution: dict[str, Any]) -> str:
    chi2 = solution["normalized_chi2"]
    normalized = "no degree of freedom left" if chi2 is None else f"normalised chi2 {chi2:.4g}"
    end = "converged" if solution["converged"] else "NOT CONVERGED"
    fit = f"cost {solution['cost']:.6g} ({normalized}), {end} after {solution['iterations']} steps"
    return fit


def _evidence(report: dict[str, Any]) -> str:
    """The groups, and how far each pair's answer is to be believed."""
    groups = " | ".join(" + ".join(names) for names in report["groups"])
    pairs = [pair for pair in report["robot_pairs"] if pair["found"] is not None]
    rows = [
        [
            f"{pair['a']} - {pair['b']}",
            pair["found"],
            pair["places"],
            _probability(pair["chance"]),
            _rival(pair["rival"]),
            _probability(pair["joint"] and pair["joint"]["p"]),
        ]
        for pair in pairs
    ]
    head = ["robots", "found", "places", "chance", "rival", "joint"]
    table = [columns_of_text(head, rows)] if rows else []
    return "\n".join([*table, f"groups: {groups}"])


def _probability(p: float | None) -> str:
    return "–" if p is None else f"p = {p:.2g}"


def _rival(rival: dict[str, Any] | None) -> str:
    return "none" if rival is None else f"{rival['size']} at {rival['places']} places"


def _surprises(closures: list[dict[str, Any]]) -> str:
    """The rejected closures that came nearest to being accepted.

    Those that agree with the largest part of the accepted ones between their robots, and of equal
    ones those with the least conflict; none that agree with no accepted one and that no usable
    confidence would let in. Where nothing was accepted between two robots, the pair is to be
    explained and not its closures.
    """
    rejected = [row for row in closures if not row["accepted"] and row["among"] == "accepted"]
    near = [row for row in rejected if row["of"] and _is_near(row)]
    ranked = sorted(near, key=lambda row: (-row["agrees_with"] / row["of"], row["enters_at"]))
    rows = [
        [
            row["index"],
            f"{row['a']} to {row['b']}",
            f"{row['agrees_with']} of {row['of']}",
            *_conflict(row["worst_conflict"]),
            _enters(row["enters_at"]),
        ]
        for row in ranked[:SHOWN]
    ]
    head = ["nearly accepted", "ends", "agrees with", "but with", "it misses by", "enters at"]
    return columns_of_text(head, rows) if rows else ""


def _is_near(row: dict[str, Any]) -> bool:
    return bool(row["agrees_with"]) or (row["enters_at"] or 1.0) <= USABLE


def _conflict(worst: dict[str, Any]) -> Iterator[str]:
    yield str(worst["with"])
    size = f"{worst['translation']:.3g} m, {worst['rotation']:.3g}°"
    yield f"{size} (sigma {worst['translation_sigma']:.2g} m, {worst['rotation_sigma']:.2g}°)"


def _enters(confidence: float | None) -> str:
    return "never" if confidence is None or confidence > USABLE else f"{confidence:.6g}"
