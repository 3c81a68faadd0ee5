"""Exact search for the heaviest clique: branch and bound on bit sets, weighted colourings.

A family of independent sets with prices such that every vertex v lies in sets of total price at
least its weight bounds every clique by the sum of all prices: no two members share a set. Greedily:
take a maximal independent set, price it at the least weight left among its members, take that off
each of them, go on. With a clique of weight b in hand and weight h chosen, `b - h` may be spent on
the candidates; a clique heavier than b has a member among those with weight left.

L. Babel, "A fast algorithm for the maximum weight clique problem", Computing 52 (1994) (weighted
colourings as bounds); S. Held, W. Cook and E. C. Sewell, "Maximum-weight stable sets and safe lower
bounds for graph coloring", Mathematical Programming Computation 4 (2012) (weight split over
independent sets, branching on what is left); P. San Segundo, F. Furini and J. Artieda, "A new
branch-and-bound algorithm for the maximum weighted clique problem", Computers & Operations Research
110 (2019) (the same on bit sets). Pricing a set at the most of its members, as the last do at
first, takes a quarter of the time per node but five times the nodes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
from jaxtyping import Bool, Float

from pcm_jax.clique._exact import BitGraph

# Equally heavy cliques that are remembered; of more, one is chosen by a search of its own.
_REMEMBERED = 256


class WeightedGraph(BitGraph):
    """A graph with weights on bit sets, labels by the weight of the neighbourhood.

    Attributes:
        weights: per label, positive and whole.
    """

    def __init__(
        self,
        adjacency: Bool[np.ndarray, "n n"],
        units: list[int],
        coarse: Float[np.ndarray, " n"],
        *,
        deadline: float = np.inf,
    ):
        """Builds the sets.

        Args:
            adjacency: bool [n, n].
            units: the weights, positive and whole, any size.
            coarse: the same rounded, see `Weights.coarse`.
            deadline: reading of `time.perf_counter` at which to give up.

        Raises:
            TimeoutError: at the deadline.
        """
        super().__init__(adjacency, coarse, deadline=deadline)
        self.weights = [0, *(units[vertex] for vertex in self.vertices.tolist())]

    def value(self, labels: int) -> int:
        """The weight of a set."""
        return sum(self.weights[label] for label in self.members(labels))

    def beyond(self, value: int) -> int:
        """Finds labels of which every clique heavier than `value` has one."""
        return self.uncovered(self.everything, value)

    def uncovered(self, candidates: int, budget: int) -> int:
        """Finds which of `candidates` have weight left when a budget is spent on colours."""
        return self._covered(candidates, budget)[0]

    def weight_bound(self, candidates: int) -> int:
        """The sum of prices that a greedy weighted colouring of `candidates` takes."""
        enough = self.value(candidates)
        return enough - self._covered(candidates, enough)[1]

    def _covered(self, candidates: int, budget: int) -> tuple[int, int]:
        """Those with weight left, and what is left of the budget if that is none."""
        strangers, single = self.strangers, self.single
        left = self.weights[:]
        while candidates:
            first = candidates.bit_length()
            price, gone = left[first], single[first]
            # Sets of one or two, most in dense graphs, spare a list and a third of the time.
            if eligible := candidates & strangers[first]:
                second = eligible.bit_length()
                if eligible := eligible & strangers[second]:
                    members = [first, second]
                    while eligible:
                        label = eligible.bit_length()
                        eligible &= strangers[label]
                        members.append(label)
                        # `min` would add half to the time of the search.
                        if left[label] < price:  # noqa: PLR1730
                            price = left[label]
                    if left[second] < price:  # noqa: PLR1730
                        price = left[second]
                    gone = 0
                    for label in members:
                        left[label] = rest = left[label] - price
                        if not rest:
                            gone |= single[label]
                elif (rest := left[second] - price) > 0:
                    left[second] = rest
                elif rest < 0:
                    price, gone, left[first] = left[second], single[second], -rest
                else:
                    gone |= single[second]
            budget -= price
            if budget < 0:
                break
            candidates ^= gone
        return candidates, budget


@dataclass
class Heaviest:
    """The result of a search, and what it knows while it runs.

    Attributes:
        weight: of the heaviest clique known, in units.
        floor: only cliques heavier than this are looked for.
        slack: how much lighter than a weight is equal to it.
        cliques: weights and labels of cliques that are equally heavy, in no order.
        complete: whether every clique as heavy is among them, once the search is through.
        unsettled: 0 after a complete search; else (time ran out) every clique heavier than `floor`
            that is not among `cliques` lies inside this set of labels.
        tell: takes every clique that is heavier than all before.
    """

    weight: int
    floor: int
    slack: Callable[[int], int]
    cliques: list[tuple[int, list[int]]] = field(default_factory=list)
    complete: bool = True
    unsettled: int = 0
    tell: Callable[[list[int]], object] | None = None

    def add(self, weight: int, clique: list[int]) -> None:
        """Takes a clique heavier than the floor, and raises the floor."""
        if weight > self.weight:
            # None as heavy as this was passed over if it would have been looked for so far.
            self.complete = self.complete or weight - self.slack(weight) > self.floor
            self.weight = weight
            if self.tell is not None:
                self.tell(clique)
        self.cliques.append((weight, clique))
        lightest = self.weight - self.slack(self.weight)
        if not self.complete or len(self.cliques) > _REMEMBERED:
            self.cliques = self.equal()
            self.complete = self.complete and len(self.cliques) <= _REMEMBERED
        self.floor = lightest - 1 if self.complete else self.weight

    def equal(self) -> list[tuple[int, list[int]]]:
        """The cliques that are as heavy as the heaviest."""
        lightest = self.weight - self.slack(self.weight)
        return [known for known in self.cliques if known[0] >= lightest]


def heaviest_cliques(
    graph: WeightedGraph,
    clique: list[int],
    slack: Callable[[int], int],
    *,
    deadline: float = np.inf,
    tell: Callable[[list[int]], object] | None = None,
) -> Heaviest:
    """The heaviest cliques of a graph.

    Args:
        graph: the graph.
        clique: the labels of one, from which the search starts.
        slack: how much lighter than a weight is equal to it.
        deadline: reading of `time.perf_counter` at which the search gives up.
        tell: takes every clique that is heavier than all before.
    """
    weight = sum(graph.weights[label] for label in clique)
    found = Heaviest(weight, weight - slack(weight) - 1, slack, [(weight, clique)], tell=tell)
    return _search(graph, graph.everything, found, np.inf, deadline)


def clique_of_weight(
    graph: WeightedGraph, candidates: int, weight: int, *, deadline: float = np.inf
) -> list[int] | None:
    """The labels of a clique among `candidates` of at least some weight, None if there is none.

    Args:
        graph: the graph.
        candidates: the set of labels searched.
        weight: in units, positive.
        deadline: as in `heaviest_cliques`; None then, too.
    """
    found = Heaviest(weight - 1, weight - 1, lambda _: 0)
    _search(graph, candidates, found, weight, deadline)
    return found.cliques[0][1] if found.cliques else None


def _search(
    graph: WeightedGraph, candidates: int, found: Heaviest, ceiling: float, deadline: float
) -> Heaviest:
    """Continues `found`, until it knows a clique as heavy as `ceiling`; see `largest_clique`."""
    neighbours, uncovered, weights = graph.neighbours, graph.uncovered, graph.weights
    path: list[int] = []
    stack: list[tuple[int, int, int]] = []
    chosen = 0
    branches = uncovered(candidates, found.floor)
    while branches or stack:
        if not branches:
            chosen, candidates, branches = stack.pop()
            path.pop()
            continue
        lowest = branches & -branches
        label = lowest.bit_length()
        weight = chosen + weights[label]
        if weight > found.floor:
            found.add(weight, [*path, label])
            if weight >= ceiling:
                return found
        if perf_counter() > deadline:
            found.unsettled = stack[0][1] | graph.single[path[0]] if stack else candidates
            return found
        inside = candidates & neighbours[label]
        candidates ^= lowest
        branches ^= lowest
        if inside and (rest := uncovered(inside, found.floor - weight)):
            stack.append((chosen, candidates, branches))
            path.append(label)
            chosen, candidates, branches = weight, inside, rest
    return found
