"""The standing of a closure among those of its pair of robots: agreements and the worst conflict.

A closure is measured against the accepted ones of its pair of robots; where that pair was refused,
against the set that was found and not believed. With D the larger of q²_uv and q²_vu,

    agrees with     those with D ≤ γ²
    worst conflict  the one with the largest D; its loop split by `_loops`
    enters at       the confidence whose γ² is the largest D: F(D), F of chi-squared with d degrees
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.consistency import PairEvidence
from pcm_jax.errors import InputError
from pcm_jax.integrity._loops import Loops, Misses
from pcm_jax.integrity.rivals import AGREEING
from pcm_jax.selection import PairSelection, Selection

ROWS = 2048
"""Closures of a pair of robots that are looked at together."""

ACCEPTED = "accepted"
ISOLATED = "isolated"
RIVAL = "in the rival set"
NEAR_MISS = "near miss"
AGAINST_MOST = "against most"
AGAINST_ALL = "against all"
PASSED_OVER = "passed over"
LEFT_OUT = "left out of the merge"
BY_NUMBER = "pair refused by number"
BY_CHANCE = "pair refused by chance"
AMBIGUOUS = "pair refused as ambiguous"
BY_TEAM = "pair refused by the team"
UNKNOWN = "not weighed"

STANDINGS = {
    ACCEPTED: "believed and used",
    ISOLATED: "agrees with no other closure between these robots",
    RIVAL: "one of the set that implies another alignment of the two maps",
    NEAR_MISS: "agrees with a quarter of the accepted ones or more, not with all",
    AGAINST_MOST: "agrees with some of the accepted ones, with less than a quarter",
    AGAINST_ALL: "agrees with others, with none of the accepted ones",
    PASSED_OVER: "agrees with all accepted ones, yet the method did not take it",
    LEFT_OUT: "one of the set found, which was believed, but not used in the merge",
    BY_NUMBER: "one of the set found, which was too small",
    BY_CHANCE: "one of the set found, which cannot be told from chance",
    AMBIGUOUS: "one of the set found, beside which another alignment is supported as well",
    BY_TEAM: "one of the set found, which other pairs of robots outvote",
    UNKNOWN: "not accepted by what was given, or by a robust method; no closures were compared",
}
"""Standings of a closure, and their meaning."""


@dataclass(frozen=True)
class Conflict:
    """The loop of two closures, walked from the end of one of them: it misses where it began.

    Attributes:
        index: of the other closure, among the candidates.
        squared: the larger of its two squared distances (eq. 4); where closures leave directions
            unsaid, as likely with d degrees of freedom (`PairEvidence.comparable`).
        translation: metres by which the loop misses; NaN where it cannot be said.
        translation_sigma: standard deviation of that for two right closures.
        rotation: degrees.
        rotation_sigma: degrees.
        shares: of map a, map b (the closure's own a and b) and the two measurements in M, along
            what misses: they add up to 1.
    """

    index: int
    squared: float
    translation: float
    translation_sigma: float
    rotation: float
    rotation_sigma: float
    shares: tuple[float, float, float]

    def as_dict(self) -> dict[str, Any]:
        """The conflict as in `report.json`."""
        return {
            "with": self.index,
            "squared": self.squared,
            "translation": self.translation,
            "translation_sigma": self.translation_sigma,
            "rotation": self.rotation,
            "rotation_sigma": self.rotation_sigma,
            "shares": dict(zip(("a", "b", "closures"), self.shares, strict=True)),
        }


def facts_of(merged: Any, wanted: Int[np.ndarray, " r"]) -> Iterator[tuple[int, dict[str, Any]]]:
    """The facts on each wanted closure, pair of robots by pair of robots."""
    selection: Selection = merged.selection
    for pair in selection.pairs:
        rows = np.flatnonzero(np.isin(pair.closures, wanted))
        if not len(rows):
            continue
        known = _Known.of(pair, merged)
        for some in np.split(rows, np.arange(ROWS, len(rows), ROWS)):
            for row, facts in zip(some.tolist(), known.facts(some), strict=True):
                yield int(pair.closures[row]), facts


class _Known(NamedTuple):
    """The state of a pair of robots after a merge.

    Attributes:
        pair: as it was decided.
        accepted: bool `[k]`, in the merge.
        against: `[n]`, the closures that the others are measured by.
        refusal: the standing of a member of the set found.
        turned: bool `[k]`, closures that run from b to a as they were given.
        loops: of the pair's closures.
    """

    pair: PairSelection
    accepted: Bool[np.ndarray, " k"]
    against: Int[np.ndarray, " n"]
    refusal: str
    turned: Bool[np.ndarray, " k"]
    loops: Loops

    @classmethod
    def of(cls, pair: PairSelection, merged: Any) -> _Known:
        """Gathers the state; the loops cost nothing before they are asked for."""
        accepted = np.asarray(merged.accepted)[pair.closures]
        found = pair.accepted if pair.members is None else pair.members
        against = np.flatnonzero(accepted if accepted.any() else found)
        turned = np.asarray(merged.candidates.robot_a)[pair.closures] != pair.robot_a
        evidence = pair.evidence
        loops = Loops(evidence.covariances, evidence.measured)  # type: ignore[arg-type]
        return cls(pair, accepted, against, _refusal(pair, merged), turned, loops)

    def facts(self, rows: Int[np.ndarray, " r"]) -> Iterator[dict[str, Any]]:
        """The fields of an `Explanation` that need evidence, of some of the pair's closures."""
        squared = _larger(self.pair.evidence, self.loops, rows, self.against)
        others = rows[:, None] != self.against
        agrees = ((squared <= self.pair.gate) & others).sum(axis=1)
        of, agreeing = others.sum(axis=1), _agreeing(self.pair, rows)
        squared = np.where(others, np.where(np.isnan(squared), np.inf, squared), -1.0)
        alone = of == 0
        worst = np.zeros(len(rows), int) if alone.all() else squared.argmax(axis=1)
        largest = squared.max(axis=1, initial=-1.0)
        conflicts = self._conflicts(rows[~alone], self.against[worst[~alone]], largest[~alone])
        enters = _cdf(largest, self.pair.evidence)
        for at, row in enumerate(rows.tolist()):
            standing = self._standing(row, int(agrees[at]), int(of[at]), int(agreeing[at]))
            yield {
                "standing": standing,
                "agrees_with": int(agrees[at]),
                "of": int(of[at]),
                "among": "accepted" if self.accepted.any() else "found",
                "agreeing": int(agreeing[at]),
                "candidates": len(self.pair.closures),
                "worst_conflict": None if alone[at] else next(conflicts),
                "enters_at": None if alone[at] else float(enters[at]),
                "because": self._because(standing),
            }

    def _conflicts(
        self, rows: Int[np.ndarray, " p"], others: Int[np.ndarray, " p"], squared: np.ndarray
    ) -> Iterator[Conflict]:
        missed = _missed(self.loops, rows, others)
        degrees = np.degrees(missed.rotation), np.degrees(missed.sigma[:, 1])
        for at, (row, other) in enumerate(zip(rows.tolist(), others.tolist(), strict=True)):
            of_a, of_b, of_closures = missed.shares[at].tolist()
            shares = (of_b, of_a, of_closures) if self.turned[row] else (of_a, of_b, of_closures)
            yield Conflict(
                index=int(self.pair.closures[other]),
                squared=float(squared[at]),
                translation=float(missed.translation[at]),
                translation_sigma=float(missed.sigma[at, 0]),
                rotation=float(degrees[0][at]),
                rotation_sigma=float(degrees[1][at]),
                shares=shares,
            )

    def _standing(self, row: int, agrees: int, of: int, agreeing: int) -> str:
        found, verdict = self.pair.members, self.pair.verdict
        rival = None if verdict is None else verdict.rival
        ranked = (
            (ACCEPTED, self.accepted[row]),
            (LEFT_OUT, self.pair.accepted[row]),
            (self.refusal, found is not None and found[row]),
            (ISOLATED, agreeing == 0),
            (RIVAL, rival is not None and rival.members[row]),
            (AGAINST_ALL, agrees == 0),
            (PASSED_OVER, agrees == of),
            (NEAR_MISS, agrees >= AGREEING * of),
        )
        return next((name for name, holds in ranked if holds), AGAINST_MOST)

    def _because(self, standing: str) -> str:
        verdict = self.pair.verdict
        if standing == RIVAL:
            return str(verdict.rival.size)
        return "" if self.accepted.any() or verdict is None else verdict.why


def _refusal(pair: PairSelection, merged: Any) -> str:
    """The standing of the closures of a set that was found and refused."""
    verdict = pair.verdict
    if verdict is None or verdict.chance is None:
        return BY_NUMBER
    if verdict.ambiguous:
        return AMBIGUOUS
    tried = {robots for cycle in merged.selection.team for robots in cycle.pairs}
    return BY_TEAM if (pair.robot_a, pair.robot_b) in tried else BY_CHANCE


def _larger(
    evidence: PairEvidence,
    loops: Loops,
    rows: Int[np.ndarray, " r"],
    against: Int[np.ndarray, " n"],
) -> Float[np.ndarray, "r n"]:
    """D of some closures with others; distances that were not kept are computed anew."""
    if evidence.is_streamed:
        return loops.squared(rows, against)
    squared = evidence.comparable
    return np.maximum(squared[np.ix_(rows, against)], squared[np.ix_(against, rows)].T)


def _agreeing(pair: PairSelection, rows: Int[np.ndarray, " r"]) -> Int[np.ndarray, " r"]:
    if pair.evidence.is_streamed:
        return pair.evidence.packed(pair.gate).degree[rows]
    within = pair.evidence.comparable <= pair.gate
    return (within[rows] & within[:, rows].T).sum(axis=1) - within[rows, rows]


def _missed(loops: Loops, rows: np.ndarray, others: np.ndarray) -> Misses:
    """The loops; by a map whose own covariance cannot be found, NaN."""
    try:
        return loops.misses(rows, others)
    except InputError:
        unknown = np.full(len(rows), np.nan)
        return Misses(
            unknown, unknown, unknown, np.stack([unknown] * 2, 1), np.stack([unknown] * 3, 1)
        )


def _cdf(squared: Float[np.ndarray, " r"], evidence: PairEvidence) -> Sequence[float]:
    from scipy.special import gammainc

    d = lie.tangent_dim(evidence.measured.measurement)  # type: ignore[union-attr]
    return gammainc(0.5 * d, 0.5 * np.maximum(squared, 0.0))
