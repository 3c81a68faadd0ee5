"""The decision on a pair of robots: whether what its closures say is to be believed, and why.

A set is believed if chance explains it at the level of significance only (`chance`), over all pairs
of robots together by Holm's rule: with p-values in ascending order, the first of n must be at most
α/n, the next α/(n − 1), …, and all from the first that is not are refused. So the probability that
any pair of robots that never met is merged is at most α, however many pairs there are. And it is
believed only if no other alignment is supported about as well (`rivals`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from pcm_jax.consistency import PairEvidence
from pcm_jax.integrity.chance import SIGNIFICANCE, ChanceLevel, chance_level
from pcm_jax.integrity.places import Places, places_of
from pcm_jax.integrity.rivals import Rival, strongest_rival

ROUNDING = 1e-12
"""By which a p-value may exceed a level that it equals."""


class Doubts(NamedTuple):
    """The two costly questions on a set; whoever asks again and again hands in ones that remember.

    Attributes:
        chance: as `chance_level`.
        rival: as `strongest_rival`.
    """

    chance: Callable[..., ChanceLevel]
    rival: Callable[..., Rival | None]


AS_ASKED = Doubts(chance_level, strongest_rival)


@dataclass(frozen=True, eq=False, repr=False)
class Verdict:
    """The judgement on the set that a method found between two robots.

    Attributes:
        believed: whether it is accepted.
        why: in a sentence.
        found: closures of the set.
        places: of the set, see `Places`.
        separation: metres between two places.
        chance: how the set stands out from chance; None where nobody asked.
        rival: the best set that implies another alignment; None without one, or where nobody asked.
    """

    believed: bool
    why: str
    found: int
    places: int
    separation: float
    chance: ChanceLevel | None = None
    rival: Rival | None = None

    @property
    def ambiguous(self) -> bool:
        """True where a rival explains the closures about as well."""
        return self.rival is not None and self.rival.ambiguous

    def __repr__(self) -> str:
        return f"Verdict({'believed' if self.believed else 'refused'}: {self.why})"


def judge_by_number(
    evidence: PairEvidence,
    members: Bool[np.ndarray, " k"],
    minimum: int,
    gate: float,
    separation: float | None = None,
) -> Verdict:
    """Judges the set that a method found by the fixed rule: so many closures suffice.

    Args:
        evidence: of the pair of robots.
        members: bool [k].
        minimum: closures.
        gate: γ².
        separation: metres between two places, see `places_of`.
    """
    places = places_of(evidence, separation, gate=gate, members=members)
    found = int(np.count_nonzero(members))
    believed = 0 < found >= minimum
    why = f"{found} of {len(members)} closures found that agree, {minimum} asked for"
    return Verdict(believed, why, found, places.count(members), places.separation)


def judge_by_chance(
    pairs: Sequence[tuple[PairEvidence, Bool[np.ndarray, " k"]]],
    gate: float,
    *,
    significance: float = SIGNIFICANCE,
    separation: float | None = None,
    on_ambiguous: str = "split",
    seed: int = 0,
    doubts: Doubts = AS_ASKED,
) -> list[Verdict]:
    """Judges the sets that a method found, all pairs of robots together.

    Args:
        pairs: the evidence of each pair, and the members of its set.
        gate: γ².
        significance: probability that any pair without a right closure is believed.
        separation: metres between two places, see `places_of`.
        on_ambiguous: "split": a set with a rival about as good is not believed (see `rivals`);
            "largest": it is, and said to be ambiguous.
        seed: of the shuffles.
        doubts: where chance levels and rivals come from.

    Returns:
        A verdict a pair.

    Raises:
        InputError: as `places_of` and `chance_level` do.
    """
    found = []
    for evidence, members in pairs:
        places = places_of(evidence, separation, gate=gate, members=members)
        level = significance / len(pairs)
        chance = doubts.chance(evidence, gate, places, members, significance=level, seed=seed)
        found.append((members, places, chance))
    passed = holm(np.array([chance.p_value for _, _, chance in found]), significance)
    verdicts = []
    for passes, pair, (members, places, chance) in zip(passed, pairs, found, strict=True):
        rival = None
        if passes:
            asked: dict[str, Any] = {"significance": significance, "seed": seed}
            rival = doubts.rival(pair[0], gate, places, members, **asked)
        ambiguous = rival is not None and rival.ambiguous
        why = _why(bool(passes), members, places, chance, significance, len(pairs))
        verdicts.append(
            Verdict(
                believed=bool(passes) and not (ambiguous and on_ambiguous == "split"),
                why=why + (_against(rival) if ambiguous else ""),  # type: ignore[arg-type]
                found=int(np.count_nonzero(members)),
                places=places.count(members),
                separation=places.separation,
                chance=chance,
                rival=rival,
            )
        )
    return verdicts


def holm(p_values: Float[np.ndarray, " n"], significance: float) -> Bool[np.ndarray, " n"]:
    """Marks the p-values that are significant together (Holm 1979).

    Args:
        p_values: one of each test.
        significance: probability that any test of a true null hypothesis is marked.
    """
    order = np.argsort(p_values, kind="stable")
    levels = significance / np.arange(len(p_values), 0, -1)
    passes = p_values[order] <= levels + ROUNDING
    marked = np.zeros(len(p_values), bool)
    marked[order] = np.logical_and.accumulate(passes)
    return marked


def _against(rival: Rival) -> str:
    chance = "" if rival.chance is None else f", p = {rival.chance.p_value:.2g}"
    return (
        f"; AMBIGUOUS: {rival.size} others at {rival.places} places{chance} agree on another"
        " alignment"
    )


def _why(
    believed: bool,
    members: np.ndarray,
    places: Places,
    chance: ChanceLevel,
    significance: float,
    pairs: int,
) -> str:
    found, total = int(np.count_nonzero(members)), len(members)
    level = f"{significance:g}" if pairs == 1 else f"{significance:g} over {pairs} robot pairs"
    if found < 2:
        return f"no two of {total} closures agree; one alone agrees with itself, whatever it says"
    if chance.places < 2:
        return (
            f"{found} of {total} closures agree, all at one place (within {places.separation:.3g} m"
            " on both ways), which cannot be told from chance: closures at other places would help"
        )
    where = f"{found} of {total} closures agree, at {chance.places} places"
    if believed:
        return f"{where}; chance does as well with p = {chance.p_value:.2g}"
    if chance.least_p_value > significance / pairs + ROUNDING:
        return (
            f"{where}, which cannot be told from chance (p = {chance.p_value:.2g}; "
            f"{chance.least_p_value:.2g} at best with so few, {level} asked for): more closures "
            "would help"
        )
    return f"{where}, and chance does as well with p = {chance.p_value:.2g} ({level} asked for)"
