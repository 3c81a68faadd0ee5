"""Padding to a few sizes, so that problems of different sizes share one compilation."""

from __future__ import annotations

from typing import Any

import numpy as np

SMALLEST = 16


def bucket(size: int, *, smallest: int = SMALLEST) -> int:
    """The smallest of `smallest`·{1, 1.5, 2, 3, 4, 6, 8, …} that is at least `size`."""
    upper = smallest
    while upper < size:
        upper *= 2
    return 3 * upper // 4 if size <= 3 * upper // 4 and upper > smallest else upper


def pad_leading(values: Any, size: int) -> np.ndarray:
    """Repeats the last row of `values` until the leading axis has `size` rows (zeros if empty)."""
    values = np.asarray(values)
    missing = size - values.shape[0]
    if missing < 0:
        raise ValueError(f"size: {size} is smaller than the {values.shape[0]} rows given")
    if values.shape[0] == 0:
        return np.zeros((size, *values.shape[1:]), values.dtype)
    return np.concatenate([values, np.repeat(values[-1:], missing, axis=0)])
