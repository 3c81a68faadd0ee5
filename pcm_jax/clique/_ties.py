"""One of several maximum or heaviest cliques: by index, or by total squared distance, then index.

By index means the clique whose sorted tuple of vertices is lexicographically the smallest. It is
settled vertex by vertex: the smallest vertex that some clique of the right size contains, then
the next given that one, each by yes-or-no searches ended by their first success. As long as none
succeeds, each asks for four times as many vertices at once: where the clique is the only one, few
ask for all, and where there are many, the first vertices are asked for one by one. Of equally heavy
cliques the search for them remembers all, if they are few: then it is a comparison.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from time import perf_counter

import numpy as np
from jaxtyping import Float

from pcm_jax.clique._exact import BitGraph, largest_clique
from pcm_jax.clique._weighted import Heaviest, WeightedGraph, clique_of_weight

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
    order = graph.labels_of(np.arange(len(graph.vertices)))
    place = {label: at for at, label in enumerate(order)}
    chosen: list[int] = []
    rest, candidates, passed, most = sorted(clique, key=place.__getitem__), graph.everything, 0, 1
    while rest and perf_counter() < deadline:
        missing, first = len(rest), place[rest[0]]
        before = [label for label in order[passed:first] if graph.single[label] & candidates]
        if not before:
            candidates &= graph.neighbours[rest[0]]
            passed = first + 1
            chosen.append(rest.pop(0))
            continue
        among = sum(graph.single[label] for label in before[:most])
        outcome = largest_clique(
            graph, candidates, missing - 1, among=among, ceiling=missing, deadline=deadline
        )
        if outcome.labels:
            rest = sorted(outcome.labels, key=place.__getitem__)
        else:
            candidates &= ~among
            most *= 4
    return [*chosen, *rest]


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
    return _cheapest(partial(_CheapestClique, graph, squared, len(clique), deadline), clique)


def _cheapest(prepared: Callable[[], _CheapestClique], clique: list[int]) -> list[int]:
    try:
        search = prepared()
    except TimeoutError:
        return clique
    while (cheaper := search.below(search.total(clique), [], search.graph.everything)) is not None:
        clique = cheaper
    limit = search.total(clique)

    def no_dearer(chosen: list[int], candidates: int) -> list[int] | None:
        found = search.below(limit, chosen, candidates, or_equal=True)
        return None if found is None else found[len(chosen) :]

    return _first_by_index(search.graph, clique, no_dearer, search.deadline)


def _cheapest_of(squared: np.ndarray, cliques: list[list[int]], deadline: float) -> list[list[int]]:
    totals: list[float] = []
    for clique in cliques:
        if totals and perf_counter() > deadline:
            break
        totals.append(_total(squared, clique))
    limit = min(totals) + _ROUNDING * abs(min(totals))
    return [clique for clique, total in zip(cliques, totals, strict=False) if total <= limit]


def first_of_heaviest(
    graph: WeightedGraph,
    found: Heaviest,
    deadline: float,
    squared: Float[np.ndarray, "n n"] | None = None,
) -> list[int]:
    """The first of all cliques that are equally heavy: by least total if asked for, then by index.

    Args:
        graph: the graph.
        found: its heaviest cliques, by a search that is through.
        deadline: as in `smallest_by_index`.
        squared: as in `smallest_by_total`, and at least 0.

    Returns:
        labels.
    """
    cliques = [clique for _, clique in found.equal()]
    if squared is not None:
        cliques = _cheapest_of(squared, cliques, deadline)
    first = min(cliques, key=lambda clique: sorted(graph.vertices_of(clique).tolist()))
    if found.complete:
        return first
    lightest = found.weight - found.slack(found.weight)
    if squared is not None:
        return _cheapest(partial(_CheapestHeavyClique, graph, squared, lightest, deadline), first)

    def heavy_clique(chosen: list[int], candidates: int) -> list[int] | None:
        missing = lightest - sum(graph.weights[label] for label in chosen)
        if missing <= 0:
            return []
        return clique_of_weight(graph, candidates, missing, deadline=deadline)

    return _first_by_index(graph, first, heavy_clique, deadline)


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
        """Sorts the edges of every vertex, for cliques of at most `size`.

        Raises:
            TimeoutError: at the deadline.
        """
        self.graph, self.squared, self.size, self.deadline = graph, squared, size, deadline
        self.half_smallest = np.zeros((len(squared), max(size, 1)))
        for label in range(1, len(graph.neighbours)):
            if perf_counter() > deadline:
                raise TimeoutError
            near = np.sort(squared[label - 1, _positions(graph.neighbours[label])])[: size - 1]
            self.half_smallest[label - 1, 1:] = np.inf
            self.half_smallest[label - 1, 1 : len(near) + 1] = 0.5 * np.cumsum(near)

    def total(self, labels: list[int]) -> float:
        """The sum over unordered pairs, rounded once, whatever the order of the labels."""
        return _total(self.squared, labels)

    def finished(self, chosen: list[int]) -> bool:
        """True where a clique is one of those among which the cheapest is looked for."""
        return len(chosen) == self.size

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
            if self.finished(node.chosen) and self.total(node.chosen) <= limit:
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
        classes = list(_colour_classes(self.graph, candidates)) if missing else []
        if len(classes) >= missing > 0:
            gain = cost + self.half_smallest[:, missing - 1]
            smallest = np.sort([gain[members].min() for members in classes])[:missing]
            if total + smallest.sum() <= limit:
                # The first `missing - 1` classes alone complete no clique: branch on the others.
                branches = np.concatenate(classes[missing - 1 :])
                branches = branches[np.argsort(gain[branches], kind="stable")]
        return _Node(chosen, candidates, total, cost, iter(branches.tolist()))


class _CheapestHeavyClique(_CheapestClique):
    """The same among the cliques of at least some weight.

    A colour class gives at most the weight of its heaviest member, which tells how many vertices
    are missing at least, and each unit of weight at no less than its members' smallest ratio of
    squared distance to weight: the cheapest units that make up the missing weight are the bound.
    """

    def __init__(self, graph: WeightedGraph, squared: np.ndarray, lightest: int, deadline: float):
        largest = sum(1 for _ in _colour_classes(graph, graph.everything))
        super().__init__(graph, squared, largest, deadline)
        self.heavy, self.lightest = graph, lightest
        self.weights = np.array(graph.weights[1:], np.float64)

    def missing(self, chosen: list[int]) -> int:
        """The weight in units that is to come."""
        return self.lightest - sum(self.heavy.weights[label] for label in chosen)

    def finished(self, chosen: list[int]) -> bool:
        """True where a clique is heavy enough."""
        return self.missing(chosen) <= 0

    def _node(
        self, chosen: list[int], candidates: int, total: float, cost: np.ndarray, limit: float
    ) -> _Node:
        missing, branches = self.missing(chosen), np.empty(0, np.int64)
        needed = self.heavy.uncovered(candidates, missing - 1) if missing > 0 else 0
        if needed:
            classes = list(_colour_classes(self.graph, candidates))
            most = np.array([self.weights[members].max() for members in classes])
            least = missing * (1 - _ROUNDING)
            others = int((np.cumsum(np.sort(most)[::-1]) >= least).argmax())
            gain = cost + self.half_smallest[:, min(others, self.size - 1)]
            ratio = [(gain[members] / self.weights[members]).min() for members in classes]
            if total + _filled(np.array(ratio), most, least) <= limit:
                branches = _positions(needed)
                branches = branches[np.argsort(gain[branches], kind="stable")]
        return _Node(chosen, candidates, total, cost, iter(branches.tolist()))


def _filled(price: np.ndarray, most: np.ndarray, missing: float) -> float:
    """The least price of so many units, of which each class has no more than `most`."""
    order = np.argsort(price, kind="stable")
    taken = np.minimum(most[order], np.maximum(missing - (np.cumsum(most[order]) - most[order]), 0))
    used = taken > 0
    return float((price[order][used] * taken[used]).sum())


def _total(squared: np.ndarray, labels: list[int]) -> float:
    positions = np.array(labels, int) - 1
    block = squared[np.ix_(positions, positions)]
    return math.fsum(block[np.triu_indices(len(labels), 1)].tolist())


def _colour_classes(graph: BitGraph, candidates: int) -> Iterator[np.ndarray]:
    while candidates:
        rest = graph.uncoloured(candidates, 1)
        yield _positions(candidates ^ rest)
        candidates = rest


def _positions(labels: int) -> np.ndarray:
    """The positions (label - 1) of a set, ascending."""
    raw = labels.to_bytes((labels.bit_length() + 7) // 8, "little")
    return np.flatnonzero(np.unpackbits(np.frombuffer(raw, np.uint8), bitorder="little"))
