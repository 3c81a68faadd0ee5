"""Answers that do not flicker, and a log of what entered and left them.

With a hysteresis h the set believed so far, and whatever has come since and agrees with all of it,
stays in the place of the method's choice as long as its members agree with each other and the
choice has at most h members more (where weights decide: weighs at most h more). So a set gives way
only to one that is clearly better, or when it is no set any more. Nothing proves it the largest.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float

from pcm_jax.selection import Choice

MOST_LOGGED = 10_000
"""Entries of a log: of more, the latest ones are kept."""


@dataclasses.dataclass(frozen=True)
class Change:
    """A closure that entered an answer or left it.

    Attributes:
        step: how many changes of maps and closures had been taken when the answer was given, of
            what there was at first none.
        closure: its index at that time.
        a, b: the poses that it joins.
        event: "entered" or "left".
        why: the reason, in words.
    """

    step: int
    closure: int
    a: str
    b: str
    event: str
    why: str

    def __str__(self) -> str:
        return f"step {self.step}: {self.a} – {self.b} {self.event}: {self.why}"


def steadied(
    choice: Choice,
    agree: Bool[np.ndarray, "k k"],
    before: Bool[np.ndarray, " k"],
    hysteresis: float,
    weight: Float[np.ndarray, " k"],
) -> Choice:
    """The choice, or the set believed before, extended, where that is nearly as good.

    Args:
        choice: of the method.
        agree: who agrees with whom, symmetric.
        before: marks the members of the set believed before that are still there.
        hysteresis: h.
        weight: of the closures, where weights decide; else ones.
    """
    rows = np.flatnonzero(before)
    inside = agree[np.ix_(rows, rows)] | np.eye(len(rows), dtype=bool)
    if not len(rows) or not inside.all():
        return choice
    kept, common = before.copy(), agree[rows].all(axis=0) & (weight > 0.0)
    for row in np.flatnonzero(common & ~before):
        if common[row]:
            kept[row] = True
            common = common & agree[row]
    if weight[choice.members].sum() > weight[kept].sum() + hysteresis:
        return choice
    same = np.array_equal(kept, choice.members)
    optimal = choice.optimal if same or choice.optimal is None else False
    total = None if choice.weight is None else float(weight[kept].sum())
    return dataclasses.replace(choice, members=kept, optimal=optimal, weight=total)


def changes(
    before: Bool[np.ndarray, " k"],
    accepted: Bool[np.ndarray, " k"],
    agree: Bool[np.ndarray, "k k"],
    why: str,
    dropped: Bool[np.ndarray, " k"] | None = None,
) -> Iterator[tuple[int, str, str]]:
    """Row, event and reason of each closure that entered an answer or left it.

    Args:
        before: marks those believed before.
        accepted: marks those believed now.
        agree: who agrees with whom, symmetric.
        why: the verdict on all of them.
        dropped: marks those that the map of the others contradicts.
    """
    for row in np.flatnonzero(before != accepted).tolist():
        if accepted[row]:
            others = accepted & (np.arange(len(accepted)) != row)
            with_it = int((agree[row] & others).sum())
            yield row, "entered", f"agrees with {with_it} of the {int(others.sum())} others"
        elif dropped is not None and dropped[row]:
            yield row, "left", f"the map of the {int(accepted.sum())} believed now contradicts it"
        else:
            yield row, "left", _why_it_left(agree[row], accepted, why)


def _why_it_left(agrees: Bool[np.ndarray, " k"], accepted: Bool[np.ndarray, " k"], why: str) -> str:
    count = int(accepted.sum())
    if not count:
        return f"none is believed any more: {why}"
    against = count - int((agrees & accepted).sum())
    if against:
        return f"disagrees with {against} of the {count} believed now"
    return f"agrees with the {count} believed now, but is not of the set chosen"
