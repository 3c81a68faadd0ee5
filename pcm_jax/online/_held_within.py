"""`HeldWithin`: what is held of the closures inside one map while they come and go.

Their distances under each scale of odometry's errors that was asked for, as stated and the one that
closures ask for last, grow by a row a closure; so does the largest set of those that agree.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax.clique import GrowingClique
from pcm_jax.consistency import GrowingWithin
from pcm_jax.graph import LoopClosures, PoseGraph
from pcm_jax.online._arrivals import ends_of
from pcm_jax.online._maps import NewPart
from pcm_jax.online._pair import MANY
from pcm_jax.online._steady import steadied
from pcm_jax.pipeline.within_trials import Asked, Trials
from pcm_jax.selection import Choice
from pcm_jax.selection.choose import needs_distances

Distances = tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]


class HeldScale:
    """The closures under one scale of odometry's errors.

    Args:
        factor: on odometry's standard deviations.
        asked: gate and method.
        distances: of the closures to begin with, q² of pairs and of each with odometry alone.
    """

    def __init__(self, factor: float, asked: Asked, distances: Distances) -> None:
        self.factor, self._asked = factor, asked
        self._squared, self._own = (np.array(each) for each in distances)
        self._count = len(self._own)
        self._among = np.flatnonzero(self._agree(self._own))
        self._clique: GrowingClique | None = None
        if _is_searched(asked):
            squared = self._squared[np.ix_(self._among, self._among)]
            self._clique = GrowingClique.of_graph(agreeing(squared, asked.gate))

    def copy(self) -> HeldScale:
        """Copies the state; tables are shared as by `GrowingWithin.copy`."""
        twin = copy.copy(self)
        twin._clique = None if self._clique is None else self._clique.copy()
        return twin

    def distances(self) -> Distances:
        """q² of pairs, and of each with odometry alone; not to be written to."""
        found = self._squared[: self._count, : self._count], self._own[: self._count]
        for each in found:
            each.flags.writeable = False
        return found

    def append(self, growing: GrowingWithin) -> None:
        """Takes in the next of the closures that `growing` holds."""
        slot = self._count
        forward, backward = growing.row(slot, self.factor)
        own = growing.own(slot, self.factor)
        if slot == len(self._own):
            self._double()
        self._squared[:slot, slot], self._squared[slot, :slot] = forward, backward
        self._own[slot], self._count = own, slot + 1
        if not self._agree(np.array([own]))[0]:
            return
        if self._clique is not None:
            gate = self._asked.gate
            agrees = (forward[self._among] <= gate) & (backward[self._among] <= gate)
            self._clique.add(agrees)
        self._among = np.append(self._among, slot)

    def remove(self, slot: int) -> None:
        """Takes a closure out; those behind it move up by one."""
        kept = np.delete(np.arange(self._count), slot)
        self._squared, self._own = self._squared[np.ix_(kept, kept)], self._own[kept]
        self._count -= 1
        at = np.flatnonzero(self._among == slot)
        if len(at) and self._clique is not None:
            self._clique.remove(int(at[0]))
        left = self._among[self._among != slot]
        self._among = left - (left > slot)

    def largest(self) -> Choice | None:
        """The largest set of those that agree with odometry; None where it is not held."""
        if self._clique is None:
            return None
        found = self._clique.largest(self._asked.options["time_limit"])
        return Choice(found.members, found.optimal, found.upper_bound)

    def _agree(self, own: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        return (own <= self._asked.gate) | (not self._asked.own_loop)

    def _double(self) -> None:
        size = max(MANY, 2 * self._count)
        squared, own = np.zeros((size, size)), np.zeros(size)
        squared[: self._count, : self._count] = self._squared[: self._count, : self._count]
        own[: self._count] = self._own[: self._count]
        self._squared, self._own = squared, own


@dataclasses.dataclass(frozen=True)
class HeldWithin:
    """The closures inside one map, by the scales of odometry's errors that were asked for.

    Changed as a whole or not at all: each change makes a new one.

    Attributes:
        growing: the closures.
        scales: by factor, two at most. Of those that are not here distances are found anew.
        asked: gate and method.
    """

    growing: GrowingWithin
    scales: dict[float, HeldScale]
    asked: Asked

    @classmethod
    def of_odometry(cls, odometry: PoseGraph, asked: Asked, factor: float) -> HeldWithin:
        """A chain without closures, and the scale that is asked for first."""
        nothing = np.zeros((0, 0)), np.zeros(0)
        return cls(GrowingWithin(odometry), {factor: HeldScale(factor, asked, nothing)}, asked)

    def with_closures(self, closures: LoopClosures) -> HeldWithin:
        """These and further closures."""
        grown = self._copied()
        ends = ends_of(closures)
        if len(closures) > MANY:
            grown.scales.clear()
            grown.growing.append(*_measured(closures, ends))
            return grown
        for row in range(len(closures)):
            grown.growing.append(*_measured(closures[[row]], ends[[row]]))
            for scale in grown.scales.values():
                scale.append(grown.growing)
        return grown

    def without(self, gone: Bool[np.ndarray, " m"]) -> HeldWithin:
        """These but for some closures."""
        left = self._copied()
        if gone.sum() > MANY:
            left.scales.clear()
        for slot in np.flatnonzero(gone)[::-1].tolist():
            left.growing.remove(slot)
            for scale in left.scales.values():
                scale.remove(slot)
        return left

    def extended(self, part: NewPart) -> HeldWithin:
        """The same with further odometry, which changes none of them."""
        growing = self.growing.copy()
        growing.extend(part.tail, part.head, part.measurement, part.information)
        return dataclasses.replace(self, growing=growing)

    def at(self, factor: float, anew: Callable[[], Distances]) -> HeldScale:
        """The closures under a scale; one that is not held is found anew, and held from now on."""
        if factor not in self.scales:
            for other in [each for each in self.scales if each != 1.0]:
                del self.scales[other]
            self.scales[factor] = HeldScale(factor, self.asked, anew())
        return self.scales[factor]

    def _copied(self) -> HeldWithin:
        scales = {factor: scale.copy() for factor, scale in self.scales.items()}
        return dataclasses.replace(self, growing=self.growing.copy(), scales=scales)


class HeldTrials(Trials):
    """The trials of `select_within`, from what is held.

    Args:
        graph: the map.
        closures: edges that are closures.
        asked: the question.
        held: of these closures, in their order.
        members: marks those of the set believed before.
        hysteresis: see `_steady`.
    """

    def __init__(
        self,
        graph: PoseGraph,
        closures: Int[np.ndarray, " m"],
        asked: Asked,
        held: HeldWithin,
        members: Bool[np.ndarray, " m"],
        hysteresis: float,
    ) -> None:
        super().__init__(graph, closures, asked)
        self._held, self._members, self._hysteresis = held, members, hysteresis

    def distances(self, factor: float) -> Distances:
        """q² of pairs, and of each with odometry alone, its errors multiplied."""
        return self._scale(factor).distances()

    def largest(
        self, factor: float, squared: Float[np.ndarray, "m m"], among: Int[np.ndarray, " n"]
    ) -> Choice:
        """The set that the method finds among the closures that agree with odometry."""
        choice = self._scale(factor).largest() or super().largest(factor, squared, among)
        if not self._hysteresis:
            return choice
        agree = agreeing(squared[np.ix_(among, among)], self.asked.gate)
        before, plain = self._members[among], np.ones(len(among))
        return steadied(choice, agree, before, self._hysteresis, plain)

    def _scale(self, factor: float) -> HeldScale:
        anew = super().distances
        return self._held.at(factor, lambda: anew(factor))


def agreeing(squared: Float[np.ndarray, "m m"], gate: float) -> Bool[np.ndarray, "m m"]:
    """The graph of those that agree both ways, the diagonal false."""
    passes = squared <= gate
    np.fill_diagonal(passes, False)
    return passes & passes.T


def _is_searched(asked: Asked) -> bool:
    """True where the largest set by the graph alone is asked for."""
    return asked.method == "pcm-exact" and not needs_distances(asked.method, asked.options)


def _measured(
    closures: LoopClosures, ends: Int[np.ndarray, "m 4"]
) -> tuple[np.ndarray, np.ndarray, Any, np.ndarray]:
    return ends[:, 1], ends[:, 3], closures.measurement, np.asarray(closures.information)
