"""Small subgraphs of one graph, relabelled, as machine words that NumPy looks up by the thousand.

A subgraph of up to 64 w vertices has a row of w words for each: those it is not adjacent to. Bit b
of word j stands for the vertex in place 64 j + b; places are in the order of falling degree within
the subgraph, so that a colouring from the lowest bit begins where the subgraph is densest.

The lowest bit of a word is looked up by its hash: a power of two times a de Bruijn number shows the
exponent in the product's highest six bits (C. Leiserson, H. Prokop and K. Randall, "Using de Bruijn
sequences to index a 1 in a computer word", 1998). Rows lie in the order of the hash.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Int, UInt

if TYPE_CHECKING:
    from pcm_jax.clique._exact import BitGraph

BITS = 64
DE_BRUIJN = np.uint64(0x04DECE3F2E915A86)
HASH_SHIFT = np.uint64(58)
SINGLE = np.uint64(1) << np.arange(BITS, dtype=np.uint64)
_HASH = ((SINGLE * DE_BRUIJN) >> HASH_SHIFT).astype(np.int64)

# What all rows may take: with the lanes' own arrays, about a second-level cache.
_BYTES = 4_000_000
# Of the vertices' rows that are gathered at a time.
_GATHERED = 1_000_000


class Subgraphs:
    """The subgraphs in use; each is known by its offset, the index of its first row.

    Attributes:
        words: w, of every row.
        width: places in a subgraph, and its rows.
        row: int64 [width], by place, the row within the subgraph.
        room: how many subgraphs there may be.
        strangers: uint64 [w, room · width], those neither adjacent nor the vertex itself.
    """

    def __init__(self, graph: BitGraph, words: int):
        self.words, self.width = words, BITS * words
        self.row = (_HASH + BITS * np.arange(words)[:, None]).ravel()
        self.room = _BYTES // (8 * words * self.width)
        self.strangers = np.empty((words, self.room * self.width), np.uint64)
        self._labels: list[Int[np.ndarray, " k"]] = []
        count = len(graph.vertices)
        self._octets = -(-count // BITS) * BITS // 8
        packed = b"".join(each.to_bytes(self._octets, "little") for each in graph.strangers[1:])
        self._packed = np.frombuffer(packed, np.uint8).reshape(count, self._octets)
        self._bit = np.resize(1 << np.arange(8, dtype=np.uint8), count)
        lowest = b"".join(
            ((1 << size) - 1).to_bytes(8 * words, "little") for size in range(self.width + 1)
        )
        self._lowest = np.frombuffer(lowest, np.uint64).reshape(-1, words).T

    def __len__(self) -> int:
        return len(self._labels)

    def add(self, sets: list[int]) -> tuple[UInt[np.ndarray, "w k"], UInt[np.ndarray, " k"]]:
        """Takes in the subgraphs of some sets of up to `width` labels.

        Returns:
            the sets in the words of their subgraphs, and the subgraphs' offsets.
        """
        most = max(1, _GATHERED // (self._octets * self.width))
        sizes = [self._add(sets[start : start + most]) for start in range(0, len(sets), most)]
        offsets = np.arange(len(self) - len(sets), len(self), dtype=np.uint64) * np.uint64(
            self.width
        )
        return self._lowest.take(np.concatenate(sizes), axis=1), offsets

    def _add(self, sets: list[int]) -> Int[np.ndarray, " k"]:
        """Takes in some subgraphs; returns their numbers of vertices."""
        raw = b"".join(each.to_bytes(self._octets, "little") for each in sets)
        octets = np.frombuffer(raw, np.uint8).reshape(len(sets), self._octets)
        bits = np.unpackbits(octets, axis=1, bitorder="little")[:, ::-1]
        subgraph, vertex = np.nonzero(bits)
        vertex = bits.shape[1] - 1 - vertex
        rows = self._packed.take(vertex, 0)
        inside = (rows & octets.take(subgraph, 0)).view(np.uint64)
        missing = np.bitwise_count(inside).sum(axis=1, dtype=np.int64)
        order = (missing + subgraph * self.width).argsort(kind="stable")
        vertex, rows = vertex.take(order), rows.take(order, 0)
        sizes = np.bincount(subgraph, minlength=len(sets))
        first = np.cumsum(sizes) - sizes
        packed = np.zeros((len(vertex), 8 * self.words), np.uint8)
        for start, size in zip(first.tolist(), sizes.tolist(), strict=True):
            here = slice(start, start + size)
            labels = vertex[here]
            # No bit of another vertex survives, and `packbits` asks only for one that is not 0.
            pairs = rows[here].take(labels >> 3, 1)
            pairs &= self._bit.take(labels)
            packed[here, : size + 7 >> 3] = np.packbits(pairs, axis=1, bitorder="little")
            self._labels.append(labels + 1)
        slots = np.arange(len(self) - len(sets), len(self)) * self.width
        places = np.arange(len(vertex)) - first.repeat(sizes)
        self.strangers[:, slots.repeat(sizes) + self.row.take(places)] = packed.view(np.uint64).T
        return sizes

    def labels(self, offset: int, members: UInt[np.ndarray, " w"]) -> list[int]:
        """The labels of a set in the words of a subgraph."""
        octets = np.ascontiguousarray(members).view(np.uint8)
        places = np.flatnonzero(np.unpackbits(octets, bitorder="little"))
        return self._labels[offset // self.width][places].tolist()

    def keep(self, slots: Int[np.ndarray, " k"]) -> None:
        """Forgets all subgraphs but those at offsets `slots · width`, ascending; these move up."""
        self._labels = [self._labels[slot] for slot in slots.tolist()]
        for rows in self.strangers:
            subgraphs = rows.reshape(-1, self.width)
            subgraphs[: len(slots)] = subgraphs[slots]
