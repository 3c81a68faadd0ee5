"""Triage: where nearly every closure is rejected, which usual mistake would explain them.

Each mistake is undone and the closures are weighed again. It is named if with it most closures
agree, and more than twice as many as they do as read:

    agreeing ≥ 5,    agreeing ≥ half of all,    agreeing > 2 · as read

Half of all is far beyond what tries by the dozen find by chance, and what clutter leaves of right
closures is not mistaken for a mistake: of 200 simulated worlds of either group (with up to five
false closures for a right one, or none right; `benchmarks.silence`) it names one in none.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.clique import maximum_clique
from pcm_jax.consistency import Evidence, PairEvidence
from pcm_jax.graph import LoopClosures
from pcm_jax.integrity._loops import Loops
from pcm_jax.integrity._mistakes import mistakes
from pcm_jax.integrity._screen import SLACK, Screen, at_most
from pcm_jax.integrity._solved_mistakes import in_degrees, may_have_extrinsic, with_extrinsic

FEWEST = 5
"""Closures that must agree."""
SAMPLE = 40
"""Closures of a pair of robots that are tried, evenly spaced."""
PAIRS = 4
"""Pairs of robots that are tried, those with the most closures."""
ABOUT = 0.9
"""Of the most that agree: mistakes that explain as many are about as likely."""
SEARCH = 1.0
"""Seconds for the largest set of each try."""


@dataclass(frozen=True, repr=False)
class Finding:
    """The mistake that explains why closures were rejected.

    Attributes:
        mistake: its name.
        words: what was meant, to be read after "if".
        agreeing: closures that agree with it undone.
        of: closures that were tried.
        as_read: how many of them agree as they were read.
        also: names of other mistakes that explain about as many.
        extrinsic: Lie, where the sensor sits on its robot; None for other mistakes.
    """

    mistake: str
    words: str
    agreeing: int
    of: int
    as_read: int
    also: tuple[str, ...] = ()
    extrinsic: Any = None

    @property
    def sentence(self) -> str:
        """The finding in plain words."""
        also = f"; as likely: {', '.join(self.also)}" if self.also else ""
        return (
            f"{self.mistake}: {self.agreeing} of {self.of} closures agree if {self.words},"
            f" {self.as_read} as read{also}"
        )

    def __repr__(self) -> str:
        return f"Finding({self.sentence})"


@on_host
def triage(evidence: Evidence, gate: float) -> Finding | None:
    """Looks for the usual mistake that explains closures which do not agree.

        selection = pcm_jax.select(graph)
        if selection.accepted.mean() < 0.2:
            print(pcm_jax.integrity.triage(selection.evidence, selection.gate))

    Args:
        evidence: of `weigh`; its metric plays no part.
        gate: γ².

    Returns:
        The mistake with which most closures agree, the most usual of those with which about as many
        do; None where none explains half of them.

    Raises:
        InputError: for a singular map.
    """
    tried = sorted(evidence.pairs, key=len, reverse=True)[:PAIRS]
    samples = [_Sample(pair, gate) for pair in tried]
    of = sum(len(sample.closures) for sample in samples)
    as_read = sum(sample.as_read for sample in samples)
    enough = max(FEWEST, 2 * as_read + 1, (of + 1) // 2)
    if of < enough:
        return None
    found = _known(evidence.graph.group, samples, as_read, enough)
    if max((one.agreeing for one in found), default=0) < enough:
        found = list(_solved(samples[0], enough))
    most = max((one.agreeing for one in found), default=0)
    if most < enough:
        return None
    likely = [one for one in found if one.agreeing >= max(enough, ABOUT * most)]
    others = dict.fromkeys(one.mistake for one in likely if one.mistake != likely[0].mistake)
    return dataclasses.replace(likely[0], also=tuple(others))


class _Sample:
    """Some closures of a pair of robots, and how many agree by any reading of them."""

    def __init__(self, pair: PairEvidence, gate: float):
        given: LoopClosures = pair.measured  # type: ignore[assignment]
        chosen = np.linspace(0, len(given) - 1, min(SAMPLE, len(given))).round().astype(int)
        rows = np.arange(len(chosen), dtype=np.float64)
        self.closures = dataclasses.replace(given[chosen], weight=rows)
        self.pair, self.gate = pair, gate
        self.maps: Any = pair.maps
        self.screen = Screen(pair.covariances, self.closures)
        (graph,) = self.graphs([self.closures])
        self.as_read = _largest(graph)

    def graphs(self, readings: list[LoopClosures]) -> list[Bool[np.ndarray, "n n"]]:
        """The pairs that agree of each reading, or where its poses are others, that may."""
        kept = [np.asarray(one.weight).astype(int) for one in readings]
        return self.screen.agreeing(list(zip(readings, kept, strict=True)), self.gate)

    def may_agree(self, reading: LoopClosures) -> int:
        """A bound on how many would agree if a reading of the same poses were a little better."""
        (graph,) = self.screen.agreeing([(reading, np.arange(len(reading)))], SLACK * self.gate)
        return at_most(graph)

    def agreeing(self, reading: LoopClosures, graph: Bool[np.ndarray, "n n"]) -> int:
        """The size of the largest set that agrees, of a reading and what the screen found."""
        if not self.screen.touches_the_same(reading) and len(reading):
            rows = np.arange(len(reading))
            loops = Loops(self.pair.covariances, reading)  # type: ignore[arg-type]
            graph = (loops.squared(rows, rows) <= self.gate) & ~np.eye(len(rows), dtype=bool)
        return _largest(graph)


def _largest(graph: Bool[np.ndarray, "n n"]) -> int:
    return int(maximum_clique(graph, time_limit=SEARCH).size) if len(graph) else 0


def _known(group: Any, samples: list[_Sample], as_read: int, enough: int) -> list[Finding]:
    """The mistakes with nothing unknown in them by which enough closures agree."""
    known = list(mistakes(group))
    of = sum(len(sample.closures) for sample in samples)
    undone = [[one.undo(sample.maps, sample.closures) for one in known] for sample in samples]
    graphs = [sample.graphs(own) for sample, own in zip(samples, undone, strict=True)]
    found = []
    for k, one in enumerate(known):
        if sum(at_most(own[k]) for own in graphs) < enough:
            continue
        each = zip(samples, undone, graphs, strict=True)
        agreeing = sum(sample.agreeing(own[k], graph[k]) for sample, own, graph in each)
        found.append(Finding(one.name, one.words, agreeing, of, as_read))
    return found


def _solved(sample: _Sample, enough: int) -> Iterator[Finding]:
    """Mistakes with something unknown, by the pair of robots with the most closures alone."""
    closures, as_read, of = sample.closures, sample.as_read, len(sample.closures)
    if lie.tangent_dim(closures.group) == 3:
        read = list(in_degrees(sample.maps, closures))
        graphs = [graph for graph in sample.graphs(read) if at_most(graph) >= enough]
        most = max(map(_largest, graphs), default=0)
        yield Finding("degrees", "angles are in degrees", most, of, as_read)
    if not may_have_extrinsic(sample.maps, closures, enough):
        return
    extrinsic, own = with_extrinsic(
        sample.pair.covariances, closures, lambda first: sample.may_agree(first) >= enough
    )
    words = f"a sensor sits at {_pose(extrinsic)} on its robot"
    (graph,) = sample.graphs([own])
    yield Finding("extrinsic left out", words, _largest(graph), of, as_read, extrinsic=extrinsic)


def _pose(extrinsic: Any) -> str:
    tangent = np.asarray(lie.log(extrinsic))
    space = 2 if len(tangent) == 3 else 3
    place = ", ".join(f"{value:.2f}" for value in np.asarray(lie.translation(extrinsic)))
    turned = ", ".join(f"{value:.0f}" for value in np.degrees(tangent[space:]))
    return f"({place}) m, turned by ({turned})°"
