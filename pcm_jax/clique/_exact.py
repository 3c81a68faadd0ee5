"""Exact search: branch and bound on bit sets, bounded by greedy colourings.

A set of vertices that takes c colours holds no clique of more than c members. With a clique of
size b in hand and s vertices chosen, `b - s` colours are spent on the candidates; a clique that
improves on b has a member among those left uncoloured, so only they are branched on.

E. Tomita and T. Seki, "An efficient branch-and-bound algorithm for finding a maximum clique",
DMTCS 2003 (the bound); P. San Segundo, D. Rodriguez-Losada and A. Jimenez, "An exact bit-parallel
algorithm for the maximum clique problem", Computers & Operations Research 38 (2011) (colour
classes by set algebra, the fixed initial order). The sharper bounds of E. Tomita et al. (MCS,
WALCOM 2010) and San Segundo, Nikolaev and Batsyn (infra-chromatic, COR 2015) halve the nodes here,
but cost as much per node as they save: with Python integers the plain bound is as fast.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax.clique._bitset import neighbour_sets
from pcm_jax.clique._bounds import degeneracy_order


class BitGraph:
    """A graph on bit sets (see `bitset`), labels in degeneracy order.

    The label n is the vertex that leaves last. Colouring starts at the highest labels, where the
    graph is densest, and branching at the lowest, where candidate sets are smallest.

    Attributes:
        vertices: int64 [n], the vertex of label v at v - 1.
        degeneracy: of the graph, see `degeneracy_order`.
        everything: the set of all labels.
        neighbours: per label, the set of those adjacent.
        strangers: per label, the set of those neither adjacent nor the label itself.
        single: per label, the set of it alone.
    """

    def __init__(
        self,
        adjacency: Bool[np.ndarray, "n n"],
        weights: Float[np.ndarray, " n"] | None = None,
        *,
        deadline: float = np.inf,
    ):
        """Builds the sets.

        Args:
            adjacency: bool [n, n].
            weights: by which the order is to be, see `degeneracy_order`.
            deadline: reading of `time.perf_counter` at which to give up.

        Raises:
            TimeoutError: at the deadline.
        """
        self.vertices, self.degeneracy = degeneracy_order(adjacency, weights, deadline=deadline)
        self.neighbours = neighbour_sets(adjacency, self.vertices, deadline=deadline)
        self.everything = (1 << len(self.vertices)) - 1
        self.single = [0, *(1 << bit for bit in range(len(self.vertices)))]
        self.strangers = [
            self.everything & ~(near | one)
            for near, one in zip(self.neighbours, self.single, strict=True)
        ]

    def vertices_of(self, labels: list[int]) -> Int[np.ndarray, " k"]:
        """The vertices that the labels stand for."""
        return self.vertices[np.array(labels, np.int64) - 1]

    def labels_of(self, vertices: Int[np.ndarray, " k"]) -> list[int]:
        """The labels of the vertices."""
        label = np.empty(len(self.vertices), np.int64)
        label[self.vertices] = np.arange(1, len(self.vertices) + 1)
        return label[vertices].tolist()

    def members(self, labels: int) -> list[int]:
        """The labels in a set, largest first."""
        found = []
        while labels:
            found.append(labels.bit_length())
            labels ^= self.single[found[-1]]
        return found

    def value(self, labels: int) -> int:
        """The size of a set: what a clique is to have much of."""
        return labels.bit_count()

    def beyond(self, value: int) -> int:
        """Finds labels of which every clique of more than `value` has one."""
        return self.uncoloured(self.everything, value)

    def uncoloured(self, candidates: int, colours: int) -> int:
        """Finds what of `candidates` a greedy colouring leaves without one of `colours` colours."""
        strangers, single = self.strangers, self.single
        for _ in range(colours):
            eligible = candidates
            while eligible:
                label = eligible.bit_length()
                eligible &= strangers[label]
                candidates ^= single[label]
            if not candidates:
                break
        return candidates

    def chromatic_bound(self, candidates: int) -> int:
        """The number of colours that a greedy colouring of `candidates` takes."""
        colours = 0
        while candidates:
            candidates = self.uncoloured(candidates, 1)
            colours += 1
        return colours


@dataclass(frozen=True)
class Outcome:
    """The result of a search.

    Attributes:
        labels: a clique larger than the floor, or None if none was found.
        unsettled: 0 after a complete search; else (time ran out) every larger clique lies inside
            this set of labels.
    """

    labels: list[int] | None
    unsettled: int = 0


def largest_clique(
    graph: BitGraph,
    candidates: int,
    floor: int,
    *,
    ceiling: float = np.inf,
    deadline: float = np.inf,
    steps: float = np.inf,
) -> Outcome:
    """The largest clique among `candidates` that has more than `floor` members.

    An explicit stack, since cliques may be deeper than Python's recursion limit.

    Args:
        graph: the graph.
        candidates: the set of labels searched.
        floor: only larger cliques are looked for.
        ceiling: the first clique of this size ends the search.
        deadline: reading of `time.perf_counter` at which the search gives up.
        steps: branches after which it gives up.
    """
    neighbours, uncoloured = graph.neighbours, graph.uncoloured
    best, found = floor, None
    path: list[int] = []
    stack: list[tuple[int, int]] = []
    branches = uncoloured(candidates, best)
    while branches or stack:
        if not branches:
            candidates, branches = stack.pop()
            path.pop()
            continue
        lowest = branches & -branches
        label = lowest.bit_length()
        inside = candidates & neighbours[label]
        if best == len(path):
            best, found = best + 1, [*path, label]
            if best >= ceiling:
                return Outcome(found)
        steps -= 1
        if steps < 0 or perf_counter() > deadline:
            root = stack[0][0] | graph.single[path[0]] if stack else candidates
            return Outcome(found, root)
        candidates ^= lowest
        branches ^= lowest
        colours = best - len(path) - 1
        if inside.bit_count() > colours and (rest := uncoloured(inside, colours)):
            stack.append((candidates, branches))
            path.append(label)
            candidates, branches = inside, rest
    return Outcome(found)
