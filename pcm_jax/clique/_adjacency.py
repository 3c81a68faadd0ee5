"""Graphs as the clique algorithms take them, checked once at the entrance."""

from __future__ import annotations

from time import perf_counter
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Array, Bool, Int

from pcm_jax.arrays import as_array
from pcm_jax.errors import InputError

if TYPE_CHECKING:
    import networkx

# Rows compared with columns at a time: a tile and its transpose stay in the second-level cache.
_TILE = 512


def adjacency_matrix(
    graph: Bool[np.ndarray, "m m"] | Bool[Array, "m m"] | networkx.Graph,
    *,
    deadline: float = np.inf,
) -> Bool[np.ndarray, "m m"]:
    """The graph as a symmetric bool matrix with a false diagonal.

    Args:
        graph: bool [m, m], symmetric, diagonal ignored (numbers are accepted if all of them are
            0 or 1); or an undirected `networkx.Graph` with the nodes 0..m-1.
        deadline: reading of `time.perf_counter` after which symmetry is taken for granted.

    Returns:
        bool [m, m]; not to be written to, since it is the one given where that will do.

    Raises:
        InputError: not square, not boolean, not symmetric, or other nodes than 0..m-1.
    """
    if not isinstance(graph, np.ndarray | jax.Array) and hasattr(graph, "adjacency"):
        return _of_networkx(graph)
    values = as_array(graph, "graph")
    if values.size == 0 and values.ndim < 3:
        values = values.reshape(0, 0)
    if values.ndim != 2 or values.shape[0] != values.shape[1]:
        raise InputError(f"graph: shape {values.shape}, expected a square matrix [m, m]")
    adjacency = _as_bool(values)
    if adjacency.diagonal().any():
        adjacency = adjacency.copy() if adjacency is values else adjacency
        np.fill_diagonal(adjacency, False)
    check_symmetric(adjacency, deadline=deadline)
    return adjacency


def induced(
    matrix: Bool[np.ndarray, "m m"], vertices: Int[np.ndarray, " n"], *, deadline: float = np.inf
) -> Bool[np.ndarray, "n n"]:
    """The rows and columns of some vertices, ascending; the matrix itself where these are all.

    Raises:
        TimeoutError: at the deadline, a reading of `time.perf_counter`.
    """
    if len(vertices) == len(matrix):
        return matrix
    inside = np.empty((len(vertices), len(vertices)), matrix.dtype)
    for start in range(0, len(vertices), _TILE):
        if perf_counter() > deadline:
            raise TimeoutError
        rows = slice(start, start + _TILE)
        inside[rows] = matrix[vertices[rows]].take(vertices, axis=1)
    return inside


def _of_networkx(graph: Any) -> np.ndarray:
    size = graph.number_of_nodes()
    if graph.is_directed():
        raise InputError("graph: is directed, expected an undirected networkx.Graph")
    if set(graph.nodes) != set(range(size)):
        stranger = next(node for node in graph.nodes if node not in range(size))
        raise InputError(f"graph: node {stranger!r}, expected the nodes 0..{size - 1}")
    adjacency = np.zeros((size, size), bool)
    if graph.number_of_edges():
        tail, head = np.array(list(graph.edges()), dtype=np.intp).T
        adjacency[tail, head] = adjacency[head, tail] = True
    np.fill_diagonal(adjacency, False)
    return adjacency


def _as_bool(values: np.ndarray) -> np.ndarray:
    if values.dtype == bool:
        return values
    if values.dtype.kind not in "iuf":
        raise InputError(f"graph: dtype {values.dtype}, expected bool")
    neither = (values != 0) & (values != 1)
    if neither.any():
        i, j = np.argwhere(neither)[0]
        raise InputError(f"graph: [{i}, {j}] is {values[i, j]}, expected bool (or 0 and 1)")
    return values != 0


def check_symmetric(adjacency: Bool[np.ndarray, "m m"], *, deadline: float = np.inf) -> None:
    """Compares the matrix with its transpose.

    Args:
        adjacency: bool [m, m].
        deadline: reading of `time.perf_counter` after which nothing more is compared.

    Raises:
        InputError: for the first pair that differs.
    """
    size = adjacency.shape[0]
    for row in range(0, size, _TILE):
        if perf_counter() > deadline:
            return
        rows = slice(row, row + _TILE)
        for column in range(row, size, _TILE):
            columns = slice(column, column + _TILE)
            if not np.array_equal(adjacency[rows, columns], adjacency[columns, rows].T):
                break
        else:
            continue
        # Only the first tile row with a difference is searched for the first pair.
        different = adjacency[rows] != adjacency[:, rows].T
        i, j = np.argwhere(different)[0]
        i, j = sorted((int(i) + row, int(j)))
        raise InputError(
            f"graph: [{i}, {j}] is {adjacency[i, j]} but [{j}, {i}] is {adjacency[j, i]}, "
            "expected a symmetric matrix"
        )
