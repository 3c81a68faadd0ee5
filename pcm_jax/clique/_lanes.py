"""Exact search on lanes: thousands of nodes of the search side by side, by NumPy.

The search of `_exact`, whose nodes wait in a pool instead of on a stack. A lane takes a node and
colours one of its vertices at each step; when no colour is left, its branches go into the pool, and
it takes another. A step is some twenty array operations whatever the number of lanes, so that a
vertex costs 10 to 20 ns where sets that are Python integers take 120; nothing has to be compiled.
The pool gives back what came last: it holds a few nodes a lane and level, however long the search.

The search comes in parts, the first branches of the whole, each small enough for sets of a few
words (see `_subgraphs`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from time import perf_counter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Int, UInt

from pcm_jax.clique._colouring import Colourings, lined_up
from pcm_jax.clique._subgraphs import BITS, SINGLE, Subgraphs

if TYPE_CHECKING:
    from pcm_jax.clique._exact import BitGraph

MOST_WORDS = 6
"""Sets of more words gain nothing on integers."""

# Words of all lanes' sets: more leave the second-level cache, fewer spread the cost of calling
# NumPy over too few lanes.
_WORDS = 16384
# Between two looks for lanes that are done.
_STEPS = 8
# If fewer lanes than this share are at work, the others are given up.
_BUSY = 0.7
# Fewer nodes are searched sooner one by one, if they have not become many after so many looks.
_FEW, _LOOKS = 96, 16

Nodes = UInt[np.ndarray, "fields k"]
"""A node a column: its candidates [w], its path in its part [w], the offset of the part's subgraph,
and the number of vertices chosen."""


class Part(NamedTuple):
    """A part of a search.

    Attributes:
        path: the labels chosen.
        candidates: the set of labels from which more are to be chosen.
    """

    path: list[int]
    candidates: int


class Best:
    """The largest clique met, shared by all that search.

    Attributes:
        size: only larger cliques are looked for.
        ceiling: a clique of this size ends the search.
        labels: a clique of `size`, None until one has been met.
    """

    def __init__(
        self,
        floor: int,
        ceiling: float = np.inf,
        *,
        tell: Callable[[list[int]], object] | None = None,
    ):
        self.size, self.ceiling = floor, ceiling
        self.labels: list[int] | None = None
        self._tell = tell

    def take(self, labels: list[int]) -> bool:
        """Takes a larger clique; True if the search may end."""
        self.size, self.labels = len(labels), labels
        if self._tell is not None:
            self._tell(labels)
        return self.size >= self.ceiling


class Lanes:
    """A search of parts of a graph, side by side.

    Attributes:
        words: w, of a set; no part may have more than 64 w candidates.
        unsettled: 0, or once time has run out a set of labels inside which all larger cliques of
            the parts asked for lie.
    """

    def __init__(self, graph: BitGraph, words: int, best: Best):
        """Starts without nodes.

        Args:
            graph: the graph.
            words: of a set.
            best: what is known; larger cliques are told to it.
        """
        self.words, self.unsettled, self._exhausted = words, 0, False
        self._graph, self._best = graph, best
        self._subgraphs, self._sources = Subgraphs(graph, words), []
        self._pool: list[Nodes] = []
        self._nodes = np.zeros((2 * words + 2, 0), np.uint64)
        self._busy = np.zeros(0, bool)
        self._colourings = Colourings(words)
        # By place: the set of it alone, and of those from it on.
        blocks = np.eye(words, dtype=bool).repeat(BITS, axis=1)
        later = np.triu(np.ones((words, words), bool), 1).T.repeat(BITS, axis=1)
        self._single = np.where(blocks, np.tile(SINGLE, words), np.uint64(0))
        from_here = np.tile(~(SINGLE - np.uint64(1)), words)
        self._from = np.where(blocks, from_here, np.where(later, ~np.uint64(0), np.uint64(0)))

    def run(self, parts: Iterator[Part], deadline: float) -> list[Part]:
        """Searches until little is left, a clique is large enough, or the time is over.

        Args:
            parts: to be searched, asked for when lanes are free; each has candidates, as many at
                least as it takes to improve on the best clique.
            deadline: reading of `time.perf_counter` at which to give up.

        Returns:
            what is left; when the time is over, nothing but `unsettled` tells of it.
        """
        looks = _LOOKS
        while not self._refill(parts):
            at_work = np.count_nonzero(self._busy)
            if perf_counter() > deadline:
                self.unsettled = self._united()
                break
            few = at_work < (1 if looks > 0 else _FEW)
            if few and self._exhausted and not self._pool:
                return self._handed_back()
            looks = 0 if at_work > 4 * _FEW else looks - 1
            if at_work < _BUSY * len(self._busy):
                self._rearrange(np.flatnonzero(self._busy), 0)
            self._colourings.advance(self._subgraphs.strangers, _STEPS)
            self._harvest()
        return []

    def _refill(self, parts: Iterator[Part]) -> bool:
        """Gives nodes to idle lanes, and to new ones while there are few; True to end."""
        idle = np.flatnonzero(~self._busy)
        nodes = self._taken(_WORDS // self.words - len(self._busy) + len(idle), parts)
        while nodes.shape[1] and (nodes[-1] == self._best.size).any():
            if self._improve(nodes[:, (nodes[-1] == self._best.size).argmax()]):
                return True
            nodes = self._promising(nodes)
        lanes, taken = len(self._busy), nodes.shape[1]
        if taken > len(idle):
            self._rearrange(np.arange(lanes), taken - len(idle))
            idle = np.flatnonzero(~self._busy)
        idle = idle[:taken]
        self._nodes[:, idle], self._busy[idle] = nodes, True
        classes = self._best.size - nodes[-1].astype(np.int64)
        self._colourings.start(idle, nodes[: self.words], nodes[-2], classes)
        return False

    def _taken(self, most: int, parts: Iterator[Part]) -> Nodes:
        """Nodes from the pool, the last first, and if these do not suffice from further parts."""
        waiting = sum(nodes.shape[1] for nodes in self._pool)
        if waiting < most:
            self._admit(parts, most - waiting)
        taken, count = [self._nodes[:, :0]], 0
        while self._pool and count < most:
            taken.append(self._pool.pop())
            count += taken[-1].shape[1]
        if count > most:
            last = taken.pop()
            self._pool.append(last[:, : count - most])
            taken.append(last[:, count - most :])
        return self._promising(np.concatenate(taken, axis=1))

    def _promising(self, nodes: Nodes) -> Nodes:
        """Those with candidates enough to improve on the best."""
        missing = self._best.size - nodes[-1].astype(np.int64)
        return nodes[:, _sizes(nodes[: self.words]) > missing]

    def _admit(self, parts: Iterator[Part], most: int) -> None:
        """Puts the first nodes of further parts into the pool."""
        subgraphs = self._subgraphs
        if len(subgraphs) == subgraphs.room:
            self._forget()
        most = min(most, subgraphs.room - len(subgraphs))
        admitted = list(islice(parts, most))
        self._exhausted = len(admitted) < most
        if admitted:
            nodes = np.zeros((len(self._nodes), len(admitted)), np.uint64)
            nodes[: self.words], nodes[-2] = subgraphs.add([part.candidates for part in admitted])
            nodes[-1] = [len(part.path) for part in admitted]
            self._pool.append(nodes)
            self._sources += admitted

    def _forget(self) -> None:
        """Makes room where subgraphs have no nodes left."""
        at_work, width = np.flatnonzero(self._busy), np.uint64(self._subgraphs.width)
        nodes = self._nodes.take(at_work, 1)
        live = np.unique(np.concatenate([each[-2] for each in (*self._pool, nodes)]))
        for each in (*self._pool, nodes):
            each[-2] = live.searchsorted(each[-2]) * width
        self._nodes[:, at_work] = nodes
        self._colourings.move(at_work, nodes[-2])
        slots = (live // width).astype(np.int64)
        self._subgraphs.keep(slots)
        self._sources = [self._sources[slot] for slot in slots.tolist()]

    def _improve(self, node: UInt[np.ndarray, " fields"]) -> bool:
        """Takes the path of a node and one of its candidates; True to end."""
        words, offset = self.words, int(node[-2])
        path = self._sources[offset // self._subgraphs.width].path
        inside = self._subgraphs.labels(offset, node[words : 2 * words])
        (candidate, *_) = self._subgraphs.labels(offset, node[:words])
        return self._best.take([*path, *inside, candidate])

    def _rearrange(self, lanes: Int[np.ndarray, " k"], more: int) -> None:
        """Lines up some lanes, and as many new ones behind them."""
        self._colourings.rearrange(lanes, more)
        self._nodes = lined_up(self._nodes, lanes, more)
        self._busy = lined_up(self._busy, lanes, more)

    def _harvest(self) -> None:
        """Frees the lanes whose colouring is done, and puts their branches into the pool."""
        colourings = self._colourings
        # A colour for each that is left would do.
        spared = _sizes(colourings.open) <= colourings.left
        done = np.bitwise_or.reduce(colourings.eligible, axis=0) == 0
        self._branch(np.flatnonzero(self._busy & done & ~spared))
        self._busy &= ~(done | spared)

    def _branch(self, lanes: Int[np.ndarray, " k"]) -> None:
        """Puts the branches of some lanes into the pool, where they may improve on the best."""
        words, nodes = self.words, self._nodes.take(lanes, 1)
        branches = self._colourings.open.take(lanes, 1)
        parent, place = _members(branches)
        row = self._subgraphs.row.take(place) + nodes[-2].view(np.int64).take(parent)
        # What is left: the neighbours, without the branches from this one on.
        sets = branches.take(parent, 1)
        sets &= self._from.take(place, 1)
        sets |= self._subgraphs.strangers.take(row, 1)
        np.invert(sets, out=sets)
        sets &= nodes[:words].take(parent, 1)
        missing = self._best.size - 1 - nodes[-1].view(np.int64).take(parent)
        kept = np.flatnonzero(_sizes(sets) > missing)
        if kept.size == 0:
            return
        parent, place = parent.take(kept), place.take(kept)
        inside = nodes.take(parent, 1)
        inside[:words] = sets.take(kept, 1)
        inside[words : 2 * words] |= self._single.take(place, 1)
        inside[-1] += np.uint64(1)
        self._pool.append(inside)

    def _handed_back(self) -> list[Part]:
        """The nodes at work, as parts; no lane keeps any."""
        words, parts = self.words, []
        for node in self._nodes[:, self._busy].T:
            offset = int(node[-2])
            path = self._sources[offset // self._subgraphs.width].path
            inside = self._subgraphs.labels(offset, node[words : 2 * words])
            candidates = self._subgraphs.labels(offset, node[:words])
            single = self._graph.single
            parts.append(Part([*path, *inside], sum(single[label] for label in candidates)))
        self._busy[:] = False
        self._forget()
        return parts

    def _united(self) -> int:
        """The labels of all parts with nodes left."""
        offsets = np.concatenate([each[-2] for each in (*self._pool, self._nodes[:, self._busy])])
        united = 0
        for slot in np.unique(offsets // np.uint64(self._subgraphs.width)).tolist():
            path, candidates = self._sources[slot]
            united |= candidates | sum(self._graph.single[label] for label in path)
        return united


def _sizes(sets: UInt[np.ndarray, "w k"]) -> UInt[np.ndarray, " k"]:
    counts = np.bitwise_count(sets)
    return counts[0] if len(counts) == 1 else counts.sum(axis=0, dtype=np.uint16)


def _members(
    sets: UInt[np.ndarray, "w k"],
) -> tuple[Int[np.ndarray, " members"], Int[np.ndarray, " members"]]:
    """Every member of every set: which set, and its place."""
    found = [np.flatnonzero(np.unpackbits(word.view(np.uint8), bitorder="little")) for word in sets]
    places = [(bit & BITS - 1) + BITS * word for word, bit in enumerate(found)]
    return np.concatenate(found) >> 6, np.concatenate(places)
