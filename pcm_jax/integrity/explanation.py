"""Explanations: why each closure was accepted or rejected, in numbers and in a sentence.

Nothing is computed for it that a merge does not have, but the loops of the worst conflicts (and the
distances to the accepted ones where they were streamed), see `_standing`. What a merge does not
know, as where the closures were given or a robust method weighed them one by one, is said to be
unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int

from pcm_jax.arrays import on_host
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures, MultiRobotGraph
from pcm_jax.integrity import _sentences as sentences
from pcm_jax.integrity._standing import ACCEPTED, UNKNOWN, Conflict, facts_of
from pcm_jax.integrity.residuals import Fit, fits


@dataclass(frozen=True, repr=False)
class Explanation:
    """The reasons for what was made of one closure.

    Attributes:
        index: among the candidates.
        a: the name of the pose it starts at.
        b: of the pose it ends at.
        robots: names of the two robots.
        accepted: whether it was.
        standing: in a word or two, see `STANDINGS`.
        agrees_with: how many of the accepted closures between these robots it agrees with. None
            where nothing was weighed, so the next five.
        of: how many there are of these, itself not counted.
        among: "accepted"; or "found": where none was accepted, those of the set that was refused.
        agreeing: how many of all candidates between these robots it agrees with.
        candidates: how many these are.
        worst_conflict: with which of the accepted it agrees least, though it may; None alone.
        enters_at: the smallest confidence at which all accepted ones agree with it; None alone.
        fit: in the merged map; None where the two robots are not in one.
        because: what is known besides, for the sentence.
    """

    index: int
    a: str
    b: str
    robots: tuple[str, str]
    accepted: bool
    standing: str
    agrees_with: int | None = None
    of: int | None = None
    among: str = "accepted"
    agreeing: int | None = None
    candidates: int | None = None
    worst_conflict: Conflict | None = None
    enters_at: float | None = None
    fit: Fit | None = None
    because: str = ""

    @property
    def sentence(self) -> str:
        """The explanation in plain words."""
        return sentences.sentence(self)

    def as_dict(self) -> dict[str, Any]:
        """The explanation as in `report.json`, what the report has of every closure left out."""
        fit = self.fit
        return {
            "why": self.sentence,
            "standing": self.standing,
            "agrees_with": self.agrees_with,
            "of": self.of,
            "among": self.among,
            "agreeing": self.agreeing,
            "worst_conflict": self.worst_conflict and self.worst_conflict.as_dict(),
            "enters_at": self.enters_at,
            "fit": fit and {"chi2": fit.chi2, "p": fit.p, "dof": fit.dof, "residual": fit.by_axis},
        }

    def __repr__(self) -> str:
        return (
            f"Explanation(closure {self.index}, {self.a} to {self.b}: {self.standing})\n"
            f"  agrees    {sentences.agreement(self)}\n"
            f"  conflict  {sentences.conflict(self)}"
        )


@on_host
def explain(merged: Any, rows: Any = None) -> list[Explanation]:
    """Explains what a merge made of its candidate closures.

        result = pcm_jax.merge(graph)
        for told in pcm_jax.integrity.explain(result):
            print(told.sentence)

    Args:
        merged: a `MergeResult`.
        rows: indices of candidates; None: all.

    Returns:
        One a row, in their order.

    Raises:
        InputError: for an index out of range.
    """
    wanted = _checked(rows, len(merged.candidates))
    closures: LoopClosures = merged.candidates
    facts = dict(facts_of(merged, wanted)) if merged.selection is not None else {}
    fitted = fits(merged.graph.maps, merged.groups, closures[wanted])
    return [
        _explanation(merged, index, facts.get(index), fit)
        for index, fit in zip(wanted.tolist(), fitted, strict=True)
    ]


def _checked(rows: Any, count: int) -> Int[np.ndarray, " r"]:
    if rows is None:
        return np.arange(count)
    wanted = np.atleast_1d(np.asarray(rows))
    if wanted.size == 0:
        return np.zeros(0, np.int64)
    if wanted.dtype.kind not in "iu" or wanted.ndim != 1:
        raise InputError(f"index: {rows!r}, expected an integer 0 … {count - 1}")
    outside = wanted[(wanted < 0) | (wanted >= count)]
    if outside.size:
        raise InputError(f"index: {outside[0]}, expected 0 … {count - 1}")
    return wanted.astype(np.int64)


def _explanation(
    merged: Any, index: int, facts: dict[str, Any] | None, fit: Fit | None
) -> Explanation:
    graph: MultiRobotGraph = merged.graph
    ends: LoopClosures = merged.candidates
    a, b = graph.maps[int(ends.robot_a[index])], graph.maps[int(ends.robot_b[index])]
    accepted = bool(merged.accepted[index])
    if facts is None:
        because = sentences.unweighed(merged, index, accepted, fit)
        facts = {"standing": ACCEPTED if accepted else UNKNOWN, "because": because}
    return Explanation(
        index=index,
        a=a.pose_name(int(ends.pose_a[index])),
        b=b.pose_name(int(ends.pose_b[index])),
        robots=(a.name, b.name),
        accepted=accepted,
        fit=fit,
        **facts,
    )
