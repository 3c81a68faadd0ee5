"""Sets of vertices as Python integers: one bit a vertex, set algebra in single operations.

A vertex is named by a *label* 1..n; label l is bit l - 1, so that `bits.bit_length()` is the
largest label in the set (the one cheap way to find a member) and 0 is "none". Lists indexed by
label have an unused entry at 0.
"""

from __future__ import annotations

from time import perf_counter

import numpy as np
from jaxtyping import Bool, Int

# Rows gathered and packed at a time: the clock is read between them.
_ROWS = 128


def neighbour_sets(
    adjacency: Bool[np.ndarray, "m m"],
    vertices: Int[np.ndarray, " n"],
    *,
    deadline: float = np.inf,
) -> list[int]:
    """The neighbours, among some vertices, of each of them, as sets.

    Args:
        adjacency: of the whole graph.
        vertices: those considered; vertex `vertices[v]` has the label v + 1.
        deadline: reading of `time.perf_counter` at which to give up.

    Raises:
        TimeoutError: at the deadline.
    """
    sets = [0]
    for start in range(0, len(vertices), _ROWS):
        if perf_counter() > deadline:
            raise TimeoutError
        rows = adjacency[vertices[start : start + _ROWS]].take(vertices, axis=1)
        packed = np.packbits(rows, axis=1, bitorder="little")
        sets += [int.from_bytes(row.tobytes(), "little") for row in packed]
    return sets
