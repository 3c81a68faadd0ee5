"""GTSAM's symbol keys: `letter << 56 | index`, which name a robot and one of its poses.

Keys exceed 2^62 and would lose digits as float64; everything here is int64.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

INDEX_BITS = 56
INDEX_LIMIT = 1 << INDEX_BITS
FIRST_LETTER, LAST_LETTER = 0x21, 0x7E  # printable ASCII, without the space


def letters_of(ids: Int[np.ndarray, " *n"]) -> Int[np.ndarray, " *n"]:
    """int64 `[n]`: the top byte of each id where that is a printable letter, else 0."""
    top = ids >> INDEX_BITS
    return np.where((top >= FIRST_LETTER) & (top <= LAST_LETTER), top, 0)


def are_symbols(ids: Int[np.ndarray, " n"]) -> bool:
    """True if there are ids and every one of them is a symbol key."""
    return bool(len(ids)) and bool((letters_of(ids) > 0).all())


def indices_of(ids: Int[np.ndarray, " *n"]) -> Int[np.ndarray, " *n"]:
    """int64 `[n]`: each symbol key's index; ids that are no symbols unchanged."""
    return np.where(letters_of(ids) > 0, ids & (INDEX_LIMIT - 1), ids)


def keys(letter: str, indices: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """int64 `[n]`: the keys of one letter's indices, each in 0 … 2^56 − 1."""
    return (np.int64(ord(letter)) << np.int64(INDEX_BITS)) | indices.astype(np.int64)
