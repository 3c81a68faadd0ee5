"""Rivals: the best set of closures that implies another alignment of the two maps.

Where the world repeats itself, several sets agree within themselves, each beyond chance, and the
largest need not be the right one. A rival is the largest consistent set R whose closures contradict
those of the set in question C, by the uncertainty of maps and measurements: few pairs of C x R are
consistent. (Closures that C leaves out though they mean the same alignment are near misses: they
contradict some members and agree with many others.) The answer is ambiguous if

    R has nearly as many closures:     4 |R| > 3 |C|; or
    R rests on about as many places,   2 places(R) > places(C),   and is beyond chance among the
    closures that are not in C; or
    C lies in one stretch,             shorter than a tenth of the longer way and with at most two
    places if places are as long as R's reach; and R has at least three closures and a third of C's,
    and is beyond chance among the others, counted by closures.

The last is for a corridor taken for another: any number of closures in one short stretch repeat one
mistake. Of two sets that exclude each other one is such a mistake, and if it is R, then mistakes
here reach as far as R does: what C says beyond two stretches of that length is evidence, the number
of its frames is not. On Bicocca 25b, cut before pose 6268, 19 false closures within 17 m outvote 8
right ones within 10 m: ambiguous. Rivals of right sets, there and elsewhere, are either as small as
chance makes them or near misses.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool

from pcm_jax.arrays import on_host
from pcm_jax.clique import maximum_clique
from pcm_jax.consistency import JointConsistency, PairEvidence, joint_consistency
from pcm_jax.consistency.joint import thinned
from pcm_jax.integrity.chance import SIGNIFICANCE, ChanceLevel, chance_level
from pcm_jax.integrity.places import Places, way_of

AGREEING = 0.25
"""Share of pairs across two sets: with fewer that are consistent, they imply two alignments."""
TRIES = 8
"""Largest sets that are looked at before it is said that there is no rival."""
FEWEST, FEWEST_OF_ONE = 2, 3
"""Closures of a rival, and of one beside which a set may be one mistake."""
STRETCH = 0.1
"""Of the longer way: closures that reach less far may be one mistake."""
JOINT = 60
"""Closures of a rival that its alignment is found from, evenly spaced."""
SEARCH = 5.0
"""Seconds for each of these sets."""


@dataclass(frozen=True, eq=False, repr=False)
class Rival:
    """The best set that implies another alignment.

    Attributes:
        members: bool [k].
        places: see `Places`.
        shared: members of the set in question that agree with all of the rival's.
        agreeing: share of the pairs across the two sets that are consistent.
        joint: its alignment of the maps with its covariance, of 60 closures at most.
        chance: how it stands out from chance; None where it is too small to matter.
        ambiguous: whether it explains the closures about as well as the set in question.
    """

    members: Bool[np.ndarray, " k"]
    places: int
    shared: int
    agreeing: float
    joint: JointConsistency
    chance: ChanceLevel | None
    ambiguous: bool

    @property
    def size(self) -> int:
        """Closures."""
        return int(np.count_nonzero(self.members))

    def __repr__(self) -> str:
        told = "ambiguous" if self.ambiguous else "clearly weaker"
        by_chance = "" if self.chance is None else f", by chance with p = {self.chance.p_value:.2g}"
        return (
            f"Rival({told})\n"
            f"  closures  {self.size} at {self.places} places{by_chance}\n"
            f"  agreeing  {100.0 * self.agreeing:.2g} % of the pairs with the larger set"
        )


@on_host
def strongest_rival(
    evidence: PairEvidence,
    gate: float,
    places: Places,
    members: Bool[np.ndarray, " k"],
    *,
    significance: float = SIGNIFICANCE,
    seed: int = 0,
) -> Rival | None:
    """Finds the best set of closures that implies another alignment than the set in question.

        pair = selection.pairs[0]
        places = pcm_jax.integrity.places_of(pair.evidence, gate=pair.gate, members=pair.accepted)
        pcm_jax.integrity.strongest_rival(pair.evidence, pair.gate, places, pair.accepted)

    Args:
        evidence: of the closures between two robots, see `weigh`.
        gate: γ².
        places: of these closures.
        members: bool [k], the set in question.
        significance: the level at which a rival is beyond chance.
        seed: of the shuffles for that.

    Returns:
        The first that makes the answer ambiguous, else the largest; None without any.
    """
    graph = evidence.consistent(gate)
    left, largest = ~members, None
    longer_way = max((float(way_of(one)[-1]) for one in evidence.maps or ()), default=0.0)
    for _ in range(TRIES):
        found = _largest_among(graph, left)
        if np.count_nonzero(found) < FEWEST:
            break
        left &= ~found
        agreeing = float(graph[np.ix_(members, found)].mean())
        if agreeing > AGREEING:
            continue  # near misses
        chance = None
        ambiguous = _nearly_as_large(members, found)
        for counted in () if ambiguous else _countings(places, members, found, longer_way):
            # Shuffled among the others: members repeat each other, shuffled or not.
            asked: dict[str, Any] = {"among": ~members, "significance": significance, "seed": seed}
            chance = chance_level(evidence, gate, counted, found, **asked)
            ambiguous = chance.p_value <= significance
            if ambiguous:
                break
        if ambiguous or largest is None:
            largest = found, agreeing, chance, ambiguous
        if ambiguous:
            break
    if largest is None:
        return None
    found, agreeing, chance, ambiguous = largest
    return Rival(
        members=found,
        places=places.count(found),
        shared=int(graph[np.ix_(members, found)].all(axis=1).sum()),
        agreeing=agreeing,
        joint=joint_consistency(evidence, thinned(np.flatnonzero(found), JOINT)),
        chance=chance,
        ambiguous=ambiguous,
    )


def _largest_among(
    graph: Bool[np.ndarray, "k k"], left: Bool[np.ndarray, " k"]
) -> Bool[np.ndarray, " k"]:
    chosen = np.flatnonzero(left)
    found = np.zeros(len(left), bool)
    clique = maximum_clique(graph[np.ix_(chosen, chosen)], time_limit=SEARCH)
    found[chosen] = clique.members
    return found


def _nearly_as_large(members: np.ndarray, rival: np.ndarray) -> bool:
    """True if which of two sets is the larger hangs on a closure or two."""
    return bool(4 * np.count_nonzero(rival) > 3 * np.count_nonzero(members))


def _countings(
    places: Places, members: np.ndarray, rival: np.ndarray, longer_way: float
) -> Iterator[Places]:
    """Ways to count a rival's witnesses by which it is as good as the members, if beyond chance."""
    if 2 * places.count(rival) > places.count(members):
        yield places
    enough = np.count_nonzero(rival) >= max(FEWEST_OF_ONE, np.count_nonzero(members) / 3)
    if enough and places.reach(members) < STRETCH * longer_way:
        one_mistake = max(places.separation, places.reach(rival))
        if dataclasses.replace(places, separation=one_mistake).count(members) <= 2:
            yield dataclasses.replace(places, separation=0.0)
