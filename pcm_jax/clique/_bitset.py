"""Sets of vertices as Python integers: one bit a vertex, set algebra in single operations.

A vertex is named by a *label* 1..n; label l is bit l - 1, so that `bits.bit_length()` is the
largest label in the set (the one cheap way to find a member) and 0 is "none". Lists indexed by
label have an unused entry at 0.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool


def neighbour_sets(adjacency: Bool[np.ndarray, "n n"]) -> list[int]:
    """The neighbours of every label, as sets; vertex v of the matrix has the label v + 1."""
    packed = np.packbits(adjacency, axis=1, bitorder="little")
    width = packed.shape[1]
    raw = packed.tobytes()
    rows = (raw[start : start + width] for start in range(0, len(raw), width or 1))
    return [0, *(int.from_bytes(row, "little") for row in rows)]
