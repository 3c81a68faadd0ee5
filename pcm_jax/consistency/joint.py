"""Joint consistency: whether all closures of a set can be right together, and where they put a map.

A clique says that every two of its closures agree. That all agree is more: errors that each pair
has room for may add up. `joint_consistency` is the chi-squared of k closures about one alignment,
`stacked` has the equations; for two closures it is the squared distance of eq. 4.
`alignment_difference` asks the same of two sets: the rise of chi-squared when they must share one
alignment instead of having one each. J. Neira and J. D. Tardós, "Data association in stochastic
mapping using the joint compatibility test", IEEE Trans. Robotics and Automation 17 (2001).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.arrays import as_array, on_host
from pcm_jax.consistency.evidence import PairEvidence
from pcm_jax.consistency.stacked import StackedClosures, drops, fitted, stack_closures
from pcm_jax.errors import InputError, check_class

UNKNOWN = 1e6
"""Variance of what no closure says anything of, m² or rad²: as good as none is known."""
LIMIT = 400
"""Closures that a test takes; of more, this many, evenly spaced: (400·6)² numbers are 46 MB."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class JointConsistency:
    """The joint test of k closures between two robots.

    Attributes:
        chi2: χ² of the k closures about their common alignment, paper's eq. 4 for k = 2.
        dof: degrees of freedom, (k − 1) d; fewer where closures leave directions unsaid.
        p: probability that k right closures have a χ² at least as large; 1 for a single one.
        alignment: Lie, NumPy: the pose of map b's own frame in map a's, T_ab.
        covariance: `[d, d]` of δ in `T_ab exp(δ)`, each map held at its first pose; m², m rad,
            rad². What no closure says anything of has a variance of 1e6.
        closures: int64 `[k]`, those that were tested, as indices among the pair's closures.
        contributions: `[k]`, by how much χ² falls if this closure alone is left out.
        asked: how many closures the test was asked for: more than k where the set was thinned.
    """

    chi2: float
    dof: int
    p: float
    alignment: Any
    covariance: Float[np.ndarray, "d d"]
    closures: Int[np.ndarray, " k"]
    contributions: Float[np.ndarray, " k"]
    asked: int

    def __repr__(self) -> str:
        tested = f"{len(self.closures)} closures"
        if self.asked > len(self.closures):
            tested += f", thinned from {self.asked}"
        worst = int(np.argmax(self.contributions))
        return (
            f"JointConsistency({tested})\n"
            f"  chi2   {self.chi2:.4g} with {self.dof} degrees of freedom, p = {self.p:.3g}\n"
            f"  worst  closure {self.closures[worst]}, {self.contributions[worst]:.4g} of it"
        )


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AlignmentDifference:
    """The test of whether two sets of closures imply one alignment.

    Attributes:
        chi2: by how much χ² of all closures rises when both sets must share one alignment.
        dof: degrees of freedom, d.
        p: probability that two right sets differ by at least as much.
        difference: `[d]`, Log(W₂ W₁⁻¹): where the second set puts map b, seen from where the first
            does, in map a's frame moved to its middle; metres and radians.
        closures: int64 `[k]`, those of both sets that were tested, the first set's before.
        asked: how many there were; more than k where the sets were thinned.
    """

    chi2: float
    dof: int
    p: float
    difference: Float[np.ndarray, " d"]
    closures: Int[np.ndarray, " k"]
    asked: int

    def __repr__(self) -> str:
        d, space = len(self.difference), 2 if len(self.difference) == 3 else 3
        away = np.linalg.norm(self.difference[:space])
        turned = np.degrees(np.linalg.norm(self.difference[space:d]))
        return (
            f"AlignmentDifference({away:.3g} m, {turned:.3g}°)\n"
            f"  chi2    {self.chi2:.4g} with {self.dof} degrees of freedom, p = {self.p:.3g}\n"
            f"  tested  {len(self.closures)} of {self.asked} closures"
        )


@on_host
def joint_consistency(evidence: PairEvidence, accepted: Any = None) -> JointConsistency:
    """Tests whether all closures of a set can be right together.

        selection = pcm_jax.select(graph)
        for pair in selection.pairs:
            if pair.accepted.any():
                print(pcm_jax.joint_consistency(pair.evidence, pair.accepted))

    Above 400 closures a test takes 400 of them, evenly spaced in the order given
    (`JointConsistency.asked` says from how many).

    Args:
        evidence: of one pair of robots, by `weigh`; its metric plays no part.
        accepted: bool `[k]` or indices among the pair's closures; None: all of them.

    Returns:
        χ², its p-value, the alignment of the maps with its covariance, and each closure's share.

    Raises:
        InputError: for no closures, a mask of another length, an index out of range, evidence of
            distances alone.
    """
    rows = chosen_rows(evidence, accepted, "accepted")
    tested = thinned(rows, LIMIT)
    stacked = stack_closures(evidence, tested)
    fit = stacked.fit()
    projection = fit.projection()
    pull = np.einsum("adbe,be->ad", projection, fit.error.reshape(-1, stacked.dim))
    alignment, covariance = _in_own_frames(evidence, stacked, fit.alignment)
    return JointConsistency(
        chi2=fit.squared,
        dof=fit.freedom,
        p=survival(fit.squared, fit.freedom),
        alignment=alignment,
        covariance=covariance,
        closures=tested,
        contributions=drops(projection, pull, stacked.free is not None),
        asked=len(rows),
    )


@on_host
def alignment_difference(evidence: PairEvidence, first: Any, second: Any) -> AlignmentDifference:
    """Tests whether two sets of closures imply the same alignment of two maps.

        rival = pcm_jax.alignment_difference(pair.evidence, pair.accepted, others)
        rival.p < 0.01                          # another alignment

    Each set gets the alignment that fits it best, given what both share of the maps' errors; their
    difference has d degrees of freedom. It is measured about either alignment and the larger of the
    two is taken: for sets of one closure each, the larger direction of eq. 4.

    Args:
        evidence: of one pair of robots, by `weigh`.
        first: bool `[k]` or indices among the pair's closures.
        second: likewise, none of them in `first`. Above 400 closures in all, both sets are thinned
            evenly, in proportion.

    Raises:
        InputError: as `joint_consistency`, for a closure in both sets, for singular information.
    """
    sets = [chosen_rows(evidence, first, "first"), chosen_rows(evidence, second, "second")]
    shared = np.intersect1d(sets[0], sets[1])
    if len(shared):
        raise InputError(f"second: closure {shared[0]} is in the first set too, expected another")
    asked = sum(map(len, sets))
    share = min(1.0, LIMIT / asked)
    sets = [thinned(rows, max(1, int(share * len(rows)))) for rows in sets]
    rows = np.concatenate(sets)
    stacked, group = stack_closures(evidence, rows), np.repeat([0, 1], [len(rows) for rows in sets])
    stacked.check_all_said("alignment_difference")
    own = [stacked.take(np.flatnonzero(group == k)).fit().alignment for k in (0, 1)]
    found = [_difference(stacked, group, own, about) for about in own]
    chi2, difference = max(found, key=lambda one: one[0])
    return AlignmentDifference(
        chi2, stacked.dim, survival(chi2, stacked.dim), difference, rows, asked
    )


def _difference(
    stacked: StackedClosures, group: np.ndarray, own: list[Any], about: Any
) -> tuple[float, np.ndarray]:
    """χ² of the difference of two alignments, and that difference.

    Errors are small about the set's own alignment; covariances are about a common one, without
    which an error common to a whole map would not cancel.
    """
    d = stacked.dim
    errors = np.empty((len(stacked), d))
    for k, alignment in enumerate(own):
        inside = np.flatnonzero(group == k)
        errors[inside] = stacked.take(inside).errors(alignment)
    fit = fitted(errors, stacked.covariance(about), group)
    moved = [
        lie.compose(lie.exp(lie.group_of(alignment), step), alignment)
        for alignment, step in zip(own, fit.correction, strict=True)
    ]
    apart = np.asarray(lie.log(lie.compose(moved[1], lie.inverse(moved[0]))))
    minus_plus = np.hstack([-np.eye(d), np.eye(d)])
    covariance = minus_plus @ fit.correction_covariance @ minus_plus.T
    return float(apart @ np.linalg.solve(covariance, apart)), apart


def survival(chi2: float, dof: int) -> float:
    """The probability of a chi-squared at least as large; 1 without a degree of freedom."""
    from scipy.special import gammaincc

    return float(gammaincc(0.5 * dof, 0.5 * chi2)) if dof else 1.0


def quantiles(gate: float, dim: int, count: int) -> Float[np.ndarray, " count+1"]:
    """The largest χ² of n jointly consistent closures, for n = 0 … count.

    Args:
        gate: γ² for two closures, whose confidence the others have too.
        dim: d.
        count: the largest n.
    """
    from scipy.special import gammaincc, gammainccinv

    tail = gammaincc(0.5 * dim, 0.5 * gate)
    largest = np.zeros(count + 1)
    largest[2:] = 2.0 * gammainccinv(0.5 * dim * np.arange(1, count), tail)
    return largest


def chosen_rows(evidence: PairEvidence, chosen: Any, argument: str) -> Int[np.ndarray, " k"]:
    """Indices among a pair's closures, from a mask or indices; all for None.

    Raises:
        InputError: for no closure, another length or dtype, an index out of range or given twice.
    """
    check_class("evidence", evidence, "the PairEvidence of two robots", PairEvidence)
    count = len(evidence)
    given = np.arange(count) if chosen is None else as_array(chosen, argument)
    if given.dtype == bool:
        if given.shape != (count,):
            raise InputError(f"{argument}: shape {given.shape}, expected ({count},), one a closure")
        given = np.flatnonzero(given)
    if given.size == 0:
        raise InputError(f"{argument}: no closure, expected at least one")
    if given.dtype.kind not in "iu" or given.ndim != 1:
        raise InputError(f"{argument}: {given.dtype} {given.shape}, expected bool or indices [k]")
    outside = np.flatnonzero((given < 0) | (given >= count))
    if outside.size:
        at = outside[0]
        raise InputError(f"{argument}[{at}]: {given[at]}, expected 0 … {count - 1}")
    values, times = np.unique(given, return_counts=True)
    if (times > 1).any():
        raise InputError(f"{argument}: closure {values[times > 1][0]} given twice, expected once")
    return given.astype(np.int64)


def thinned(rows: Int[np.ndarray, " k"], limit: int) -> Int[np.ndarray, " t"]:
    """At most `limit` of them, evenly spaced, the first and the last included."""
    if len(rows) <= limit:
        return rows
    return rows[np.round(np.linspace(0, len(rows) - 1, limit)).astype(int)]


def _in_own_frames(
    evidence: PairEvidence, stacked: StackedClosures, about: Any
) -> tuple[Any, Float[np.ndarray, "d d"]]:
    """The alignment of the maps' own frames, each map held at its first pose, and its covariance.

    `T_ab = t_a exp(w) W t_b⁻¹` with t the maps' origins: a step exp(w) on the left of W is
    Ad(t_b W⁻¹) w on the right of T_ab.
    """
    turned = stacked.covariance(about, centred=False)
    held = fitted(stacked.errors(about), turned, free=stacked.free)
    spread = held.correction_covariance
    if held.undetermined is not None:
        basis = np.linalg.qr(held.undetermined)[0]
        spread = spread + UNKNOWN * basis @ basis.T
    group = lie.group_of(about)
    alignment = lie.compose(lie.exp(group, held.correction[0]), about)
    a, b = (_shift(group, one.origin) for one in evidence.covariances or ())
    back = np.asarray(lie.adjoint(lie.compose(b, lie.inverse(alignment))))
    own = lie.compose(lie.compose(a, alignment), lie.inverse(b))
    return own, back @ spread @ back.T


def _shift(group: Any, origin: np.ndarray) -> Any:
    values = np.array(lie.parameters(lie.identity(group)))
    values[-len(origin) :] = origin
    return group(values)
