"""Places: closures that lie beside each other along the way, in both maps, are one witness.

A front end that takes one corridor for another says so at every frame on the way through it. Such
closures agree, whatever is true, since their loop is short and tests next to nothing. So a set of
closures is worth as many witnesses as it has members of which no two lie within a *separation* s of
each other along the way of both robots: its places,

    places(C) = max { |S| : S ⊆ C, and for u ≠ v in S  |w_a(u) − w_a(v)| > s  or
                      |w_b(u) − w_b(v)| > s }

with w the metres that a robot has gone when it comes to a closure's pose.

How far a mistake repeats itself is a property of the front end and of the world, which the closures
themselves show: those that agree with no member of the set in question are mistakes if the set is
right. Their *runs* are chains of closures of which each agrees with the next, a few steps further
along both ways. By default s is the length of the longest run, along the way on which it is longer;
0 where mistakes do not repeat: then only closures of one and the same pose pair are one witness.
If the set is wrong, and the right closures are among those that it contradicts, their runs count:
a set in one place is then not told from them, as it should not be. What the default cannot see is a
front end whose one repeated mistake is the set itself: give `separation`, the length of what looks
alike in that world, where that is to be feared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.consistency import PairEvidence
from pcm_jax.errors import InputError
from pcm_jax.graph import PoseGraph
from pcm_jax.graph.spanning_tree import connected_parts

REACH = 5.0
"""Steps of the map from a closure of a run to the next, at most."""


@dataclass(frozen=True, eq=False, repr=False)
class Places:
    """The places of the k closures between two robots along the ways of both.

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

    def spread_out(
        self, order: Int[np.ndarray, " c"], most: float = np.inf
    ) -> Int[np.ndarray, " p"]:
        """Takes closures one after another, each that is apart from all those taken before.

        Args:
            order: in which they are looked at.
            most: with so many it ends.
        """
        taken = np.zeros(0, np.int64)
        for closure in order:
            if len(taken) >= most:
                break
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

    def reach(self, accepted: Bool[np.ndarray, " k"]) -> float:
        """Measures how far some closures lie apart along the way on which they do most, metres."""
        return max(float(np.ptp(way[accepted])) for way in (self.way_a, self.way_b))


def way_of(pose_graph: PoseGraph) -> Float[np.ndarray, " n"]:
    """Measures the way to every pose of a map, from pose to pose in their order.

    Args:
        pose_graph: poses in the order of time.

    Returns:
        Metres; 0 at the first pose.
    """
    steps = np.diff(lie.translation(lie.as_numpy(pose_graph.poses)), axis=0)
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])


def places_of(
    evidence: PairEvidence,
    separation: float | None = None,
    *,
    gate: float | None = None,
    members: Bool[np.ndarray, " k"] | None = None,
) -> Places:
    """Places the closures between two robots on the ways of both.

        pair = selection.pairs[0]
        places = pcm_jax.integrity.places_of(pair.evidence, gate=pair.gate, members=pair.accepted)
        places.count(pair.accepted)

    Args:
        evidence: see `weigh`.
        separation: metres between two witnesses along either way. By default the longest run of
            closures that agree with each other and with no member.
        gate: γ², for that.
        members: bool [k], the set in question, for that.

    Raises:
        InputError: for evidence without closures, a separation that is not a number of at least 0,
            neither a separation nor a gate and members.
    """
    if evidence.measured is None or evidence.maps is None:
        raise InputError("evidence: distances alone given, expected closures between two maps")
    if separation is None and (gate is None or members is None):
        raise InputError("separation: None, expected metres, or the gate and the members of a set")
    if separation is not None and not separation >= 0.0:
        raise InputError(f"separation: {separation}, expected metres, at least 0")
    touched = evidence.measured.pose_a, evidence.measured.pose_b
    full = [way_of(one) for one in evidence.maps]
    way_a, way_b = (way[np.asarray(poses)] for way, poses in zip(full, touched, strict=True))
    if separation is None:
        steps = [float(way[-1]) / max(1, len(way) - 1) for way in full]
        separation = longest_run(evidence, gate, members, (way_a, way_b), steps)  # type: ignore[arg-type]
    return Places(way_a, way_b, float(separation))


def longest_run(
    evidence: PairEvidence,
    gate: float,
    members: Bool[np.ndarray, " k"],
    ways: tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]],
    steps: Sequence[float],
) -> float:
    """Measures the longest run of closures that agree with each other and with no member, metres.

    Args:
        evidence: of the k closures.
        gate: γ².
        members: of the set that they contradict.
        ways: of the closures' poses in map a and map b.
        steps: of the two maps, metres from a pose to the next, on average.
    """
    graph = evidence.packed(gate)
    others = np.flatnonzero(~members & ~graph.touches(np.flatnonzero(members)))
    others = others[np.argsort(ways[0][others], kind="stable")]
    way_a, way_b = (way[others] for way in ways)
    u, v = _within(way_a, REACH * steps[0])
    near = np.abs(way_b[u] - way_b[v]) <= REACH * steps[1]
    u, v = u[near], v[near]
    agree = graph.has(others[u], others[v])
    label = connected_parts(u[agree], v[agree], len(others))[1]
    lengths = (_extents(way, label) for way in (way_a, way_b))
    return float(np.maximum(*lengths).max(initial=0.0))


def _within(way: Float[np.ndarray, " n"], reach: float) -> tuple[np.ndarray, np.ndarray]:
    """All pairs u < v of an ascending way that lie within reach of each other."""
    first = np.arange(len(way)) + 1
    count = np.searchsorted(way, way + reach, side="right") - first
    u = np.repeat(first - 1, count)
    offset = np.arange(len(u)) - np.repeat(np.cumsum(count) - count, count)
    return u, u + 1 + offset


def _extents(way: Float[np.ndarray, " n"], label: Int[np.ndarray, " n"]) -> np.ndarray:
    """From the first to the last of each label."""
    count = 1 + int(label.max(initial=-1))
    first, last = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(first, label, way)
    np.maximum.at(last, label, way)
    return last - first


def _span(way: Float[np.ndarray, " k"]) -> str:
    return f"{way.min():.4g} to {way.max():.4g} m" if len(way) else "no part"
