"""A large clique, or a heavy one, quickly: greedy from every vertex.

HeuPatt of Pattabiraman, Patwary, Gebremedhin, Liao and Choudhary, "Fast algorithms for the
maximum clique problem on massive graphs with applications to overlapping community detection",
Internet Mathematics 11 (2015), algorithm 3: by degree, the one in the whole graph. With weights, by
the weight of a vertex and its neighbours.
"""

from __future__ import annotations

from time import perf_counter

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax.clique._bitset import neighbour_sets
from pcm_jax.clique._bounds import degrees, neighbourhood_weights

# Steps of the weighted greedy per vertex, all starts together: it has no bound by which to pass
# over starts as the unweighted one does.
_STEPS_PER_VERTEX = 16
# Seconds in which a first clique is met even without a time limit's leave.
_GRACE = 0.03


def greedy_clique(
    adjacency: Bool[np.ndarray, "m m"],
    deadline: float = np.inf,
    degree: Int[np.ndarray, " m"] | None = None,
) -> Int[np.ndarray, " k"]:
    """For each vertex, the clique met by always adding the candidate of largest degree; the best.

    Vertices are tried in the order of falling degree (ties by index), and of equal cliques the
    first is kept. Vertices of too small a degree to improve on the best are passed over, as in
    the paper; none of that changes the size found.

    Args:
        adjacency: symmetric bool [m, m] with a false diagonal, m > 0.
        deadline: reading of `time.perf_counter` after which no further vertex is tried.
        degree: int64 [m], where it is known.

    Returns:
        int64 [k], the vertices of the clique.
    """
    degree = degrees(adjacency) if degree is None else degree
    best = _greedy_from(adjacency, degree, int(degree.argmax()), deadline)
    promising = np.flatnonzero(degree >= len(best))
    promising = promising[np.lexsort((-promising, degree[promising]))]
    try:
        neighbours = neighbour_sets(adjacency, promising, deadline=deadline)
    except TimeoutError:
        return best
    for start in range(len(promising), 0, -1):
        if degree[promising[start - 1]] < len(best) or perf_counter() > deadline:
            break
        candidates, size = neighbours[start], 1
        # The label of largest degree is the highest bit; stop when too few are left to improve.
        while candidates and size + candidates.bit_count() > len(best):
            candidates &= neighbours[candidates.bit_length()]
            size += 1
        if not candidates and size > len(best):
            best = promising[_labels_from(neighbours, start) - 1]
    return best


def greedy_heavy_clique(
    adjacency: Bool[np.ndarray, "m m"],
    weights: Float[np.ndarray, " m"],
    deadline: float = np.inf,
) -> Int[np.ndarray, " k"]:
    """The heaviest clique met by always adding the candidate of heaviest neighbourhood.

    The first clique is met by weight alone, in no time. Starts are then the vertices in the order
    of falling weight of the neighbourhood (ties by index), for a bounded number of steps; of
    equally heavy cliques the first is kept.

    Args:
        adjacency: symmetric bool [m, m] with a false diagonal, m > 0.
        weights: of the vertices, whole numbers, positive.
        deadline: reading of `time.perf_counter` after which no further vertex is tried.

    Returns:
        int64 [k], the vertices of the clique.
    """
    best = _greedy_from(adjacency, weights, int(weights.argmax()), deadline)
    try:
        reach = neighbourhood_weights(adjacency, weights, deadline=deadline)
        other = _greedy_from(adjacency, reach, int(reach.argmax()), deadline)
        best = max(best, other, key=lambda clique: float(weights[clique].sum()))
        heaviest = float(weights[best].sum())
        promising = np.flatnonzero(reach > heaviest)
        promising = promising[np.lexsort((-promising, reach[promising]))]
        neighbours = neighbour_sets(adjacency, promising, deadline=deadline)
    except TimeoutError:
        return best
    weight, steps = weights[promising].tolist(), _STEPS_PER_VERTEX * len(weights)
    for start in range(len(promising), 0, -1):
        if steps < 0 or reach[promising[start - 1]] <= heaviest or perf_counter() > deadline:
            break
        labels = _labels_from(neighbours, start)
        steps -= len(labels)
        total = sum(weight[label - 1] for label in labels)
        if total > heaviest:
            heaviest, best = total, promising[labels - 1]
    return best


def _greedy_from(
    adjacency: np.ndarray, degree: np.ndarray, start: int, deadline: float = np.inf
) -> np.ndarray:
    """One run without the cost of building sets: on big graphs it spares most of them.

    After the deadline it may go on for `_GRACE`, which it needs on none but the largest.
    """
    members = [start]
    candidates = np.flatnonzero(adjacency[start])
    end = max(deadline, perf_counter() + _GRACE)
    while candidates.size and perf_counter() < end:
        members.append(int(candidates[degree[candidates].argmax()]))
        candidates = candidates[adjacency[members[-1], candidates]]
    return np.array(members)


def _labels_from(neighbours: list[int], start: int) -> np.ndarray:
    labels, candidates = [start], neighbours[start]
    while candidates:
        labels.append(candidates.bit_length())
        candidates &= neighbours[labels[-1]]
    return np.array(labels)
