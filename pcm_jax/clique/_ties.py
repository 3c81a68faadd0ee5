"""One of several maximum cliques: by index, or by total squared distance and then by index.

By index means the clique whose sorted tuple of vertices is lexicographically the smallest. It is
settled vertex by vertex: the smallest vertex that some clique of the right size contains, then
the next given that one, each a yes-or-no search ended by its first success.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from jaxtyping import Float

from pcm_jax.clique._exact import BitGraph, largest_clique

# Totals that differ by less than this, relatively, differ by rounding: they are ties.
_ROUNDING = 1e-12

Search = Callable[[list[int], int], list[int] | None]


def smallest_by_index(graph: BitGraph, clique: list[int], deadline: float) -> list[int]:
    """The lexicographically smallest of all cliques as large as `clique`.

    Args:
        graph: the graph; it has no larger clique.
        clique: the labels of one.
        deadline: reading of `time.perf_counter` after which `clique`, as far as it has been
            improved, is returned.

    Returns:
        labels.
    """

    def any_clique(chosen: list[int], candidates: int) -> list[int] | None:
        missing = len(clique) - len(chosen)
        if missing == 0:
            return []
        outcome = largest_clique(graph, candidates, missing - 1, ceiling=missing, deadline=deadline)
        return outcome.labels

    return _first_by_index(graph, clique, any_clique, deadline)


def smallest_by_total(
    graph: BitGraph, squared: Float[np.ndarray, "n n"], clique: list[int], deadline: float
) -> list[int]:
    """The clique of least total squared distance, then index, among all as large as `clique`.

    Args:
        graph: the graph; it has no larger clique.
        squared: float64 [n, n], symmetric, finite on edges, by label (entry v - 1 for label v).
        clique: the labels of one.
        deadline: as in `smallest_by_index`.

    Returns:
        labels.
    """
    search = _CheapestClique(graph, squared, len(clique), deadline)
    while (cheaper := search.below(search.total(clique), [], graph.everything)) is not None:
        clique = cheaper
    limit = search.total(clique)

    def no_dearer(chosen: list[int], candidates: int) -> list[int] | None:
        found = search.below(limit, chosen, candidates, or_equal=True)
        return None if found is None else found[len(chosen) :]

    return _first_by_index(graph, clique, no_dearer, deadline)


def _first_by_index(
    graph: BitGraph, clique: list[int], search: Search, deadline: float
) -> list[int]:
    """The lexicographically smallest clique of those that `search` completes.

    `search(chosen, candidates)` returns the remaining labels of a clique that consists of
    `chosen` and members of `candidates`, or None.
    """
    chosen: list[int] = []
    rest, candidates = set(clique), graph.everything
    for label in graph.labels_of(np.arange(len(graph.vertices))):
        if not rest or perf_counter() > deadline:
            break
        if not graph.single[label] & candidates:
            continue
        inside = candidates & graph.neighbours[label]
        if label not in rest:
            completion = search([*chosen, label], inside)
            if completion is None:
                candidates &= ~graph.single[label]
                continue
            rest = {label, *completion}
        chosen.append(label)
        rest.discard(label)
        candidates = inside
    return [*chosen, *rest]


@dataclass
class _Node:
    """A step of the search: `branches` are the positions left to try next."""

    chosen: list[int]
    candidates: int
    total: float
    cost: np.ndarray
    branches: Iterator[int]


class _CheapestClique:
    """Depth-first search for a clique of a given size and a small total of squared distances.

    With r vertices to come, a candidate u adds at least its squared distances to those chosen
    plus half the r - 1 smallest at any of its edges; each colour class gives at most one vertex.
    The r smallest of the classes' minima bound the total from below.
    """

    def __init__(self, graph: BitGraph, squared: np.ndarray, size: int, deadline: float):
        self.graph, self.squared, self.size, self.deadline = graph, squared, size, deadline
        edges = np.full(squared.shape, np.inf)
        for label in range(1, len(graph.neighbours)):
            near = _positions(graph.neighbours[label])
            edges[label - 1, near] = squared[label - 1, near]
        sums = np.cumsum(np.sort(edges, axis=1)[:, : max(size - 1, 0)], axis=1)
        self.half_smallest = 0.5 * np.pad(sums, ((0, 0), (1, 0)))

    def total(self, labels: list[int]) -> float:
        """The sum over unordered pairs, rounded once, whatever the order of the labels."""
        positions = np.array(labels, int) - 1
        block = self.squared[np.ix_(positions, positions)]
        return math.fsum(block[np.triu_indices(len(labels), 1)].tolist())

    def below(
        self, limit: float, chosen: list[int], candidates: int, *, or_equal: bool = False
    ) -> list[int] | None:
        """The labels of a clique of `chosen` and `candidates` with a total below `limit`."""
        slack = _ROUNDING * abs(limit)
        limit = limit + slack if or_equal else math.nextafter(limit - slack, -math.inf)
        cost = self.squared[np.array(chosen, int) - 1].sum(axis=0)
        stack = [self._node(chosen, candidates, self.total(chosen), cost, limit)]
        while stack and perf_counter() < self.deadline:
            node = stack[-1]
            if len(node.chosen) == self.size and self.total(node.chosen) <= limit:
                return node.chosen
            position = next(node.branches, None)
            if position is None:
                stack.pop()
                continue
            inside = node.candidates & self.graph.neighbours[position + 1]
            node.candidates ^= self.graph.single[position + 1]
            total = node.total + float(node.cost[position])
            cost = node.cost + self.squared[position]
            stack.append(self._node([*node.chosen, position + 1], inside, total, cost, limit))
        return None

    def _node(
        self, chosen: list[int], candidates: int, total: float, cost: np.ndarray, limit: float
    ) -> _Node:
        missing = self.size - len(chosen)
        branches = np.empty(0, np.int64)
        classes = self._colour_classes(candidates) if missing else []
        if len(classes) >= missing > 0:
            gain = cost + self.half_smallest[:, missing - 1]
            smallest = np.sort([gain[members].min() for members in classes])[:missing]
            if total + smallest.sum() <= limit:
                # The first `missing - 1` classes alone complete no clique: branch on the others.
                branches = np.concatenate(classes[missing - 1 :])
                branches = branches[np.argsort(gain[branches], kind="stable")]
        return _Node(chosen, candidates, total, cost, iter(branches.tolist()))

    def _colour_classes(self, candidates: int) -> list[np.ndarray]:
        classes = []
        while candidates:
            rest = self.graph.uncoloured(candidates, 1)
            classes.append(_positions(candidates ^ rest))
            candidates = rest
        return classes


def _positions(labels: int) -> np.ndarray:
    """The positions (label - 1) of a set, ascending."""
    raw = labels.to_bytes((labels.bit_length() + 7) // 8, "little")
    return np.flatnonzero(np.unpackbits(np.frombuffer(raw, np.uint8), bitorder="little"))
