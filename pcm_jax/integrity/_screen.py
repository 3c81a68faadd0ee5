"""A first look at many readings of the same closures: can as many agree as would be told?

The maps' part in a loop's covariance (`_loops`: G of two poses) depends on the poses alone. It is
found once for closures as they were read. Readings that touch the same poses are then weighed
exactly; those that touch poses a few steps on nearly so, and by a gate that is wider for it. All
readings are weighed at once, since a call costs more than its numbers.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from pcm_jax import lie
from pcm_jax.graph import LoopClosures
from pcm_jax.graph.unsaid import held
from pcm_jax.integrity._loops import Loops, form
from pcm_jax.integrity._mistakes import FARTHEST

SLACK = 9.0
"""Times the gate, three times the deviation: where poses are a few steps on, pairs may agree."""
MOST = 200_000
"""Pairs that are weighed at once."""


class Screen:
    """Closures as they were read, and how far the maps let the poses that they touch be apart.

    Args:
        covariances: a `MapCovariance` of map a and of map b.
        closures: `[k]`, all from a to b.
    """

    def __init__(self, covariances: Any, closures: LoopClosures):
        self._frames = tuple(covariance.frame for covariance in covariances)
        self._read = closures
        self._apart = Loops(covariances, closures).of_maps()

    def touches_the_same(self, reading: LoopClosures) -> bool:
        """True where a reading has the same closures between the same poses."""
        return len(reading) == len(self._read) and all(
            np.array_equal(getattr(reading, end), getattr(self._read, end))
            for end in ("pose_a", "pose_b")
        )

    def agreeing(
        self, readings: list[tuple[LoopClosures, np.ndarray]], gate: float
    ) -> list[Bool[np.ndarray, "n n"]]:
        """The pairs that agree, of each reading with the rows of its closures among those read.

        Of a reading with poses elsewhere nothing is known: all its pairs may agree.
        """
        found, batch, held_back = [], [], 0
        for reading in readings:
            batch.append(reading)
            held_back += len(reading[1]) ** 2
            if held_back > MOST:
                found += self._weighed(batch, gate)
                batch, held_back = [], 0
        return found + (self._weighed(batch, gate) if batch else [])

    def _weighed(
        self, readings: list[tuple[LoopClosures, np.ndarray]], gate: float
    ) -> list[Bool[np.ndarray, "n n"]]:
        sizes = [len(rows) for _, rows in readings]
        first = np.cumsum(sizes) - sizes
        u, v = (
            np.concatenate(
                [np.triu_indices(size, 1)[end] + at for size, at in zip(sizes, first, strict=True)]
            )
            for end in (0, 1)
        )
        rows = np.concatenate([own for _, own in readings])
        given = [one for one, _ in readings]
        gates = np.array([gate * self._slack(*reading) for reading in readings])
        limits = np.repeat(gates, [size * (size - 1) // 2 for size in sizes])
        inside = self._squared(given, rows, u, v) <= limits
        graphs = []
        for size, at in zip(sizes, first, strict=True):
            mine = slice(*np.searchsorted(u, [at, at + size]))
            graph = np.zeros((size, size), bool)
            graph[u[mine] - at, v[mine] - at] = inside[mine]
            graphs.append(graph | graph.T)
        return graphs

    def _slack(self, reading: LoopClosures, rows: Any) -> float:
        """The factor of the gate: 1 for the same poses, infinite for those elsewhere."""
        if self.touches_the_same(reading):
            return 1.0
        steps = (
            np.abs(np.asarray(getattr(reading, end)) - np.asarray(getattr(self._read, end))[rows])
            for end in ("pose_a", "pose_b")
        )
        return SLACK if max(far.max(initial=0) for far in steps) <= FARTHEST else np.inf

    def _squared(
        self, readings: list[LoopClosures], rows: Any, u: Any, v: Any
    ) -> Float[np.ndarray, " p"]:
        """The larger of q²_uv and q²_vu of pairs among all readings, one behind another."""
        pose_a, pose_b, information = (
            np.concatenate([np.asarray(getattr(one, name)) for one in readings])
            for name in ("pose_a", "pose_b", "information")
        )
        measured = lie.concatenate([lie.as_numpy(one.measurement) for one in readings])
        reached = lie.compose(lie.take(self._frames[0], pose_a), measured)
        placed = lie.compose(reached, lie.inverse(lie.take(self._frames[1], pose_b)))
        turn = np.asarray(lie.adjoint(reached))
        noise = turn @ np.linalg.inv(held(information)) @ turn.swapaxes(1, 2)
        t_u, t_v = lie.take(placed, u), lie.take(placed, v)
        error = np.asarray(lie.log(lie.compose(t_v, lie.inverse(t_u))))
        of_a, of_b = (apart[rows[u], rows[v]] for apart in self._apart)
        still = of_a + noise[u] + noise[v]
        larger = np.zeros(len(u))
        for way in (t_v, t_u):
            adjoint = np.asarray(lie.adjoint(way))
            total = still + adjoint @ of_b @ adjoint.swapaxes(1, 2)
            larger = np.maximum(larger, form(total, error))
        return larger


def at_most(graph: Bool[np.ndarray, "n n"]) -> int:
    """A bound on the largest set in which all agree: so many have so many neighbours."""
    degrees = np.sort(graph.sum(axis=1))[::-1] + 1
    return int(np.max(np.minimum(degrees, np.arange(1, len(degrees) + 1)), initial=0))
