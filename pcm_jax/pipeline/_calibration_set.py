"""The closures that a calibration goes by: those that agree, and under its factors those that fit.

Factors are found from closures that a gate chose, and a gate chooses by factors. Two gates do it:

    the largest set     pairs that agree (`consistency`). It finds where two maps lie to each other,
                        whatever is false; but of right closures it leaves out more than its gate
                        says, the more of them there are: all pairs must pass. What it holds has too
                        small errors, by a law that depends on how many they are.
    one by one          closure u in the map of all the others, by the covariance of both: q²_u is
                        chi-squared with d degrees of freedom, cut off at the gate. That law is
                        known, so that what is cut off is made up for (`variance_components`).

So the first gate finds the map, under the stated errors or wider ones; the second, under the
factors found by then, says by which closures the next factors are found; again until they stay. It
is the wider of the two, of a tenth of the right closures that the first one misses.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from pcm_jax.consistency import Evidence, PairEvidence, chi2_gate
from pcm_jax.graph import MultiRobotGraph, PoseGraph
from pcm_jax.integrity import SIGNIFICANCE, chance_level, places_of
from pcm_jax.integrity.calibration import closing_edges
from pcm_jax.integrity.variance_components import Part
from pcm_jax.merging.alignment import aligned_anchors
from pcm_jax.merging.consensus import fitting_edges
from pcm_jax.merging.groups import closures_within, robot_groups
from pcm_jax.merging.joint import joint_graph
from pcm_jax.pipeline.weigh import weigh
from pcm_jax.selection import choose

WIDER = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Times the stated deviations, for closures of which few agree as stated."""
MORE, KEPT = 1.5, 0.9
"""A wider gate is taken if it lets so many times more agree, and keeps so many of those before. At
the first that is not, gates are wide enough: of yet wider ones false closures would agree."""
LIMIT = 5.0
"""Seconds for a clique."""
MISSED = 0.1
"""Of what the gate of pairs misses, what that of single closures misses."""


@dataclass(frozen=True)
class CalibrationSet:
    """The edges that a calibration goes by.

    Attributes:
        inside: for each map bool [e], its edges that hold.
        between: bool [m], closures between robots.
        cleaned: for each map, whether a gate chose its closures.
        chosen: whether a gate chose those between robots.
        wider: times the deviations, under which the largest set agrees.
        gate: γ² that chosen closures passed, under the deviations that they were chosen by.
    """

    inside: tuple[Bool[np.ndarray, " e"], ...]
    between: Bool[np.ndarray, " m"]
    cleaned: tuple[bool, ...]
    chosen: bool
    wider: float
    gate: float

    @property
    def gated(self) -> bool:
        """True where a gate chose any closure."""
        return any(self.cleaned) or (self.chosen and bool(self.between.any()))

    def same_as(self, other: CalibrationSet) -> bool:
        """True for the same edges, chosen by the same gate."""
        masks = zip((*self.inside, self.between), (*other.inside, other.between), strict=True)
        return self.gate == other.gate and all((a == b).all() for a, b in masks)

    def maps(self, graph: MultiRobotGraph) -> MultiRobotGraph:
        """The maps without the edges that do not hold."""
        kept = zip(graph.maps, self.inside, strict=True)
        return dataclasses.replace(graph, maps=tuple(one.with_edges(held) for one, held in kept))


def agreeing(
    graph: MultiRobotGraph, start: CalibrationSet, evidence: Evidence | None, seed: int
) -> CalibrationSet:
    """Chooses the closures between robots that agree, under wider gates if these let more agree.

    Args:
        graph: maps at their optima.
        start: the maps' own edges, the gate.
        evidence: of the maps, if it is known.
        seed: of what chance draws.
    """
    best = start
    if not len(graph.closures):
        return best
    pairs = (evidence or weigh(start.maps(graph))).pairs
    for wider in WIDER:
        accepted = best.between.copy()
        for pair in pairs:
            members = _largest(pair, start.gate * wider**2)
            before = accepted[pair.closures]
            more = members.sum() > MORE * before.sum()
            kept = (members & before).sum() >= KEPT * before.sum()
            if more and kept and _beyond_chance(pair, start.gate * wider**2, members, seed):
                accepted[pair.closures] = members
        if best.between.any() and accepted.sum() <= MORE * best.between.sum():
            break
        found = {"between": accepted, "wider": wider, "chosen": bool(accepted.any())}
        best = dataclasses.replace(best, **found)
    return dataclasses.replace(best, gate=start.gate * best.wider**2)


def agreeing_again(
    graph: MultiRobotGraph, before: CalibrationSet, confidence: float
) -> CalibrationSet:
    """Chooses the largest set between robots that had one, under other deviations.

    Args:
        graph: information times the factors found so far.
        before: what these were found from.
        confidence: of the gate of pairs.
    """
    if not (before.chosen and before.between.any()):
        return before
    gate = float(chi2_gate(confidence, graph.tangent_dim))
    between = np.zeros_like(before.between)
    for pair in weigh(before.maps(graph)).pairs:
        if before.between[pair.closures].any():
            between[pair.closures] = _largest(pair, gate)
    return dataclasses.replace(before, between=between, gate=gate)


def fitting(graph: MultiRobotGraph, start: CalibrationSet, confidence: float) -> CalibrationSet:
    """Chooses one by one the closures that fit the map of all the others.

    Args:
        graph: information times the factors found so far.
        start: the edges that make the first map; those that no gate chose stay.
        confidence: of the gate of pairs.
    """
    gate = float(chi2_gate(1.0 - MISSED * (1.0 - confidence), graph.tangent_dim))
    inside, between = [mask.copy() for mask in start.inside], start.between.copy()
    for group in _groups(graph, start.between):
        whole, held, asked = _group_edges(graph, start, group)
        if asked.any():
            held = fitting_edges(whole, held, np.flatnonzero(asked), gate)
        edges = 0
        for robot in group.members:
            inside[robot] = held[edges : edges + graph.maps[robot].num_edges]
            edges += graph.maps[robot].num_edges
        between[group.closures] = held[edges:]
    return dataclasses.replace(start, inside=tuple(inside), between=between, gate=gate)


def parts_of(graph: MultiRobotGraph, chosen: CalibrationSet) -> list[Part]:
    """The maps of connected robots, each as one graph of the edges that hold."""
    parts = []
    for group in _groups(graph, chosen.between):
        whole, held, gated = _group_edges(graph, chosen, group)
        inside = [closing_edges(graph.maps[robot]) for robot in group.members]
        closing = np.concatenate([*inside, np.ones(len(group.closures), bool)])
        parts.append(Part(whole.with_edges(held), closing[held], gated[held]))
    return parts


@dataclass(frozen=True)
class _Group:
    """Robots that closures join, indices of all closures between them, and where maps lie."""

    members: tuple[int, ...]
    closures: np.ndarray
    anchors: object


def _groups(graph: MultiRobotGraph, between: np.ndarray) -> list[_Group]:
    groups = robot_groups(len(graph.maps), graph.closures, between)
    anchors = aligned_anchors(graph, between, groups)
    every = np.ones_like(between)
    return [
        _Group(members, closures_within(members, graph.closures, every), anchors)
        for members in groups
    ]


def _group_edges(
    graph: MultiRobotGraph, chosen: CalibrationSet, group: _Group
) -> tuple[PoseGraph, np.ndarray, np.ndarray]:
    """All edges of a group as one graph; which hold; which a gate chooses."""
    whole = joint_graph(graph, group.members, group.closures, group.anchors)
    held = [chosen.inside[robot] for robot in group.members] + [chosen.between[group.closures]]
    gated = [
        closing_edges(graph.maps[robot]) & chosen.cleaned[robot] for robot in group.members
    ] + [np.full(len(group.closures), chosen.chosen)]
    return whole, np.concatenate(held), np.concatenate(gated)


def _largest(pair: PairEvidence, gate: float) -> Bool[np.ndarray, " k"]:
    return choose(pair, gate, time_limit=LIMIT).members


def _beyond_chance(pair: PairEvidence, gate: float, members: np.ndarray, seed: int) -> bool:
    places = places_of(pair, gate=gate, members=members)
    return chance_level(pair, gate, places, members, seed=seed).p_value <= SIGNIFICANCE
