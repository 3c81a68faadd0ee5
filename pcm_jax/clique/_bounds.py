"""Cheap upper bounds on cliques, and the vertices they rule out.

A clique of size s lies in the (s - 1)-core (the largest subgraph in which every degree is at
least s - 1), so no clique is larger than degeneracy + 1; and it takes s colours, so no clique is
larger than any colouring. With weights, a clique lies within its members' neighbourhoods, so it
weighs at most what the lightest of these does.
"""

from __future__ import annotations

from time import perf_counter

import numpy as np
from jaxtyping import Bool, Float, Int

# Rows added up at a time: the clock is read between them.
_TILE = 256


def degrees(
    adjacency: Bool[np.ndarray, "n n"], *, deadline: float = np.inf
) -> Int[np.ndarray, " n"]:
    """Number of neighbours of every vertex, int64 [n].

    Args:
        adjacency: bool [n, n].
        deadline: reading of `time.perf_counter` after which no more are counted: the others' are
            given as n - 1, which they do not exceed.
    """
    degree = np.full(len(adjacency), len(adjacency) - 1)
    for start in range(0, len(adjacency), _TILE):
        if perf_counter() > deadline:
            break
        rows = slice(start, start + _TILE)
        packed = np.packbits(adjacency[rows], axis=1)
        degree[rows] = np.bitwise_count(packed).sum(axis=1, dtype=np.int64)
    return degree


def most_members(degree: Int[np.ndarray, " n"]) -> int:
    """The size that no clique of a graph with these degrees exceeds.

    A clique of s members has s vertices of degree s - 1 or more.
    """
    falling = np.sort(degree)[::-1]
    return int(np.count_nonzero(falling >= np.arange(len(degree))))


def neighbourhood_weights(
    adjacency: Bool[np.ndarray, "n n"],
    weights: Float[np.ndarray, " n"],
    *,
    deadline: float = np.inf,
) -> Float[np.ndarray, " n"]:
    """The weight of every vertex together with its neighbours.

    Args:
        adjacency: bool [n, n].
        weights: whole numbers, so that sums are exact in any order.
        deadline: reading of `time.perf_counter` at which to give up.

    Raises:
        TimeoutError: at the deadline.
    """
    sums = np.empty(len(weights))
    for start in range(0, len(weights), _TILE):
        _raise_after(deadline)
        rows = slice(start, start + _TILE)
        sums[rows] = adjacency[rows].astype(np.float64) @ weights
    return sums + weights


def core(
    adjacency: Bool[np.ndarray, "n n"],
    minimum_degree: int,
    degree: Int[np.ndarray, " n"] | None = None,
    *,
    deadline: float = np.inf,
) -> Int[np.ndarray, " k"]:
    """The vertices of the largest subgraph with every degree at least `minimum_degree`.

    Args:
        adjacency: bool [n, n].
        minimum_degree: asked for.
        degree: int64 [n], where it is known.
        deadline: reading of `time.perf_counter` after which no vertex is left out any more.

    Returns:
        int64 [k], ascending; every clique of more than `minimum_degree` vertices is inside.
    """
    ones = np.ones(len(adjacency), np.int64)
    degree = degrees(adjacency) if degree is None else degree
    return _peeled(adjacency, degree, ones, minimum_degree, deadline)


def weighted_core(
    adjacency: Bool[np.ndarray, "n n"],
    weights: Float[np.ndarray, " n"],
    minimum: float,
    *,
    deadline: float = np.inf,
) -> Int[np.ndarray, " k"]:
    """The vertices of the largest subgraph with every neighbourhood of weight at least `minimum`.

    Args:
        adjacency: bool [n, n].
        weights: whole numbers, as in `neighbourhood_weights`.
        minimum: weight asked for of each vertex and its neighbours.
        deadline: as in `core`.

    Returns:
        int64 [k], ascending; every clique of that weight is inside.

    Raises:
        TimeoutError: at the deadline, before any vertex was judged.
    """
    sums = neighbourhood_weights(adjacency, weights, deadline=deadline)
    return _peeled(adjacency, sums, weights, minimum, deadline)


def _peeled(
    adjacency: np.ndarray, sums: np.ndarray, weights: np.ndarray, minimum: float, deadline: float
) -> np.ndarray:
    """Peels off vertices of too small a sum over their neighbours; returns what is left."""
    kept = np.ones(len(sums), bool)
    while True:
        removed = np.flatnonzero(kept & (sums < minimum))
        if removed.size == 0:
            return np.flatnonzero(kept)
        kept[removed] = False
        for start in range(0, len(removed), _TILE):
            if perf_counter() > deadline:
                return np.flatnonzero(kept)
            leaving = removed[start : start + _TILE]
            sums = sums - weights[leaving] @ adjacency[leaving]


def degeneracy_order(
    adjacency: Bool[np.ndarray, "n n"],
    weights: Float[np.ndarray, " n"] | None = None,
    *,
    deadline: float = np.inf,
) -> tuple[Int[np.ndarray, " n"], int]:
    """The order in which vertices leave if one of smallest remaining degree leaves at a time.

    Ties go to the smallest index.

    Args:
        adjacency: bool [n, n].
        weights: whole numbers; given, the weight of a vertex and its remaining neighbours takes
            the place of its degree.
        deadline: reading of `time.perf_counter` at which to give up.

    Returns:
        the order, int64 [n], and the degeneracy: the largest degree (weight) at leaving.

    Raises:
        TimeoutError: at the deadline.
    """
    if weights is None:
        degree = degrees(adjacency, deadline=deadline)
    else:
        degree = neighbourhood_weights(adjacency, weights, deadline=deadline)
    order = np.empty(len(degree), np.int64)
    degeneracy = 0
    # Higher than every degree, and remains so whatever is subtracted later.
    out_of_reach = 2 * len(degree) if weights is None else np.inf
    for position in range(len(degree)):
        _raise_after(deadline)
        vertex = int(degree.argmin())
        degeneracy = max(degeneracy, int(degree[vertex]))
        order[position] = vertex
        near = adjacency[vertex]
        degree -= near if weights is None else near * weights[vertex]
        degree[vertex] = out_of_reach
    return order, degeneracy


def _raise_after(deadline: float) -> None:
    if perf_counter() > deadline:
        raise TimeoutError
