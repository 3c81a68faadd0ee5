"""Padding to a few sizes, so that problems of different sizes share one compilation."""

from __future__ import annotations

from typing import Any

import numpy as np

SMALLEST = 16


def bucket(size: int, *, smallest: int = SMALLEST, fine_above: int = 0) -> int:
    """The least of a few sizes that is at least `size`.

    Args:
        size: how many rows are needed.
        smallest: sizes are this, doubled again and again,
        fine_above: and, beyond this size, what lies halfway between (a quarter less padding at
            most, for twice as many compilations).
    """
    upper = smallest
    while upper < size:
        upper *= 2
    halfway = 3 * upper // 4
    return halfway if upper > smallest and size <= halfway and halfway > fine_above else upper


def pad_leading(values: Any, size: int) -> np.ndarray:
    """Repeats the last row of `values` until the leading axis has `size` rows (zeros if empty)."""
    values = np.asarray(values)
    missing = size - values.shape[0]
    if missing < 0:
        raise ValueError(f"size: {size} is smaller than the {values.shape[0]} rows given")
    if values.shape[0] == 0:
        return np.zeros((size, *values.shape[1:]), values.dtype)
    return np.concatenate([values, np.repeat(values[-1:], missing, axis=0)])
