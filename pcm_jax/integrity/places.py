"""Places: closures that lie beside each other along the way, in both maps, are one witness.

A front end that takes one corridor for another says so at every frame on the way through it. Such
closures agree, whatever is true, since their loop is short and tests next to nothing. So a set of
closures is worth as many witnesses as it has members of which no two lie within a *separation* of
each other along the way of both robots: its places,

    places(C) = max { |S| : S ⊆ C, and for u ≠ v in S  |w_a(u) − w_a(v)| > s  or
                      |w_b(u) − w_b(v)| > s }

with w the metres that a robot has gone when it comes to a closure's pose. The most places that any
consistent set has is the size of a maximum clique once no edge joins closures of one place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.consistency import PairEvidence
from pcm_jax.errors import InputError
from pcm_jax.graph import PoseGraph


SEPARATION = 10.0
"""Metres."""


@dataclass(frozen=True, eq=False, repr=False)
class Places:
    """Where the k closures between two robots lie along the ways of both.

    Attributes:
        way_a: float64 [k], metres that robot a has gone when it comes to each closure's pose.
        way_b: float64 [k], of robot b.
        separation: metres; closures within it of each other on both ways are one witness.
    """

    way_a: Float[np.ndarray, " k"]
    way_b: Float[np.ndarray, " k"]
    separation: float

    def __repr__(self) -> str:
        return (
            f"Places({len(self.way_a)} closures, {self.count()} places)\n"
            f"  ways        {_span(self.way_a)} of robot a, {_span(self.way_b)} of robot b\n"
            f"  separation  {self.separation:.4g} m"
        )

    def apart(self, chosen: Int[np.ndarray, " c"] | None = None) -> Bool[np.ndarray, "c c"]:
        """Marks the pairs of some closures (all, by default) that are two witnesses."""
        some = slice(None) if chosen is None else chosen
        far = (np.abs(way[some, None] - way[some]) for way in (self.way_a, self.way_b))
        return np.maximum(*far) > self.separation

    def spread_out(self, order: Int[np.ndarray, " c"]) -> Int[np.ndarray, " p"]:
        """Takes closures one after another, each that is apart from all those taken before."""
        taken = np.zeros(0, np.int64)
        for closure in order:
            far_a = np.abs(self.way_a[taken] - self.way_a[closure]) > self.separation
            far_b = np.abs(self.way_b[taken] - self.way_b[closure]) > self.separation
            if (far_a | far_b).all():
                taken = np.append(taken, closure)
        return taken

    def count(self, accepted: Bool[np.ndarray, " k"] | None = None) -> int:
        """Counts the places of some closures (of all, by default), greedily along robot a's way.

        Args:
            accepted: bool [k].
        """
        chosen = np.arange(len(self.way_a)) if accepted is None else np.flatnonzero(accepted)
        return len(self.spread_out(chosen[np.lexsort((self.way_b[chosen], self.way_a[chosen]))]))


def way_of(pose_graph: PoseGraph) -> Float[np.ndarray, " n"]:
    """Measures the way to every pose of a map, from pose to pose in their order.

    Args:
        pose_graph: poses in the order of time.

    Returns:
        Metres; 0 at the first pose.
    """
    steps = np.diff(lie.translation(lie.as_numpy(pose_graph.poses)), axis=0)
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])


def places_of(evidence: PairEvidence, separation: float | None = None) -> Places:
    """Places the closures between two robots on the ways of both.

        places = pcm_jax.integrity.places_of(evidence.pairs[0])
        places.count(selection.pairs[0].accepted)

    Args:
        evidence: see `weigh`.
        separation: metres between two witnesses along either way; by default `SEPARATION`.

    Raises:
        InputError: for evidence without closures, a separation that is not a number of at least 0.
    """
    if evidence.measured is None or evidence.maps is None:
        raise InputError("evidence: distances alone given, expected closures between two maps")
    if separation is not None and not separation >= 0.0:
        raise InputError(f"separation: {separation}, expected metres, at least 0")
    ways = (
        way_of(one)[np.asarray(touched)]
        for one, touched in zip(
            evidence.maps, (evidence.measured.pose_a, evidence.measured.pose_b), strict=True
        )
    )
    return Places(*ways, SEPARATION if separation is None else float(separation))


def _span(way: Float[np.ndarray, " k"]) -> str:
    return f"{way.min():.4g} to {way.max():.4g} m" if len(way) else "no part"
