"""`PackedGraph`: a consistency graph of one bit a pair."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int, UInt8


class PackedGraph(NamedTuple):
    """A consistency graph of one bit a pair.

    Attributes:
        bits: uint8 `[m, ⌈m/8⌉]`: closure v is bit 7 − v % 8 of byte v // 8 of row u, as
            `numpy.packbits` has it. Symmetric, the diagonal and what fills the last byte 0.
        count: closures, m.
    """

    bits: UInt8[np.ndarray, "m bytes"]
    count: int

    def __repr__(self) -> str:
        edges = int(self.degree.sum()) // 2
        pairs = max(self.count * (self.count - 1) // 2, 1)
        return (
            f"PackedGraph({self.count} closures)\n"
            f"  agreeing pairs  {edges} ({100.0 * edges / pairs:.3g} %)\n"
            f"  memory          {self.bits.nbytes / 1e6:.3g} MB"
        )

    def dense(self) -> Bool[np.ndarray, "m m"]:
        """As `consistency_graph` returns it; m² bytes."""
        return np.unpackbits(self.bits, axis=1, count=self.count).view(np.bool_)

    def has(self, u: Int[np.ndarray, " p"], v: Int[np.ndarray, " p"]) -> Bool[np.ndarray, " p"]:
        """Marks the pairs that agree."""
        return (self.bits[u, v // 8] >> (7 - v % 8) & 1).astype(bool)

    def touches(self, some: Int[np.ndarray, " s"]) -> Bool[np.ndarray, " m"]:
        """Marks the closures that agree with any of some."""
        any_of_them = np.bitwise_or.reduce(self.bits[some], axis=0)
        return np.unpackbits(any_of_them, count=self.count).view(np.bool_)

    @property
    def degree(self) -> Int[np.ndarray, " m"]:
        """The number of others that each closure agrees with."""
        return np.bitwise_count(self.bits).sum(axis=1, dtype=np.int64)
