"""Squared distances that tell equally good cliques apart: checked, and gathered when needed."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from pcm_jax.arrays import as_numbers
from pcm_jax.errors import InputError

# Rows looked at between two readings of the clock; tiles compared with their transposes.
_TILE = 256


def checked_squared(
    tie_break: Any,
    adjacency: Bool[np.ndarray, "m m"],
    *,
    least: float = -np.inf,
    deadline: float = np.inf,
) -> Num[np.ndarray, "m m"]:
    """The squared distances, as they are.

    Args:
        tie_break: [m, m], of which only entries on edges count.
        adjacency: bool [m, m].
        least: no entry may be smaller.
        deadline: reading of `time.perf_counter` after which no more of them are looked at.

    Raises:
        InputError: another shape, or an entry on an edge that is not finite or too small.
    """
    squared = as_numbers(tie_break, "tie_break")
    if squared.shape != adjacency.shape:
        raise InputError(
            f"tie_break: shape {squared.shape}, expected that of the graph, {adjacency.shape}"
        )
    for start in range(0, len(squared), _TILE):
        if perf_counter() > deadline:
            break
        rows = squared[start : start + _TILE]
        # One pass each, and none leaves an array behind.
        if -np.inf < rows.min() >= least and rows.max() < np.inf:
            continue
        wrong = adjacency[start : start + _TILE] & ~(np.isfinite(rows) & (rows >= least))
        if wrong.any():
            i, j = np.argwhere(wrong)[0]
            if np.isfinite(rows[i, j]):
                fault = f"is {rows[i, j]:g}, expected at least {least:g} with weights"
            else:
                fault = "is not finite, expected a number on every edge"
            raise InputError(f"tie_break: [{i + start}, {j}] {fault}")
    return squared


def symmetric_costs(
    squared: Num[np.ndarray, "m m"],
    vertices: Int[np.ndarray, " n"],
    *,
    deadline: float = np.inf,
) -> Float[np.ndarray, "n n"]:
    """The larger of the two directions, of the pairs of some vertices, in their order.

    Raises:
        TimeoutError: at the deadline, a reading of `time.perf_counter`.
    """
    costs = np.empty((len(vertices), len(vertices)))
    tiles = [slice(start, start + _TILE) for start in range(0, len(vertices), _TILE)]
    for position, rows in enumerate(tiles):
        if perf_counter() > deadline:
            raise TimeoutError
        costs[rows] = squared[vertices[rows]].take(vertices, axis=1)
        for columns in tiles[: position + 1]:
            larger = np.maximum(costs[rows, columns], costs[columns, rows].T)
            costs[rows, columns] = larger
            costs[columns, rows] = larger.T
    return costs
