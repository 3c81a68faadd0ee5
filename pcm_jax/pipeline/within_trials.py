"""One map's closures, tried under several scales of odometry's errors. Host."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.consistency import (
    PairEvidence,
    odometry_edges,
    own_loops,
    squared_mahalanobis,
    squared_own_loops,
    with_odometry_errors,
    within_problem,
)
from pcm_jax.consistency.overstated import narrowing
from pcm_jax.graph import PoseGraph
from pcm_jax.integrity import Places
from pcm_jax.integrity.odometry import odometry_scale
from pcm_jax.integrity.places import longest_run
from pcm_jax.integrity.within import Loops
from pcm_jax.selection.choose import Method, choose
from pcm_jax.selection.method import Choice

AS_GOOD = 0.9
"""Of the closures that agree under another scale: if so many do as stated, it is as stated. And of
those as stated: what a set under another scale must keep, else it is another answer."""
MOST = 1500
"""Closures that are shuffled; of more, so many drawn at random."""


class Asked(NamedTuple):
    """The question, checked."""

    gate: float
    method: Method
    own_loop: bool
    options: dict[str, Any]
    separation: float | None


class Trial(NamedTuple):
    """The closures that a method finds under one scale of odometry's errors.

    Attributes:
        factor: on odometry's standard deviations.
        fitted: whether these closures themselves said so.
        squared: float64 [m, m].
        own_squared: float64 [m].
        choice: among the closures that agree with odometry.
        members: bool [m].
    """

    factor: float
    fitted: bool
    squared: Float[np.ndarray, "m m"]
    own_squared: Float[np.ndarray, " m"]
    choice: Choice
    members: Bool[np.ndarray, " m"]

    @property
    def found(self) -> int:
        """The number of members."""
        return int(self.members.sum())


class Trials:
    """One map's closures, to be tried under several scales of odometry's errors."""

    def __init__(self, graph: PoseGraph, closures: np.ndarray, asked: Asked):
        self.graph, self.closures, self.asked, self.measuring = graph, closures, asked, 0.0
        self.problem = within_problem(graph)
        odometry = lie.take(lie.as_numpy(graph.measurement), odometry_edges(graph))
        steps = np.linalg.norm(lie.translation(odometry), axis=1)
        way = np.concatenate([[0.0], np.cumsum(steps)])
        ends = np.stack([np.asarray(graph.tail), np.asarray(graph.head)])[:, closures]
        self.ends = np.sort(ends, axis=0)
        self.ways, self.step = (way[self.ends[0]], way[self.ends[1]]), way[-1] / max(1, len(steps))
        touched = [
            lie.translation(lie.as_numpy(p)) for p in (self.problem.pose_a, self.problem.pose_b)
        ]
        self.extent = np.ptp(np.concatenate(touched), axis=0)

    def all(self, given: float | None) -> list[Trial]:
        """The trials that may be believed, the preferred one first."""
        if given is not None:
            return [self._at(given, fitted=False)]
        stated = self._at(1.0, fitted=False)
        if not self.asked.own_loop or not len(self.closures):
            return [stated]
        loops = own_loops(self.problem)
        scale = odometry_scale(loops, self.extent)
        if scale.factor == 1.0 or not scale.found:
            return [stated]
        fitted = self._at(scale.factor, fitted=True)
        if stated.found >= AS_GOOD * fitted.found:
            return [stated]
        contained = np.count_nonzero(fitted.members & stated.members) >= AS_GOOD * stated.found
        return [fitted, stated] if contained else [stated, fitted]

    def distances(self, factor: float) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """q² of pairs, and of each with odometry alone, its errors multiplied."""
        problem = with_odometry_errors(self.problem, factor) if factor != 1.0 else self.problem
        return np.asarray(squared_mahalanobis(problem)), np.asarray(squared_own_loops(problem))

    def largest(
        self, factor: float, squared: Float[np.ndarray, "m m"], among: Int[np.ndarray, " n"]
    ) -> Choice:
        """The set that the method finds among some closures, marked among these."""
        return self._chosen(squared, among, self.asked.gate)

    def core(self, trial: Trial) -> Bool[np.ndarray, " m"]:
        """Marks the largest set of a trial's under a gate that is narrower where they fit too well.

        See `consistency.overstated`.
        """
        rows, dim = np.flatnonzero(trial.members), self.graph.tangent_dim
        pairs = trial.squared[np.ix_(rows, rows)][np.triu_indices(len(rows), 1)]
        gate = self.asked.gate * narrowing(pairs, self.asked.gate, dim, count=len(rows))
        if gate == self.asked.gate:
            return trial.members
        among = np.flatnonzero(trial.members & self._agree_with_odometry(trial.own_squared, gate))
        choice = self._chosen(trial.squared, among, gate)
        return _marked(choice, among, len(trial.members))

    def _chosen(
        self, squared: Float[np.ndarray, "m m"], among: Int[np.ndarray, " n"], gate: float
    ) -> Choice:
        evidence = PairEvidence.from_squared(squared[np.ix_(among, among)])
        return choose(evidence, gate, method=self.asked.method, **self.asked.options)

    def _agree_with_odometry(
        self, own_squared: Float[np.ndarray, " m"], gate: float
    ) -> Bool[np.ndarray, " m"]:
        return (own_squared <= gate) | (not self.asked.own_loop)

    def _at(self, factor: float, *, fitted: bool) -> Trial:
        start = time.perf_counter()
        squared, own_squared = self.distances(factor)
        self.measuring += time.perf_counter() - start
        among = np.flatnonzero(self._agree_with_odometry(own_squared, self.asked.gate))
        choice = self.largest(factor, squared, among)
        members = _marked(choice, among, len(squared))
        return Trial(factor, fitted, squared, own_squared, choice, members)

    def places(self, trial: Trial) -> Places:
        """The places of the closures; the separation is that of the trial's set."""
        separation = self.asked.separation
        if separation is None:
            evidence = PairEvidence.from_squared(trial.squared)
            steps = (self.step, self.step)
            separation = longest_run(evidence, self.asked.gate, trial.members, self.ways, steps)
        return Places(self.ways[0], self.ways[1], float(separation))

    def loops(self, places: Places) -> Loops:
        """The closures, for tests of chance."""
        return Loops(self.graph, self.problem, places, self.extent)

    def some(self, places: Places, generator: np.random.Generator) -> tuple[Loops, np.ndarray]:
        """The closures that are shuffled, and which they are."""
        count = len(self.closures)
        if count <= MOST:
            return self.loops(places), np.arange(count)
        chosen = np.sort(generator.choice(count, MOST, replace=False))
        graph = self.graph.with_edges(
            np.concatenate([odometry_edges(self.graph), self.closures[chosen]])
        )
        thinned = Places(self.ways[0][chosen], self.ways[1][chosen], places.separation)
        return Loops(graph, within_problem(graph), thinned, self.extent), chosen

    def contradicting(self, trial: Trial) -> str:
        """Says so where closures agree among themselves, but hardly any with odometry."""
        agreeing = int(np.count_nonzero(trial.own_squared <= self.asked.gate))
        every = np.arange(len(trial.members))
        among_all = Trials.largest(self, trial.factor, trial.squared, every).members
        if among_all.sum() < 3 or 2 * agreeing > among_all.sum():
            return ""
        return (
            f"; everything contradicts odometry: {among_all.sum()} of {len(trial.members)} closures"
            f" agree among themselves, but only {agreeing} with odometry"
        )


def _marked(choice: Choice, among: np.ndarray, count: int) -> Bool[np.ndarray, " m"]:
    members = np.zeros(count, bool)
    members[among] = choice.members
    return members
