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

A search that is not over soon goes on with many nodes side by side (see `_lanes`), where a vertex
is coloured in a tenth of the time; the last few nodes, too few for that, are visited one by one
again. When that happens is counted in vertices, not in seconds: the same graph, the same search.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax.clique._bitset import neighbour_sets
from pcm_jax.clique._bounds import degeneracy_order
from pcm_jax.clique._lanes import MOST_WORDS, Best, Lanes, Part
from pcm_jax.clique._local_search import improved_clique
from pcm_jax.clique._subgraphs import BITS

# Nodes visited one by one between two looks at how much is left.
_VISITS = 250
# Vertices left to colour that take one by one as long as lanes take to begin.
_WORTH_LANES = 25_000
# Vertices left to colour for each step of local search: some hundredths of the time they take.
_WORTH_A_STEP = 800
# Steps of the first round of it; each is as long as all before.
_STEPS = 400
# Branches of a node that are enough to judge those left by those that are done.
_SAMPLE = 8


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
    among: int | None = None,
    ceiling: float = np.inf,
    deadline: float = np.inf,
    steps: float = np.inf,
) -> Outcome:
    """The largest clique among `candidates` that has more than `floor` members.

    Args:
        graph: the graph.
        candidates: the set of labels searched.
        floor: only larger cliques are looked for.
        among: if given, only those with a member in this set of labels.
        ceiling: the first clique of this size ends the search.
        deadline: reading of `time.perf_counter` at which the search gives up.
        steps: branches after which it gives up, one by one.
    """
    walk = Walk(graph, [Part([], candidates)], Best(floor, ceiling), deadline, among)
    if np.isinf(steps):
        return _finished(walk)
    walk.visit(int(steps))
    walk.stop()
    return Outcome(walk.best.labels, walk.unsettled)


def largest_from(graph: BitGraph, best: Best, deadline: float) -> Outcome:
    """The largest clique of a graph, given one.

    A search that is not over at once is worth some steps of local search first.

    Args:
        graph: the graph.
        best: knows a clique, and is told of larger ones.
        deadline: as in `largest_clique`.
    """
    whole, spent = [Part([], graph.everything)], 0
    walk = Walk(graph, whole, best, deadline)
    walk.visit(_VISITS)
    while best.labels and not walk.over:
        steps = min(max(spent, _STEPS), int(walk.left() / _WORTH_A_STEP) - spent)
        if steps <= 0:
            break
        labels = improved_clique(graph, best.labels, deadline=deadline, steps=steps, seed=spent)
        spent += steps
        if len(labels) > best.size:
            best.take(labels)
            walk = Walk(graph, whole, best, deadline)
            walk.visit(_VISITS)
    return _finished(walk)


def _finished(walk: Walk) -> Outcome:
    """Ends a search: one by one while there is little left, else side by side on lanes.

    Lanes leave what is too little for them, and which of the two is too slow for it shows only
    later: each time the walk has twice as many visits before that is asked.
    """
    best, lanes, words, visits, unsettled = walk.best, None, 0, _VISITS, 0
    while not walk.over:
        if walk.left() <= _WORTH_LANES:
            walk.visit(visits)
            continue
        if lanes is None:
            words = min(-(-walk.largest_branch() // BITS), MOST_WORDS)
            lanes = Lanes(walk.graph, words, best)
        few = lanes.run(walk.parts(BITS * words), walk.deadline)
        unsettled |= lanes.unsettled | walk.unsettled
        walk = Walk(walk.graph, few, best, walk.deadline)
        visits *= 2
        walk.visit(visits)
    return Outcome(best.labels, unsettled | walk.unsettled)


class Walk:
    """The search depth first, on an explicit stack: cliques may be deeper than recursion.

    Attributes:
        graph, best, deadline: as they were given.
        over: whether it has come to its end.
        waiting: parts not looked at yet.
        unsettled: 0, or once time has run out as in `Outcome`.
    """

    def __init__(
        self,
        graph: BitGraph,
        parts: list[Part],
        best: Best,
        deadline: float,
        among: int | None = None,
    ):
        """Starts before its first part.

        Args:
            graph: the graph.
            parts: to be searched, the last first.
            best: what is known; larger cliques are told to it.
            deadline: reading of `time.perf_counter` at which to give up.
            among: if given, only cliques with a member in this set are looked for; for one part.
        """
        self.graph, self.best, self.deadline = graph, best, deadline
        self.over, self.waiting, self.unsettled = not parts, parts[:], 0
        self._among = among
        self._path: list[int] = []
        self._stack: list[tuple[int, int, int]] = []
        self._node = 0, 0, 0
        self._coloured, self._number = 0, len(parts)

    def visit(self, nodes: int) -> None:
        """Visits some nodes."""
        deque(self.parts(nodes=nodes), maxlen=0)

    def stop(self) -> None:
        """Gives up what is not searched yet."""
        if not self.over:
            self._give_up(self._stack[0][0] if self._stack else self._node[0])

    def left(self) -> float:
        """A guess at the vertices to be coloured yet, as if the branches of a node were all alike.

        It is 0 before the first visit. Later it is half of what has been coloured at least, since
        such guesses err.
        """
        nodes = (*self._stack, self._node)
        levels = [(number, branches.bit_count()) for _, branches, number in nodes]
        done, share = 0, 1.0
        for number, left in [(self._number, len(self.waiting)), *levels]:
            done, share = number - left, share * max(number, 1)
            if number >= _SAMPLE:
                break
        return self._coloured * max(share / max(done, 1) - 1, 0.5)

    def parts(self, most: int = 0, nodes: int = sys.maxsize) -> Iterator[Part]:
        """Continues; yields the parts of up to `most` candidates instead of going into them."""
        neighbours, uncoloured = self.graph.neighbours, self.graph.uncoloured
        best, path, stack, deadline = self.best, self._path, self._stack, self.deadline
        candidates, branches, number = self._node
        for _ in range(nodes):
            while not branches:
                if stack:
                    candidates, branches, number = stack.pop()
                    path.pop()
                elif self.waiting:
                    path[:], candidates = self.waiting.pop()
                    branches = self._among or uncoloured(candidates, best.size - len(path))
                    number = branches.bit_count()
                else:
                    self.over = True
                    return
            lowest = branches & -branches
            label = lowest.bit_length()
            inside = candidates & neighbours[label]
            if best.size == len(path) and best.take([*path, label]):
                self.over = True
                return
            if perf_counter() > deadline:
                self._give_up(stack[0][0] if stack else candidates)
                return
            candidates ^= lowest
            branches ^= lowest
            colours = best.size - len(path) - 1
            if (count := inside.bit_count()) > colours:
                if count <= most:
                    yield Part([*path, label], inside)
                    continue
                self._coloured += count
                if rest := uncoloured(inside, colours):
                    stack.append((candidates, branches, number))
                    path.append(label)
                    candidates, branches, number = inside, rest, rest.bit_count()
        self._node = candidates, branches, number

    def largest_branch(self) -> int:
        """The most candidates of a part to come, at least 1."""
        near = self.graph.neighbours
        for candidates, branches, _ in (*self._stack, self._node):
            if branches:  # those of deeper nodes are smaller
                labels = self.graph.members(branches)
                return max(1, *((candidates & near[label]).bit_count() for label in labels))
        return 1

    def _give_up(self, candidates: int) -> None:
        self.over, self.unsettled = True, candidates
        for path, inside in (*self.waiting, Part(self._path, 0)):
            self.unsettled |= inside | sum(self.graph.single[label] for label in path)
