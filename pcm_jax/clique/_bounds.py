"""Cheap upper bounds on cliques, and the vertices they rule out.

A clique of size s lies in the (s - 1)-core (the largest subgraph in which every degree is at
least s - 1), so no clique is larger than degeneracy + 1; and it takes s colours, so no clique is
larger than any colouring.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int


def degrees(adjacency: Bool[np.ndarray, "n n"]) -> Int[np.ndarray, " n"]:
    """Number of neighbours of every vertex, int64 [n]."""
    packed = np.packbits(adjacency, axis=1)
    return np.bitwise_count(packed).sum(axis=1, dtype=np.int64)


def core(adjacency: Bool[np.ndarray, "n n"], minimum_degree: int) -> Int[np.ndarray, " k"]:
    """The vertices of the largest subgraph with every degree at least `minimum_degree`.

    Returns:
        int64 [k], ascending; every clique of more than `minimum_degree` vertices is inside.
    """
    degree = degrees(adjacency)
    kept = np.ones(len(degree), bool)
    while True:
        removed = np.flatnonzero(kept & (degree < minimum_degree))
        if removed.size == 0:
            return np.flatnonzero(kept)
        kept[removed] = False
        degree -= adjacency[removed].sum(axis=0, dtype=np.int64)


def degeneracy_order(
    adjacency: Bool[np.ndarray, "n n"],
) -> tuple[Int[np.ndarray, " n"], int]:
    """The order in which vertices leave if one of smallest remaining degree leaves at a time.

    Ties go to the smallest index.

    Returns:
        the order, int64 [n], and the degeneracy: the largest degree at leaving.
    """
    degree = degrees(adjacency)
    order = np.empty(len(degree), np.int64)
    degeneracy = 0
    out_of_reach = len(degree)
    for position in range(len(degree)):
        vertex = int(degree.argmin())
        degeneracy = max(degeneracy, int(degree[vertex]))
        order[position] = vertex
        degree -= adjacency[vertex]
        # Rises above every remaining degree, and stays there through later subtractions.
        degree[vertex] = 2 * out_of_reach
    return order, degeneracy
