"""The maximum clique of a graph whose vertices come and go, proven after every step.

A vertex that comes raises the size ω by at most one, and only as a member: if its neighbours hold a
clique of ω. If they hold the whole clique in hand, that is seen at once; else only those count that
have ω − 1 others among them, which leaves nothing of a vertex that few agree with. A vertex that
goes lowers ω by at most one, and only if it was in every maximum clique: the search is then for one
of ω, and ends with its first success.

Of several maximum cliques the first by index is the one of `maximum_clique`. It changes only by
vertices that come or leave it: with C the first so far and v a new vertex,

    ω stays    the first is C or a clique with v as its last member, whichever is smaller
    ω rises    every maximum clique holds v; if v agrees with all of C, C and v are the first

since a clique of ω among v's neighbours was one of those of which C is the first.
"""

from __future__ import annotations

import math
from contextlib import suppress
from time import perf_counter

import numpy as np
from jaxtyping import Bool, Int

from pcm_jax.clique._exact import BitGraph, largest_clique
from pcm_jax.clique._ties import smallest_by_index
from pcm_jax.clique.maximum import maximum_clique
from pcm_jax.clique.result import Clique

STEPS = 256
"""Branches of the search at a vertex that comes: some milliseconds. What they do not decide waits
until it is asked for, and is then decided for all vertices that came by one search."""
SEARCHED = 400
"""Vertices left, up to which that search is made at all: of more it hardly ever decides."""
ROWS = 1024
"""Rows of a graph that are unpacked between two looks at the clock."""
FEW = 8
"""Vertices that came, up to which the first clique is looked for among the neighbours of each."""
UNDECIDED = -1


class GrowingClique:
    """A graph of vertices 0 … m − 1, the last one the newest, and its maximum clique.

        growing = GrowingClique()
        for row in graph:
            growing.add(row[: len(growing)])
        growing.first()                 # as maximum_clique(graph).members

    A vertex that goes moves those behind it up by one. A proof that takes longer waits until `size`
    or `first` is asked for, so that no step costs much, and no answer more than a whole search.
    """

    def __init__(self) -> None:
        self._near: list[int] = []
        self._members = 0
        self._most = 0  # no clique is larger
        self._first: int | None = 0  # the first by index as of the vertices before `_since`
        self._since: list[int] = []

    def __len__(self) -> int:
        return len(self._near)

    def __repr__(self) -> str:
        known = self._members.bit_count()
        told = f"{known}" if known == self._most else f"{known} to {self._most}"
        return f"GrowingClique({len(self)} vertices, largest clique {told})"

    @classmethod
    def of_graph(cls, graph: Bool[np.ndarray, "m m"]) -> GrowingClique:
        """Starts from a graph, whose largest clique is searched for when it is asked for.

        Args:
            graph: symmetric, the diagonal false.
        """
        growing = cls()
        packed = np.packbits(graph, axis=1, bitorder="little")
        growing._near = [int.from_bytes(row.tobytes(), "little") for row in packed]
        if growing._near:
            degree = [near.bit_count() for near in growing._near]
            growing._members, growing._first = growing._greedy(degree.index(max(degree))), None
            growing._most = 1 + max(degree)
        return growing

    def copy(self) -> GrowingClique:
        """Copies the state: sets are numbers, so this costs a list."""
        twin = GrowingClique()
        twin._near, twin._members, twin._most = list(self._near), self._members, self._most
        twin._first, twin._since = self._first, list(self._since)
        return twin

    @property
    def size(self) -> int:
        """Members of a maximum clique, ω."""
        self._settle()
        return self._most

    def rows(self) -> list[int]:
        """The neighbours of each vertex as a set: bit v stands for vertex v."""
        return self._near

    def dense(self) -> Bool[np.ndarray, "m m"]:
        """The graph, bool `[m, m]`."""
        return self._table(np.arange(len(self)))

    def add(self, agrees: Bool[np.ndarray, " m"]) -> int:
        """Adds a vertex, and returns it.

        Args:
            agrees: `[m]`, the vertices so far that it is adjacent to.
        """
        vertex, near, known = len(self), _as_set(agrees), self._members.bit_count()
        own, settled = 1 << vertex, known == self._most
        self._near.append(near)
        for other in np.flatnonzero(agrees).tolist():
            self._near[other] |= own
        found = self._members if self._members & ~near == 0 else self._clique(near, known, STEPS)
        self._most += found is not None
        if found == UNDECIDED:
            found = self._exchanged(near, own)
            settled = False
        if found is None or found == UNDECIDED:
            self._since.append(vertex)
        else:
            self._grow(own, near, found, settled)
        return vertex

    def remove(self, vertex: int) -> None:
        """Takes a vertex away; those behind it move up by one."""
        own = 1 << vertex
        self._since = [other - (other > vertex) for other in self._since if other != vertex]
        if self._first is not None and self._first & own:
            self._first = None
        if self._members & own:
            self._members = self._members ^ own if self._first is None else self._first
        del self._near[vertex]
        self._near = [_without(near, vertex) for near in self._near]
        self._members = _without(self._members, vertex)
        self._first = None if self._first is None else _without(self._first, vertex)
        self._most = min(self._most, len(self))
        if not self._members and self._near:
            self._members = 1

    def first(self, deadline: float = math.inf) -> Bool[np.ndarray, " m"]:
        """The maximum clique that is the first by index, as a mask.

        Args:
            deadline: reading of `time.perf_counter` after which any maximum clique is, once its
                size is known.
        """
        self._settle()
        with suppress(TimeoutError):
            self._find_first(deadline)
        in_time = perf_counter() < deadline
        self._since, self._first = [], self._members if in_time else None
        return _as_mask(self._members, len(self))

    def _find_first(self, deadline: float) -> None:
        """Takes the first maximum clique by index into hand; at the deadline perhaps another."""
        size = self._most
        earlier = {v: self._near[v] & ((1 << v) - 1) for v in self._since}
        if self._first is None or len(earlier) > FEW:
            whole = (1 << len(self)) - 1
            found = self._clique(whole, size, known=self._members, first=True, deadline=deadline)
            self._members, earlier = found or 0, {}
        else:
            self._members = self._first
        for vertex, near in earlier.items():
            found = self._clique(near, size - 1, first=True, deadline=deadline)
            if found is None or found == UNDECIDED:
                continue
            if _precedes(found | 1 << vertex, self._members):
                self._members = found | 1 << vertex

    def largest(self, time_limit: float = math.inf) -> Clique:
        """The maximum clique that is the first by index, or the best by a time.

        Args:
            time_limit: seconds. If they are over, the clique is the largest one that is known, and
                the search goes on from it when asked again.
        """
        start = perf_counter()
        with suppress(TimeoutError):
            self._settle(start + time_limit)
        size, most = self._members.bit_count(), self._most
        members = _as_mask(self._members, len(self))
        if size == most:
            members = self.first(start + time_limit)
        spent = perf_counter() - start
        return Clique(members, size, size == most, most, spent, size, most)

    def _greedy(self, start: int) -> int:
        """A clique that no vertex can be added to, from one vertex on by index."""
        members, candidates = 1 << start, self._near[start]
        while candidates:
            lowest = candidates & -candidates
            members |= lowest
            candidates &= self._near[lowest.bit_length() - 1]
        return members

    def _exchanged(self, near: int, own: int) -> int:
        """A clique of all but one of those in hand and one more, with which a new vertex agrees."""
        stays = self._members & near
        if stays.bit_count() != self._members.bit_count() - 1:
            return UNDECIDED
        common = near
        for vertex in np.flatnonzero(_as_mask(stays, len(self))).tolist():
            common &= self._near[vertex]
        return stays | common & -common if common else UNDECIDED

    def _grow(self, own: int, near: int, found: int, settled: bool) -> None:
        self._members = found | own
        first = self._first if settled and not self._since else None
        self._first = None if first is None or first & ~near else first | own
        self._since = []

    def _settle(self, deadline: float = math.inf) -> None:
        """Closes the gap between the clique in hand and the bound on the largest.

        Raises:
            TimeoutError: at the deadline, before a search has begun.
        """
        known = self._members.bit_count()
        if known == self._most:
            return
        found = self._clique((1 << len(self)) - 1, known + 1, STEPS, deadline=deadline)
        if found is not None:
            self._first, self._since = None, []
            if found == UNDECIDED or known + 1 < self._most:
                graph = self._table(np.arange(len(self)), deadline)
                left = max(0.0, deadline - perf_counter())
                whole = maximum_clique(graph, time_limit=left)
                found = _as_set(whole.members)
                if perf_counter() >= deadline:
                    self._members = found if whole.size > known else self._members
                    self._most = min(self._most, whole.upper_bound)
                    return
                self._first = found
            self._members = found
        self._most = self._members.bit_count()

    def _clique(
        self,
        candidates: int,
        size: int,
        steps: float = math.inf,
        *,
        known: int | None = None,
        first: bool = False,
        deadline: float = math.inf,
    ) -> int | None:
        """A clique of some size among candidates; None where none is, or `UNDECIDED`.

        Args:
            candidates: a set of vertices.
            size: of the clique.
            steps: of the search, at most.
            known: such a clique, if one is known.
            first: whether it has to be the first by index, of candidates that hold none larger.
            deadline: of the search for that one, or of one without end.

        Raises:
            TimeoutError: at the deadline, before a search has begun.
        """
        if size == 0:
            return 0
        vertices = self._inside(candidates, size - 1, deadline)
        if len(vertices) < size:
            return None
        if len(vertices) > SEARCHED and steps < math.inf:
            return UNDECIDED
        graph = BitGraph(self._table(vertices, deadline), deadline=deadline)
        if known is None:
            outcome = largest_clique(
                graph, graph.everything, size - 1, ceiling=size, steps=steps, deadline=deadline
            )
            if outcome.labels is None and outcome.unsettled:
                return UNDECIDED
            labels = outcome.labels
        else:
            inside = np.flatnonzero(_as_mask(known, len(self)))
            labels = graph.labels_of(np.searchsorted(vertices, inside))
        if labels is not None and first:
            labels = smallest_by_index(graph, labels, deadline)
        return None if labels is None else _set_of(vertices[graph.vertices_of(labels)])

    def _inside(self, candidates: int, degree: int, deadline: float) -> Int[np.ndarray, " n"]:
        """Candidates with so many neighbours among them, ascending."""
        vertices = np.flatnonzero(_as_mask(candidates, len(self)))
        while len(vertices) > degree:
            if perf_counter() > deadline:
                raise TimeoutError
            few = [
                v for v in vertices.tolist() if (self._near[v] & candidates).bit_count() < degree
            ]
            if not few:
                return vertices
            candidates &= ~_set_of(np.array(few))
            vertices = np.setdiff1d(vertices, few, assume_unique=True)
        return vertices[:0]

    def _table(
        self, vertices: Int[np.ndarray, " n"], deadline: float = math.inf
    ) -> Bool[np.ndarray, "n n"]:
        """The graph of some vertices, some rows at a time."""
        count, size = len(self), -(-len(self) // 8)
        table = np.empty((len(vertices), len(vertices)), np.bool_)
        for start in range(0, len(vertices), ROWS):
            if perf_counter() > deadline:
                raise TimeoutError
            chosen = vertices[start : start + ROWS].tolist()
            raw = b"".join(self._near[v].to_bytes(size, "little") for v in chosen)
            packed = np.frombuffer(raw, np.uint8).reshape(len(chosen), size)
            rows = np.unpackbits(packed, axis=1, count=count, bitorder="little").view(np.bool_)
            table[start : start + ROWS] = rows if len(vertices) == count else rows[:, vertices]
        return table


def _as_set(mask: Bool[np.ndarray, " m"]) -> int:
    return int.from_bytes(np.packbits(mask, bitorder="little").tobytes(), "little")


def _as_mask(members: int, count: int) -> Bool[np.ndarray, " m"]:
    raw = np.frombuffer(members.to_bytes(-(-count // 8), "little"), np.uint8)
    return np.unpackbits(raw, count=count, bitorder="little").view(np.bool_)


def _set_of(vertices: Int[np.ndarray, " n"]) -> int:
    found = 0
    for vertex in vertices.tolist():
        found |= 1 << vertex
    return found


def _without(members: int, vertex: int) -> int:
    """The set of those that are left when a vertex has gone, by their new numbers."""
    return members >> vertex + 1 << vertex | members & (1 << vertex) - 1


def _precedes(left: int, right: int) -> bool:
    """True if the smallest vertex that only one of two sets has is in the left one."""
    different = left ^ right
    return bool(left & different & -different)
