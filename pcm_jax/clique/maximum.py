"""The entrance: a maximum clique, or the heaviest one, with its certificate."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num

from pcm_jax.clique._adjacency import adjacency_matrix, check_symmetric, induced
from pcm_jax.clique._bounds import core, degrees, most_members
from pcm_jax.clique._costs import checked_squared, symmetric_costs
from pcm_jax.clique._exact import BitGraph, largest_from
from pcm_jax.clique._heaviest import heaviest_clique, heavy_clique
from pcm_jax.clique._heuristic import greedy_clique
from pcm_jax.clique._lanes import Best
from pcm_jax.clique._ties import smallest_by_index, smallest_by_total
from pcm_jax.clique._weights import Weights, checked_weights
from pcm_jax.clique.result import Clique, CliqueInterrupt
from pcm_jax.errors import InputError, check_number

if TYPE_CHECKING:
    import networkx

METHODS = ("exact", "heuristic")
_ROWS = 64
Tell = Callable[[np.ndarray], object]
"""Takes the vertices of a better clique."""


def maximum_clique(
    graph: Bool[np.ndarray, "m m"] | Bool[Array, "m m"] | networkx.Graph,
    *,
    method: str = "exact",
    weights: Num[np.ndarray, " m"] | Num[Array, " m"] | None = None,
    time_limit: float | None = None,
    tie_break: Float[np.ndarray, "m m"] | Float[Array, "m m"] | None = None,
) -> Clique:
    """Finds a maximum clique of a graph, or the heaviest one, with a certificate.

        clique = pcm_jax.maximum_clique(consistent)
        clique.members, clique.optimal
        clique = pcm_jax.maximum_clique(consistent, weights=scores)
        clique.weight, clique.weight_bound

    The result depends on the graph alone: of several maximum cliques, `"exact"` returns the one
    whose sorted tuple of vertices is lexicographically the smallest ("ties by index"), or, given
    `tie_break`, the one of least total squared distance (totals equal to 12 digits are ties by
    index). The time limit holds for that choice too: if it runs out during it, the size is
    proven and the clique is a maximum one, but perhaps another of them. What of a large graph and
    of its squared distances could not be checked in that time is taken as it is.

    Args:
        graph: bool [m, m], symmetric, diagonal ignored; or a `networkx.Graph` with the nodes
            0..m-1.
        method: `"exact"`, or `"heuristic"` (HeuPatt of Pattabiraman et al. 2015; the certificate
            then says `optimal` only if degrees or a colouring prove it).
        weights: floats or integers [m], finite and at least 0.
        time_limit: seconds; when they are over, the best clique found so far is returned.
        tie_break: squared distances [m, m]; a pair counts with the larger of its two directions.

    Returns:
        the clique and its certificate.

    Raises:
        CliqueInterrupt: a `KeyboardInterrupt` came; it has the best clique found so far.
        InputError: a graph that is not a symmetric bool matrix, an unknown method, a negative
            time limit; weights of another shape, negative or not finite; squared distances of
            another shape, not finite on an edge (with weights: negative), or given with another
            method than `"exact"`.
    """
    start = perf_counter()
    deadline = start + _checked_limit(time_limit)
    if not isinstance(method, str) or method not in METHODS:
        raise InputError(f"method: {method!r}, expected one of {', '.join(METHODS)}")
    if tie_break is not None and method != "exact":
        raise InputError(f"tie_break: given with method {method!r}, expected method 'exact'")
    adjacency = adjacency_matrix(graph, deadline=deadline)
    given = None if weights is None else checked_weights(weights, len(adjacency))
    least = -np.inf if given is None else 0.0
    squared = None
    if tie_break is not None:
        squared = checked_squared(tie_break, adjacency, least=least, deadline=deadline)
    degree = degrees(adjacency, deadline=deadline)
    known: deque[np.ndarray] = deque([np.empty(0, np.int64)], maxlen=1)
    units = None if given is None or given.equal else given
    try:
        if units is None:
            search = _heuristic if method == "heuristic" else _exact
            found, most = search(adjacency, degree, squared, deadline, known.append)
            bound = math.inf
        else:
            search = heavy_clique if method == "heuristic" else heaviest_clique
            found, bound = search(adjacency, units, squared, deadline, known.append)
            most = most_members(degree)
    except KeyboardInterrupt as interrupt:
        most = most_members(degree)
        clique = _certified(adjacency, known[0], given, most, math.inf, start)
        raise CliqueInterrupt(clique) from interrupt
    return _certified(adjacency, found, given, most, bound, start)


def _certified(
    adjacency: np.ndarray,
    found: np.ndarray,
    weights: Weights | None,
    most: int,
    units: float,
    start: float,
) -> Clique:
    """The clique of some vertices, of which none has more than `most` or weighs more than `units`.

    The clock was read at `start`.
    """
    size = len(found)
    weight, bound = (size, most) if weights is None else weights.certificate(found, most, units)
    plain = weights is None or weights.equal
    optimal = size == most if plain else weight == bound
    members = _checked_members(adjacency, found)
    return Clique(members, size, optimal, most, perf_counter() - start, weight, bound)


def _heuristic(
    adjacency: np.ndarray,
    degree: np.ndarray,
    _: np.ndarray | None,
    deadline: float,
    tell: Tell,
) -> tuple[Int[np.ndarray, " k"], int]:
    if len(degree) == 0:
        return np.empty(0, np.int64), 0
    found = greedy_clique(adjacency, deadline, degree)
    tell(found)
    rest = core(adjacency, len(found), degree, deadline=deadline)
    if rest.size == 0:
        return found, len(found)
    try:
        graph = BitGraph(induced(adjacency, rest, deadline=deadline), deadline=deadline)
    except TimeoutError:
        return found, most_members(degree)
    return found, max(len(found), _cheap_bound(graph, graph.everything))


def _exact(
    adjacency: np.ndarray,
    degree: np.ndarray,
    squared: np.ndarray | None,
    deadline: float,
    tell: Tell,
) -> tuple[Int[np.ndarray, " k"], int]:
    if len(degree) == 0:
        return np.empty(0, np.int64), 0
    found = greedy_clique(adjacency, deadline, degree)
    tell(found)
    # Every clique at least as large is inside: enough for the proof and for the ties.
    rest = core(adjacency, len(found) - 1, degree, deadline=deadline)
    if rest.size == len(found):
        return found, len(found)
    try:
        graph = BitGraph(induced(adjacency, rest, deadline=deadline), deadline=deadline)
    except TimeoutError:
        return found, most_members(degree)
    best = Best(len(found), tell=lambda labels: tell(rest[graph.vertices_of(labels)]))
    best.labels = graph.labels_of(np.searchsorted(rest, found))
    outcome = largest_from(graph, best, deadline)
    labels = outcome.labels or []
    upper_bound = max(len(labels), _cheap_bound(graph, outcome.unsettled))
    if upper_bound == len(labels) and perf_counter() < deadline:
        labels = _one_of_largest(graph, rest, squared, labels, deadline)
    return rest[graph.vertices_of(labels)], upper_bound


def _one_of_largest(
    graph: BitGraph,
    inside: np.ndarray,
    squared: np.ndarray | None,
    labels: list[int],
    deadline: float,
) -> list[int]:
    if squared is None:
        return smallest_by_index(graph, labels, deadline)
    try:
        costs = symmetric_costs(squared, inside[graph.vertices], deadline=deadline)
    except TimeoutError:
        return labels
    return smallest_by_total(graph, costs, labels, deadline)


def _cheap_bound(graph: BitGraph, candidates: int) -> int:
    return min(graph.degeneracy + 1, graph.chromatic_bound(candidates))


def _checked_limit(time_limit: float | None) -> float:
    if time_limit is None:
        return np.inf
    check_number("time_limit", time_limit)
    if time_limit < 0:
        raise InputError(f"time_limit: {time_limit}, expected seconds, at least 0")
    return float(time_limit)


def _checked_members(adjacency: np.ndarray, found: np.ndarray) -> Bool[np.ndarray, " m"]:
    """The mask, after the check that it is a clique at all."""
    members = np.zeros(len(adjacency), bool)
    members[found] = True
    pairs = 0
    for start in range(0, len(found), _ROWS):  # a row's members by a mask are quicker than by index
        pairs += np.count_nonzero(adjacency[found[start : start + _ROWS]] & members)
    if pairs != len(found) * (len(found) - 1):
        check_symmetric(adjacency)  # there may not have been time for it
        raise RuntimeError("the search returned vertices that are not a clique: a bug")
    return members
