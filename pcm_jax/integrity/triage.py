"""Triage: where nearly every closure is rejected, which usual mistake would explain them.

Each mistake is undone and the closures are weighed again. It is named if with it most closures
agree, and more than twice as many as they do as read:

    agreeing ≥ 5,    agreeing ≥ half of all,    agreeing > 2 · as read

Half of all is far beyond what tries by the dozen find by chance, and what clutter leaves of right
closures is not mistaken for a mistake: of 60 simulated worlds (seeds 0 to 59, with up to five false
closures for a right one, or none right) it names one in none.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.clique import maximum_clique
from pcm_jax.consistency import Evidence, PairEvidence
from pcm_jax.graph import LoopClosures
from pcm_jax.integrity._loops import Loops
from pcm_jax.integrity._mistakes import mistakes
from pcm_jax.integrity._solved_mistakes import in_degrees, with_extrinsic

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
    samples = [(pair, _sample(pair)) for pair in tried]
    of = sum(len(closures) for _, closures in samples)
    as_read = sum(_agreeing(pair, closures, gate) for pair, closures in samples)
    enough = max(FEWEST, 2 * as_read + 1, (of + 1) // 2)
    if of < enough:
        return None
    found = []
    for one in mistakes(evidence.graph.group):
        undone = ((pair, one.undo(pair.maps, own)) for pair, own in samples)  # type: ignore[arg-type]
        agreeing = sum(_agreeing(pair, own, gate) for pair, own in undone)
        found.append(Finding(one.name, one.words, agreeing, of, as_read))
    if max(one.agreeing for one in found) < enough:
        found = list(_solved(samples, gate))
    most = max(one.agreeing for one in found)
    if most < enough:
        return None
    likely = [one for one in found if one.agreeing >= max(enough, ABOUT * most)]
    others = dict.fromkeys(one.mistake for one in likely if one.mistake != likely[0].mistake)
    return dataclasses.replace(likely[0], also=tuple(others))


def _sample(pair: PairEvidence) -> LoopClosures:
    closures: LoopClosures = pair.measured  # type: ignore[assignment]
    if len(closures) <= SAMPLE:
        return closures
    return closures[np.linspace(0, len(closures) - 1, SAMPLE).round().astype(int)]


def _agreeing(pair: PairEvidence, closures: LoopClosures, gate: float) -> int:
    """The size of the largest set of closures that agree."""
    if len(closures) == 0:
        return 0
    rows = np.arange(len(closures))
    squared = Loops(pair.covariances, closures).squared(rows, rows)  # type: ignore[arg-type]
    agrees = (squared <= gate) & ~np.eye(len(rows), dtype=bool)
    return int(maximum_clique(agrees, time_limit=SEARCH).size)


def _solved(samples: list[tuple[PairEvidence, LoopClosures]], gate: float) -> Iterator[Finding]:
    """Mistakes with something unknown, by the pair of robots with the most closures alone."""
    pair, closures = samples[0]
    maps: Any = pair.maps
    of = len(closures)
    as_read = _agreeing(pair, closures, gate)
    if lie.tangent_dim(closures.group) == 3:
        sizes = [_agreeing(pair, own, gate) for own in in_degrees(maps, closures)]
        yield Finding("degrees", "angles are in degrees", max(sizes), of, as_read)
    extrinsic, own = with_extrinsic(pair.covariances, closures)
    words = f"a sensor sits at {_pose(extrinsic)} on its robot"
    agreeing = _agreeing(pair, own, gate)
    yield Finding("extrinsic left out", words, agreeing, of, as_read, extrinsic=extrinsic)


def _pose(extrinsic: Any) -> str:
    tangent = np.asarray(lie.log(extrinsic))
    space = 2 if len(tangent) == 3 else 3
    place = ", ".join(f"{value:.2f}" for value in np.asarray(lie.translation(extrinsic)))
    turned = ", ".join(f"{value:.0f}" for value in np.degrees(tangent[space:]))
    return f"({place}) m, turned by ({turned})°"
