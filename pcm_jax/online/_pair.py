"""`HeldPair`: what is held of the closures between two robots while they come and go."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from pcm_jax.clique import GrowingClique
from pcm_jax.consistency import (
    GrowingPair,
    PackedGraph,
    PairEvidence,
    bytes_needed,
    problem_from_covariances,
    stream_from_covariances,
    weighed_on_host,
)
from pcm_jax.graph import LoopClosures
from pcm_jax.mapping import MapCovariance
from pcm_jax.online._arrivals import Arrived
from pcm_jax.online._steady import steadied
from pcm_jax.selection import METHODS, Choice, choose
from pcm_jax.selection.choose import needs_distances
from pcm_jax.selection.weights import weights_for

MANY = 64
"""Closures that come together, from which all pairs are weighed at once rather than row by row."""
MOST_MOVED = 0.3
"""Share of closures that moved, from which all pairs are weighed anew at once."""

Covariances = tuple[MapCovariance, MapCovariance]
Metric = Callable[[Any, Any, LoopClosures], Any]


class HeldPair:
    """The closures between two robots: who agrees with whom, and the largest set of those who do.

    Args:
        robots: a and b, a the smaller.
        covariances: of their maps.
        gate: γ².
        memory_limit: bytes for distances, as for `weigh`.
        metric: a function of one's own, whose graph cannot grow and is found anew; None:
            Mahalanobis.

    Attributes:
        robots, covariances, gate: as given.
        closures: int64 `[k]`, indices among all closures, ascending.
        clique: of the consistency graph; None with a metric.
        known: chance levels and rivals, for as long as nothing changes.
        believed: bool `[k]`, those of the last answer.
    """

    def __init__(
        self,
        robots: tuple[int, int],
        covariances: Covariances,
        gate: float,
        memory_limit: float,
        metric: Metric | None,
    ) -> None:
        self.robots, self.covariances, self.gate = robots, covariances, gate
        self.closures: Int[np.ndarray, " k"] = np.zeros(0, np.int64)
        self._arrived = Arrived(LoopClosures.empty(covariances[0].pose_graph.group))
        self.clique = None if metric else GrowingClique()
        self.known: dict[Any, Any] = {}
        self.believed: Bool[np.ndarray, " k"] = np.zeros(0, bool)
        self._limit, self._metric = memory_limit, metric
        self._growing = None if metric else GrowingPair(covariances, gate)
        self._evidence: PairEvidence | None = None
        self._choice: Choice | None = None

    def __len__(self) -> int:
        return len(self.closures)

    @property
    def measured(self) -> LoopClosures:
        """The closures themselves, from a to b."""
        return self._arrived.closures

    def copy(self) -> HeldPair:
        """Copies what changes, so that a change can be undone by going on with the copy."""
        twin = copy.copy(self)
        if self.clique is not None and self._growing is not None:
            twin.clique, twin._growing = self.clique.copy(), self._growing.copy()
        twin.known = dict(self.known)
        return twin

    def add(
        self,
        closures: LoopClosures,
        indices: Int[np.ndarray, " c"],
        clique: GrowingClique | None = None,
    ) -> None:
        """Takes closures in, behind those held.

        Args:
            closures: from a to b.
            indices: of them, among all closures.
            clique: of the graph of all closures here, where it is known.

        Raises:
            InputError: for a map whose information is singular.
        """
        self._arrived = self._arrived.with_more(closures)
        self.closures = np.concatenate([self.closures, indices])
        self.believed = np.append(self.believed, np.zeros(len(closures), bool))
        self._forget()
        if self._growing is None or self.clique is None:
            return
        if len(closures) > MANY or clique is not None:
            self._growing.take_in(closures)
            self.clique = clique or GrowingClique.of_graph(self._asked(None).consistent(self.gate))
            return
        for row in range(len(closures)):
            self.clique.add(self._growing.agreeing(closures[[row]]))
            self._growing.append()

    def remove(self, rows: Int[np.ndarray, " r"]) -> None:
        """Takes closures out, by their places here."""
        kept = np.ones(len(self), bool)
        kept[rows] = False
        self._arrived, self.closures = Arrived(self.measured[kept]), self.closures[kept]
        self.believed = self.believed[kept]
        self._forget()
        for row in sorted(rows.tolist(), reverse=True):
            if self._growing is not None and self.clique is not None:
                self._growing.remove(row)
                self.clique.remove(row)

    def renumber(self, before: Int[np.ndarray, " m"]) -> None:
        """Gives the closures other indices: `before[i]` is that of the one that was i."""
        moved = before[self.closures]
        if not np.array_equal(moved, self.closures):
            self.closures, self._evidence = moved, None

    def is_in(self, covariances: Covariances) -> bool:
        """True where these are the maps that the closures were weighed in."""
        return all(a is b for a, b in zip(self.covariances, covariances, strict=True))

    def grow(self, covariances: Covariances) -> None:
        """Goes on with maps that have grown by odometry alone: all distances stay."""
        self.covariances = covariances
        self._forget()
        if self._growing is not None:
            self._growing.covariances = covariances

    def rebuilt(self, covariances: Covariances) -> HeldPair:
        """The same closures in other maps, weighed anew.

        Raises:
            InputError: as `add`.
        """
        anew = HeldPair(self.robots, covariances, self.gate, self._limit, self._metric)
        anew.add(self.measured, self.closures)
        anew.believed = self.believed
        return anew

    def refreshed(self, covariances: Covariances, tolerance: float) -> HeldPair:
        """The same closures in other maps, weighed anew where distances moved.

        Args:
            covariances: of the maps.
            tolerance: how far q (not squared) of two closures may have moved for them to be left
                as they were judged.

        Raises:
            InputError: as `add`.
        """
        if self._growing is None or self.clique is None or not tolerance or not len(self):
            return self.rebuilt(covariances)
        growing = GrowingPair(covariances, self.gate)
        growing.take_in(self.measured)
        moved = self._growing.moved_to(growing) > 0.5 * tolerance
        if moved.sum() > MOST_MOVED * len(self):
            return self.rebuilt(covariances)
        growing.keep(~moved, self._growing)
        anew, graph = self.copy(), self.clique.dense()
        for row in np.flatnonzero(moved).tolist():
            graph[row] = graph[:, row] = growing.agreeing(self.measured[[row]])
        np.fill_diagonal(graph, False)
        anew.covariances, anew._growing = covariances, growing
        anew.clique = GrowingClique.of_graph(graph) if moved.any() else self.clique
        anew._forget()
        return anew

    def evidence(self) -> PairEvidence:
        """The evidence, whose graph is known; distances are computed when they are asked for."""
        if self._evidence is None:
            known = None
            if self.clique is not None:
                dense = self.clique.dense()
                known = self.gate, PackedGraph(np.packbits(dense, axis=1), len(dense))
            self._evidence = self._asked(known)
        return self._evidence

    def choice(self, method: Any, options: dict[str, Any], hysteresis: float = 0.0) -> Choice:
        """The set that a method chooses, as `choose` finds it from all distances.

        Args:
            method, options: as there.
            hysteresis: see `_steady`.
        """
        if self._choice is None:
            self._choice = self._chosen(method, options)
        if not hysteresis:
            return self._choice
        given = np.asarray(self.measured.weight, np.float64)
        weight = np.ones(len(self)) if self._choice.weight is None else given
        return steadied(self._choice, self.agree(), self.believed, hysteresis, weight)

    def agree(self) -> Bool[np.ndarray, "k k"]:
        """The graph of those that agree, symmetric."""
        return self.evidence().consistent(self.gate)

    def _chosen(self, method: Any, options: dict[str, Any]) -> Choice:
        evidence = self.evidence()
        weights = weights_for(method, evidence)
        by_graph = isinstance(method, str) and METHODS[method].choose_in is not None
        if self.clique is None or not by_graph or needs_distances(method, options):
            return choose(evidence, self.gate, method=method, **options, **weights)
        own = {name: value for name, value in options.items() if name != "tie_break"}
        if method == "pcm-exact" and not weights and "time_limit" not in own:
            return Choice(self.clique.first(), True, self.clique.size)
        return METHODS[method].choose_in(self.clique.dense(), **own, **weights)  # type: ignore[misc]

    def _asked(self, known: tuple[float, PackedGraph] | None) -> PairEvidence:
        measured, both = self.measured, self.covariances
        found: dict[str, Any] = {}
        if self._metric is not None:
            own = functools.partial(self._metric, *(each.pose_graph for each in both))
            found = {"distances": lambda: (own(measured), None), "metric": own}
        elif bytes_needed(measured) > self._limit:
            found["stream"] = functools.partial(stream_from_covariances, *both, measured)
        else:
            found["distances"] = lambda: weighed_on_host(problem_from_covariances(*both, measured))
        return PairEvidence.with_graph(self.robots, self.closures, measured, both, known, **found)

    def _forget(self) -> None:
        self._evidence = self._choice = None
        self.known = {}
