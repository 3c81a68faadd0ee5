"""Greedy colourings of many small sets side by side, a vertex of each at a time.

What `BitGraph.uncoloured` does with one set. All lanes do the same at each step, whatever they are
at: a lane takes the lowest vertex that may join its present class of colour, and where there is
none left it opens the next class. Masks take the place of conditions, since NumPy's own (`where=`)
cost ten times an arithmetic operation where the lanes differ.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Int, UInt

from pcm_jax.clique._subgraphs import DE_BRUIJN, HASH_SHIFT

# Of the octet in which classes are counted; fewer classes only leave more to branch on.
_MOST_CLASSES = 255

_OFFSET_BITS = np.uint64(6)
_NONE = np.uint64(0)


class Colourings:
    """Colourings under way, one in each of n lanes.

    Attributes:
        open: uint64 [w, n], the vertices without a colour.
        eligible: uint64 [w, n], those that may join the present class; none once the lane is done.
        left: uint8 [n], the classes that may be opened after the present one.
    """

    def __init__(self, words: int):
        self.open = np.zeros((words, 0), np.uint64)
        self.eligible = self.open.copy()
        self.left = np.zeros(0, np.uint8)
        self._first_row = np.zeros(0, np.uint64)
        self._make_scratch()

    def rearrange(self, lanes: Int[np.ndarray, " k"], more: int) -> None:
        """Lines up some lanes, and as many new ones behind them, without a set."""
        self.open, self.eligible, self.left, self._first_row = (
            np.concatenate(
                [each.take(lanes, -1), np.zeros((*each.shape[:-1], more), each.dtype)], -1
            )
            for each in (self.open, self.eligible, self.left, self._first_row)
        )
        self._make_scratch()

    def start(
        self,
        lanes: Int[np.ndarray, " k"],
        sets: UInt[np.ndarray, "w k"],
        first_row: UInt[np.ndarray, " k"],
        classes: Int[np.ndarray, " k"],
    ) -> None:
        """Gives new sets to some lanes.

        Args:
            lanes: which.
            sets: to be coloured.
            first_row: of the strangers of each lane's vertices.
            classes: colours that there are, at least one.
        """
        self.open[:, lanes] = self.eligible[:, lanes] = sets
        self.left[lanes] = np.minimum(classes - 1, _MOST_CLASSES)
        self.move(lanes, first_row)

    def move(self, lanes: Int[np.ndarray, " k"], first_row: UInt[np.ndarray, " k"]) -> None:
        """Tells some lanes where their strangers are now."""
        self._first_row[lanes] = first_row

    def advance(self, strangers: UInt[np.ndarray, "w rows"], steps: int) -> None:
        """Colours one vertex in each lane at every step."""
        lowest: np.ndarray = self._sets[0]
        near: np.ndarray = self._sets[1]
        row = self._word.view(np.int64)
        for _ in range(steps):
            self._look_up()
            self.open ^= lowest
            for word, rows in zip(near, strangers, strict=True):
                rows.take(row, None, word, "clip")
            self.eligible &= near
            self._open_classes()

    def _make_scratch(self) -> None:
        words, lanes = self.open.shape
        self._sets = np.empty((2, words, lanes), np.uint64)
        self._word, self._carry, self._mask = np.empty((3, lanes), np.uint64)
        self._flag, self._other = np.empty((2, lanes), bool)

    def _look_up(self) -> None:
        """Finds the lowest eligible vertices, as sets and by the row of their strangers."""
        lowest, word = self._sets[0], self._word
        self._negate(lowest)
        lowest &= self.eligible
        _unite(lowest, word)
        word *= DE_BRUIJN
        word >>= HASH_SHIFT
        word += self._first_row
        if len(lowest) > 1:
            self._mask <<= _OFFSET_BITS
            word += self._mask

    def _negate(self, out: np.ndarray) -> None:
        """Writes the two's complement over all words; in `_mask`, how many empty words lead."""
        eligible, flag, other = self.eligible, self._flag, self._other
        np.negative(eligible[0], out=out[0])
        if len(out) == 1:
            return
        np.invert(eligible[1:], out=out[1:])
        np.equal(eligible[0], _NONE, out=flag)
        np.copyto(self._mask, flag.view(np.uint8))
        out[1] += self._mask
        for before, here in zip(eligible[1:], out[2:], strict=False):
            np.equal(before, _NONE, out=other)
            flag &= other
            np.copyto(self._carry, flag.view(np.uint8))
            np.add(here, self._carry, out=here)
            self._mask += self._carry

    def _open_classes(self) -> None:
        """Begins a new class in lanes without eligible vertices, if one is left."""
        near, flag = self._sets[1], self._flag.view(np.uint8)
        np.equal(_unite(self.eligible, self._word), _NONE, out=self._flag)
        np.minimum(self.left, flag, out=flag)
        self.left -= flag
        # 0 or 1 becomes the mask of no bit or of all.
        np.negative(flag.view(np.int8), out=flag.view(np.int8))
        np.copyto(self._mask.view(np.int64), flag.view(np.int8))
        np.bitwise_and(self.open, self._mask, out=near)
        self.eligible |= near


def _unite(sets: np.ndarray, out: np.ndarray) -> np.ndarray:
    """The words of each set in one; NumPy's own `reduce` takes three times as long."""
    first, *others = sets
    second = others.pop(0) if others else first
    np.bitwise_or(first, second, out=out)
    for word in others:
        out |= word
    return out


def lined_up(values: np.ndarray, lanes: Int[np.ndarray, " k"], more: int) -> np.ndarray:
    """Lines up the columns of some lanes, and as many empty ones behind them."""
    nothing = np.zeros((*values.shape[:-1], more), values.dtype)
    return np.concatenate([values.take(lanes, -1), nothing], axis=-1)
