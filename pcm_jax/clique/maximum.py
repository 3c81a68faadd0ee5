"""The entrance: a maximum clique with its certificate."""

from __future__ import annotations

from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pcm_jax.clique._adjacency import adjacency_matrix
from pcm_jax.clique._bounds import core, degrees
from pcm_jax.clique._exact import BitGraph, largest_clique
from pcm_jax.clique._heuristic import greedy_clique
from pcm_jax.clique._local_search import improved_clique
from pcm_jax.clique._ties import smallest_by_index, smallest_by_total
from pcm_jax.clique.result import Clique
from pcm_jax.errors import InputError

if TYPE_CHECKING:
    import networkx

METHODS = ("exact", "heuristic")


def maximum_clique(
    graph: Bool[np.ndarray, "m m"] | Bool[Array, "m m"] | networkx.Graph,
    *,
    method: str = "exact",
    time_limit: float | None = None,
    tie_break: Float[np.ndarray, "m m"] | Float[Array, "m m"] | None = None,
) -> Clique:
    """Finds a maximum clique of a graph, with a certificate.

        clique = pcm_jax.maximum_clique(consistent)
        clique.members, clique.optimal

    The result depends on the graph alone: of several maximum cliques, `"exact"` returns the one
    whose sorted tuple of vertices is lexicographically the smallest ("ties by index"), or, given
    `tie_break`, the one of least total squared distance (totals equal to 12 digits are ties by
    index). The time limit holds for that choice too: if it runs out during it, the size is
    proven and the clique is a maximum one, but perhaps another of them.

    Args:
        graph: bool [m, m], symmetric, diagonal ignored; or a `networkx.Graph` with the nodes
            0..m-1.
        method: `"exact"`, or `"heuristic"` (HeuPatt of Pattabiraman et al. 2015; the certificate
            then says `optimal` only if degrees or a colouring prove it).
        time_limit: seconds; when they are over, the best clique found so far is returned.
        tie_break: squared distances [m, m]; a pair counts with the larger of its two directions.

    Returns:
        the clique and its certificate.

    Raises:
        InputError: a graph that is not a symmetric bool matrix, an unknown method, a negative
            time limit; squared distances of another shape, not finite on an edge, or given with
            another method than `"exact"`.
    """
    start = perf_counter()
    deadline = start + _checked_limit(time_limit)
    if method not in METHODS:
        raise InputError(f"method: {method!r}, expected one of {', '.join(METHODS)}")
    if tie_break is not None and method != "exact":
        raise InputError(f"tie_break: given with method {method!r}, expected method 'exact'")
    adjacency = adjacency_matrix(graph)
    squared = None if tie_break is None else _checked_squared(tie_break, adjacency)
    if adjacency.shape[0] == 0:
        found, upper_bound = np.empty(0, np.int64), 0
    elif method == "heuristic":
        found, upper_bound = _heuristic(adjacency, deadline)
    else:
        found, upper_bound = _exact(adjacency, squared, deadline)
    return _certified(adjacency, found, upper_bound, start)


def _heuristic(adjacency: np.ndarray, deadline: float) -> tuple[Int[np.ndarray, " k"], int]:
    found = greedy_clique(adjacency, deadline)
    rest = core(adjacency, len(found))
    if rest.size == 0:
        return found, len(found)
    graph = BitGraph(adjacency[np.ix_(rest, rest)])
    return found, max(len(found), _cheap_bound(graph, graph.everything))


def _exact(
    adjacency: np.ndarray, squared: np.ndarray | None, deadline: float
) -> tuple[Int[np.ndarray, " k"], int]:
    found = greedy_clique(adjacency, deadline)
    # Every clique at least as large is inside: enough for the proof and for the ties.
    rest = core(adjacency, len(found) - 1)
    if rest.size == len(found):
        return found, len(found)
    if perf_counter() > deadline:
        return found, int(degrees(adjacency).max()) + 1
    graph = BitGraph(adjacency[np.ix_(rest, rest)])
    labels = graph.labels_of(np.searchsorted(rest, found))
    labels = improved_clique(graph, labels, deadline=deadline)
    outcome = largest_clique(graph, graph.everything, len(labels), deadline=deadline)
    labels = outcome.labels or labels
    upper_bound = max(len(labels), _cheap_bound(graph, outcome.unsettled))
    if upper_bound == len(labels) and perf_counter() < deadline:
        if squared is None:
            labels = smallest_by_index(graph, labels, deadline)
        else:
            order = rest[graph.vertices]
            labels = smallest_by_total(graph, squared[np.ix_(order, order)], labels, deadline)
    return rest[graph.vertices_of(labels)], upper_bound


def _cheap_bound(graph: BitGraph, candidates: int) -> int:
    return min(graph.degeneracy + 1, graph.chromatic_bound(candidates))


def _checked_limit(time_limit: float | None) -> float:
    if time_limit is None:
        return np.inf
    if not time_limit >= 0:
        raise InputError(f"time_limit: {time_limit}, expected seconds, at least 0")
    return float(time_limit)


def _checked_squared(tie_break: Any, adjacency: np.ndarray) -> np.ndarray:
    squared = np.asarray(tie_break, dtype=np.float64)
    if squared.shape != adjacency.shape:
        raise InputError(
            f"tie_break: shape {squared.shape}, expected that of the graph, {adjacency.shape}"
        )
    squared = np.where(adjacency, np.maximum(squared, squared.T), 0.0)
    if not np.isfinite(squared).all():
        i, j = np.argwhere(~np.isfinite(squared))[0]
        raise InputError(f"tie_break: [{i}, {j}] is not finite, expected a number on every edge")
    return squared


def _certified(adjacency: np.ndarray, found: np.ndarray, upper_bound: int, start: float) -> Clique:
    """The result, after the check that it is a clique at all."""
    pairs = adjacency[np.ix_(found, found)]
    if np.count_nonzero(pairs) != len(found) * (len(found) - 1):
        raise RuntimeError("the search returned vertices that are not a clique: a bug")
    members = np.zeros(adjacency.shape[0], bool)
    members[found] = True
    size = int(members.sum())
    return Clique(members, size, size == upper_bound, upper_bound, perf_counter() - start)
