"""The walk through the search with weights, exact or greedy: what `maximum_clique` does with them.

Vertices of weight 0 are left out at once; where all weights are equal, the heaviest clique is the
largest one, and this module is not asked.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax.clique._adjacency import induced
from pcm_jax.clique._bounds import weighted_core
from pcm_jax.clique._costs import symmetric_costs
from pcm_jax.clique._heuristic import greedy_heavy_clique
from pcm_jax.clique._local_search import improved_clique
from pcm_jax.clique._ties import first_of_heaviest
from pcm_jax.clique._weighted import Heaviest, WeightedGraph, heaviest_cliques
from pcm_jax.clique._weights import Weights


class Heavy(NamedTuple):
    """A clique and a bound.

    Attributes:
        vertices: int64 [k].
        bound: on the weight of any clique, in units; infinite where time ran out before any was
            found.
    """

    vertices: Int[np.ndarray, " k"]
    bound: float


def heaviest_clique(
    adjacency: Bool[np.ndarray, "m m"],
    weights: Weights,
    squared: Float[np.ndarray, "m m"] | None,
    deadline: float,
    tell: Callable[[np.ndarray], object],
) -> Heavy:
    """The heaviest clique, of several the first one.

    Args:
        adjacency: bool [m, m].
        weights: of the vertices.
        squared: distances by which equally heavy cliques are told apart; None: by index.
        deadline: reading of `time.perf_counter` at which the best so far is returned.
        tell: takes the vertices of every better clique that is found.
    """
    found, inside, graph = _prepared(adjacency, weights, deadline)
    tell(found)
    if graph is None:
        return Heavy(found, math.inf if inside.size else 0)
    labels = graph.labels_of(np.searchsorted(inside, found))
    labels = improved_clique(graph, labels, deadline=deadline)

    def told(labels: list[int]) -> None:
        tell(inside[graph.vertices_of(labels)])

    told(labels)
    search = heaviest_cliques(graph, labels, weights.slack, deadline=deadline, tell=told)
    bound = max(search.weight, graph.weight_bound(search.unsettled))
    labels = _one_of_heaviest(graph, inside, search, squared, deadline)
    return Heavy(inside[graph.vertices_of(labels)], bound)


def heavy_clique(
    adjacency: Bool[np.ndarray, "m m"],
    weights: Weights,
    _: Float[np.ndarray, "m m"] | None,
    deadline: float,
    tell: Callable[[np.ndarray], object],
) -> Heavy:
    """A heavy clique, greedily, and the bound of a weighted colouring.

    Args:
        adjacency: bool [m, m].
        weights: of the vertices.
        deadline, tell: as in `heaviest_clique`.
    """
    found, inside, graph = _prepared(adjacency, weights, deadline)
    tell(found)
    if graph is None:
        return Heavy(found, math.inf if inside.size else 0)
    return Heavy(found, graph.weight_bound(graph.everything))


def _prepared(
    adjacency: np.ndarray, weights: Weights, deadline: float
) -> tuple[np.ndarray, np.ndarray, WeightedGraph | None]:
    """A clique, the vertices of all cliques as heavy, and their graph if there was time for it."""
    coarse, shift = weights.coarse()
    inside = np.flatnonzero(coarse)
    found = inside[:1]
    if inside.size == 0:
        return found, inside, None
    try:
        positive = induced(adjacency, inside, deadline=deadline)
        found = inside[greedy_heavy_clique(positive, coarse[inside], deadline)]
        weight = sum(weights.units[vertex] for vertex in found)
        lightest = weight - weights.slack(weight) >> shift
        rest = weighted_core(positive, coarse[inside], lightest, deadline=deadline)
        inside = inside[rest]
        graph = WeightedGraph(
            induced(positive, rest, deadline=deadline),
            [weights.units[vertex] for vertex in inside],
            coarse[inside],
            deadline=deadline,
        )
    except TimeoutError:
        return found, inside, None
    return found, inside, graph


def _one_of_heaviest(
    graph: WeightedGraph,
    inside: np.ndarray,
    search: Heaviest,
    squared: np.ndarray | None,
    deadline: float,
) -> list[int]:
    costs = None
    if squared is not None:
        try:
            costs = symmetric_costs(squared, inside[graph.vertices], deadline=deadline)
        except TimeoutError:
            search.complete = True  # then it is chosen by index, of those that are known
    return first_of_heaviest(graph, search, deadline, costs)
