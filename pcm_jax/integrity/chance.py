"""The chance level: how often do closures of which none is right agree as well as these?

If none is right, a measurement says nothing of the poses that it is attached to: shuffled among the
closures, with their covariances, measurements make graphs of the same law. So with T the places of
a consistent set (`places`: closures beside each other on both ways count once),

    p = P( the largest set of a shuffle has more than T places, or T that agree about as well ),

a permutation test: exact in its level for any maps, drift, gate, group and law of false closures,
as long as what is measured at one place is independent of what is measured at another. Frames of
one place that all make the same mistake only add shuffles that agree by it: the test gets stricter.
"About as well": its total q² is at most 1.5 times that of the set in question. Without the second
half three right closures among a hundred are found in a third of the worlds in which they are with
it; without the factor, of worlds in which no closure is right exactly the level is merged, with it
half of that (0.5 % at 1 %).

It cannot see wrong closures that agree because the world repeats itself: that is for `rivals`.

Sequential (Besag and Clifford 1991): s shuffles of n reached T,

    p = (1 + s) / (1 + n)     after all n,        p = s / n     where it ends early, at the 5th.

Shuffles that leave all T measurements in their places agree of course. Their share among all,
f = (k − T)! / k!, is known and need not be drawn: p = f + (1 − f) p', p' from shuffles that move
one of them at least. Where f exceeds the level, so few closures cannot be told from chance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from pcm_jax.arrays import on_host
from pcm_jax.clique import maximum_clique
from pcm_jax.consistency import ConsistentPairs, PairEvidence
from pcm_jax.errors import InputError
from pcm_jax.integrity.places import Places

SIGNIFICANCE = 0.01
ENOUGH = 5
"""Shuffles that reached as many places: there is nothing more to learn."""
SHOWN = 19
"""Shuffles of which the places of the largest set are kept."""
MOST = 1500
"""Closures that are shuffled: about what `weigh` keeps distances of. Of more, so many drawn at
random, one a place as far as that goes, are shuffled and tested: a set of less than about one in
two hundred of all, of which few are drawn, is then not told from chance."""
MOST_SHUFFLES = 100_000
FIRST = 2048
"""Pairs of closures of the first shuffles that are weighed together: fewer take as long."""
ABOUT = 1.5
"""Times the total squared distance: a set that agrees about as well."""
SEARCH = 1.0
"""Seconds for the places of the set in question."""


@dataclass(frozen=True, eq=False, repr=False)
class ChanceLevel:
    """The distance of a consistent set from what chance does.

    Attributes:
        places: of the set; what the shuffles were compared with.
        p_value: probability that closures of which none is right reach as many places.
        least_p_value: what `p_value` could have been at best, with so many closures and places.
        shuffles: how many were made.
        null: int64 [≤ 19], places of the largest consistent set of each of the first shuffles.
        closures: how many took part: all, or of more than 1,500 some that lie apart.
    """

    places: int
    p_value: float
    least_p_value: float
    shuffles: int
    null: Int[np.ndarray, " s"]
    closures: int

    def __repr__(self) -> str:
        return (
            f"ChanceLevel(p {self.p_value:.2g})\n"
            f"  places    {self.places}, of shuffles {_span(self.null)}\n"
            f"  shuffles  {self.shuffles} of {self.closures} closures"
        )


def _span(values: np.ndarray) -> str:
    return f"{values.min()} to {values.max()}" if len(values) else "none made"


@on_host
def chance_level(
    evidence: PairEvidence,
    gate: float,
    places: Places,
    accepted: Bool[np.ndarray, " k"] | None = None,
    *,
    among: Bool[np.ndarray, " k"] | None = None,
    significance: float = SIGNIFICANCE,
    seed: int = 0,
) -> ChanceLevel:
    """Tests how often closures of which none is right agree as well as these.

        pair = selection.pairs[0]
        places = pcm_jax.integrity.places_of(pair.evidence, gate=pair.gate, members=pair.accepted)
        pcm_jax.integrity.chance_level(pair.evidence, pair.gate, places, pair.accepted).p_value

    Args:
        evidence: of the closures between two robots, see `weigh`.
        gate: γ².
        places: where these closures lie, see `places_of`.
        accepted: bool [k], the set in question; the largest one by default. Of a set that is not
            pairwise consistent, its largest consistent part counts.
        among: bool [k], the closures that are shuffled; all by default.
        significance: the level that p is to be compared with; as many shuffles are made as that
            takes.
        seed: of the shuffles; the same seed gives the same p.

    Returns:
        The level, with how it was found.

    Raises:
        InputError: for evidence without closures (`PairEvidence.from_squared`), a significance
            outside (0, 1).
    """
    if not 0.0 < significance < 1.0:
        raise InputError(f"significance: {significance}, expected a number between 0 and 1")
    generator = np.random.default_rng([seed, evidence.robot_a, evidence.robot_b])
    candidates = np.arange(len(places.way_a)) if among is None else np.flatnonzero(among)
    chosen = _taking_part(places, candidates, generator)
    within = np.ones(len(chosen), bool) if accepted is None else np.asarray(accepted)[chosen]
    shuffles = evidence.shuffles(gate, chosen, places.apart(chosen))
    as_given = shuffles.weigh(np.arange(len(chosen))[None])
    members, mark = _best(_among(as_given, within), SEARCH)
    if mark.places < 2:
        return ChanceLevel(mark.places, 1.0, 1.0, 0, np.zeros(0, np.int64), len(chosen))
    left = _share_left_in_place(len(chosen), mark.places)
    wanted = _shuffles_needed(significance, left)
    orders = _moving(generator, len(chosen), members, wanted, shuffles.together)
    found = list(_outcomes(shuffles, orders, mark))
    reached = sum(each.reached for each in found)
    moved = reached / len(found) if reached == ENOUGH else (1 + reached) / (1 + len(found))
    return ChanceLevel(
        places=mark.places,
        p_value=left + (1.0 - left) * moved,
        least_p_value=left + (1.0 - left) / (1.0 + wanted),
        shuffles=len(found),
        null=np.array([each.places for each in found[:SHOWN]], np.int64),
        closures=len(chosen),
    )


class _Mark(NamedTuple):
    """The places to be reached, and the total squared distance of the set that has them."""

    places: int
    total: float


class _Outcome(NamedTuple):
    places: int
    reached: bool


_TOO_FEW = _Outcome(0, False)


def _taking_part(
    places: Places, candidates: Int[np.ndarray, " c"], generator: np.random.Generator
) -> Int[np.ndarray, " t"]:
    """All candidates; of too many some, as far as can be one a place, in random order of choice."""
    if len(candidates) <= MOST:
        return candidates
    order = generator.permutation(candidates)
    taken = places.spread_out(order, MOST)
    rest = np.setdiff1d(order, taken, assume_unique=True)
    return np.sort(np.concatenate([taken, rest])[:MOST])


def _share_left_in_place(count: int, reached: int) -> float:
    """(k − T)! / k!, the share of orders that leave T of k where they are."""
    return math.exp(math.lgamma(count - reached + 1) - math.lgamma(count + 1))


def _shuffles_needed(significance: float, left: float) -> int:
    """Shuffles of which none may reach as many places for p to be at most the level."""
    if left >= significance:
        return SHOWN
    return min(MOST_SHUFFLES, math.ceil((1.0 - left) / (significance - left)) - 1)


def _moving(
    generator: np.random.Generator, count: int, members: np.ndarray, wanted: int, together: int
) -> Iterator[Int[np.ndarray, "b k"]]:
    """Random orders that move one of the members at least, some at a time, more and more."""
    made, batch = 0, max(2, FIRST // count**2)
    while made < wanted:
        batch = min(batch, together, wanted - made)
        orders = generator.permuted(np.tile(np.arange(count), (batch, 1)), axis=1)
        orders = orders[(orders[:, members] != members).any(axis=1)]
        made, batch = made + len(orders), 2 * batch
        yield orders


def _outcomes(shuffles: Any, orders: Iterator[np.ndarray], mark: _Mark) -> Iterator[_Outcome]:
    """Places of the largest set of each shuffle, until enough have reached the mark.

    Exact for the first; after them 0 for shuffles that cannot reach as many.
    """
    made = reached = 0
    for order in orders:
        shown = min(max(0, SHOWN - made), len(order))
        for part, at_least in ((order[:shown], 0), (order[shown:], mark.places)):
            if not len(part):
                continue
            pairs = shuffles.weigh(part, at_least=at_least)
            enough = np.bincount(pairs.shuffle, minlength=len(part)) >= math.comb(at_least, 2)
            for shuffle, may in enumerate(enough.tolist()):
                outcome = _outcome(pairs.of(shuffle), at_least, mark) if may else _TOO_FEW
                made += 1
                reached += outcome.reached
                yield outcome
                if reached == ENOUGH:
                    return


def _outcome(pairs: ConsistentPairs, at_least: int, mark: _Mark) -> _Outcome:
    pairs = pairs.peeled(at_least)
    if len(pairs.u) == 0:
        return _Outcome(1, False) if at_least == 0 else _TOO_FEW
    largest = _Graph.of(pairs)
    places = int(largest.members(None).sum())
    if places != mark.places:
        return _Outcome(places, places > mark.places)
    return _Outcome(places, largest.total(largest.tightest(None)) <= ABOUT * mark.total)


def _among(pairs: ConsistentPairs, within: Bool[np.ndarray, " k"]) -> ConsistentPairs:
    return pairs.take(within[pairs.u] & within[pairs.v])


def _best(
    pairs: ConsistentPairs, limit: float | None = None
) -> tuple[Int[np.ndarray, " t"], _Mark]:
    """A largest set, of those the one of least total; where the time is over, a large one."""
    if len(pairs.u) == 0:
        return np.zeros(0, np.int64), _Mark(1, 0.0)
    graph = _Graph.of(pairs)
    found = graph.tightest(limit)
    return graph.closures[found], _Mark(int(found.sum()), graph.total(found))


class _Graph(NamedTuple):
    """The closures that agree with others, as a graph.

    Attributes:
        closures: `[n]`, which they are.
        adjacent: bool `[n, n]`.
        squared: `[n, n]`, q² where adjacent.
    """

    closures: Int[np.ndarray, " n"]
    adjacent: Bool[np.ndarray, "n n"]
    squared: Any

    @classmethod
    def of(cls, pairs: ConsistentPairs) -> _Graph:
        closures, ends = np.unique(np.stack([pairs.u, pairs.v]), return_inverse=True)
        u, v = ends.reshape(2, -1)
        adjacent = np.zeros((len(closures), len(closures)), bool)
        squared = np.zeros(adjacent.shape)
        adjacent[u, v] = adjacent[v, u] = True
        squared[u, v] = squared[v, u] = pairs.squared
        return cls(closures, adjacent, squared)

    def members(self, limit: float | None) -> Bool[np.ndarray, " n"]:
        """A largest set."""
        return maximum_clique(self.adjacent, time_limit=limit).members

    def tightest(self, limit: float | None) -> Bool[np.ndarray, " n"]:
        """The largest set of least total."""
        return maximum_clique(self.adjacent, tie_break=self.squared, time_limit=limit).members

    def total(self, members: Bool[np.ndarray, " n"]) -> float:
        """The sum of q² over the pairs of a set."""
        return float(self.squared[np.ix_(members, members)].sum()) / 2.0
