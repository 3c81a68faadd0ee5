"""The words of explanations."""

from __future__ import annotations

import math
from typing import Any

USABLE = 1.0 - 1e-9
"""Confidence above which a gate lets nearly everything in."""


def sentence(told: Any) -> str:
    """An `Explanation` in one sentence."""
    head = f"Closure {told.index} ({told.a} to {told.b})"
    if told.of is None:
        return f"{head} {told.because}{_afterwards(told)}."
    return f"{head} {_accepted(told) if told.accepted else _rejected(told)}."


def agreement(told: Any) -> str:
    """The numbers of those that a closure agrees with, short."""
    if told.of is None:
        return "not weighed against others"
    enters = "" if told.enters_at is None else f"; enters at {told.enters_at:.6g}"
    return (
        f"with {told.agrees_with} of {told.of} {told.among}, {told.agreeing} of all"
        f" {told.candidates}{enters}"
    )


def conflict(told: Any) -> str:
    """The worst conflict, short."""
    worst = told.worst_conflict
    return "none known" if worst is None else f"closure {worst.index}: {miss(worst)}"


def miss(worst: Any) -> str:
    """The miss of a loop with its sigmas: "12.3 m (sigma 0.8 m) and 40° (sigma 2°)"."""
    if math.isnan(worst.translation):
        return "more than can be said"
    return (
        f"{number(worst.translation)} m (sigma {number(worst.translation_sigma, 2)} m) and "
        f"{number(worst.rotation)}° (sigma {number(worst.rotation_sigma, 2)}°)"
    )


def number(value: float, digits: int = 3) -> str:
    """A number of few digits, without an exponent where that can be read."""
    if not math.isfinite(value):
        return "unknown"
    whole = abs(value) >= 10 ** (digits - 1)
    return f"{value:.0f}" if whole else f"{value:.{digits}g}"


def unweighed(merged: Any, index: int, accepted: bool, fit: Any) -> str:
    """The reason where no closures were compared."""
    if merged.robust is not None:
        share = f"{number(100.0 * float(merged.robust.scale[index]) ** 2, 2)} % of its information"
        if fit is None:
            share += f" (chi-squared {number(float(merged.robust.squared[index]))} in its solve)"
        if accepted:
            return f"was kept by {merged.method} with {share}"
        if merged.robust.accepted[index]:
            return (
                f"was rejected: {merged.method} kept it with {share}, but too few others between"
                " these robots"
            )
        return f"was rejected: {merged.method} turned it down to {share}"
    if accepted:
        why = "every closure was" if merged.method == "all" else "it was given as accepted"
        return f"was accepted because {why}; it was not weighed against others"
    return "was left out because it is not among those given; it was not weighed against others"


def _accepted(told: Any) -> str:
    worst, agrees, of = told.worst_conflict, told.agrees_with, told.of
    if worst is None:
        return f"was accepted as the only one between {_between(told)}{_afterwards(told)}"
    those = {1: "the other accepted one", 2: "both other accepted ones"}
    if agrees == of:
        text = f"was accepted: it agrees with {those.get(of, f'all {of} other accepted ones')}"
    else:
        text = f"was accepted, though it agrees with {agrees} of the {of} other accepted ones"
    text += f"; worst with closure {worst.index}: the loop of the two misses by {miss(worst)}"
    return text + _afterwards(told)


def _afterwards(told: Any) -> str:
    if told.fit is None:
        return ""
    return (
        f"; in the merged map its chi-squared is {number(told.fit.chi2)} ({told.fit.dof} expected)"
    )


def _between(told: Any) -> str:
    return " and ".join(told.robots)


def _rejected(told: Any) -> str:
    if told.standing.startswith("pair refused"):
        return (
            f"was rejected with all that were found between {_between(told)}, "
            f"which were refused: {told.because}"
        )
    if told.standing == "left out of the merge":
        return "was selected, but left out when the maps were merged" + _worst(told)
    if told.of == 0:
        return f"was rejected: {told.because or 'nothing was found that agrees'}"
    set_of = {"accepted": "accepted ones", "found": "found to agree"}[told.among]
    if told.of > 1:
        agrees = f"agrees with {told.agrees_with} of the {told.of} {set_of}"
    else:
        only = {"accepted": "accepted one", "found": "one found"}[told.among]
        agrees = f"{'agrees' if told.agrees_with else 'does not agree'} with the only {only}"
    apart = "" if told.among == "accepted" else f"; nothing between {_between(told)} is believed"
    return f"was rejected: it {agrees}{_worst(told)}{_tail(told)}{apart}"


def _is_rival(told: Any) -> bool:
    return told.standing == "in the rival set"


def _worst(told: Any) -> str:
    worst = told.worst_conflict
    return (
        ""
        if worst is None
        else f"; worst with closure {worst.index}: the loop of the two misses by {miss(worst)}"
    )


def _tail(told: Any) -> str:
    if _is_rival(told):
        return f"; it is one of {told.because} that agree on another alignment"
    if told.standing == "isolated":
        return "; it agrees with no other closure at all"
    if told.standing == "near miss" and told.enters_at is not None:
        if told.enters_at > USABLE:
            return "; no usable confidence would let it in"
        return f"; a confidence of {confidence(told.enters_at)} would let it in"
    if told.standing == "passed over":
        return "; yet the method did not take it"
    return ""


def confidence(value: float) -> str:
    """A confidence with as many nines as it needs, rounded up."""
    digits = max(2, 1 - math.floor(math.log10(1.0 - value)))
    return f"{math.ceil(value * 10**digits) / 10**digits:.{digits}f}".rstrip("0")
