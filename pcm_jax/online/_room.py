"""Arrays that grow at their end, with room for more, so that what is there is seldom copied."""

from __future__ import annotations

from typing import Any

import numpy as np

from pcm_jax import lie


class Room:
    """Buffers, by name, in which arrays grow.

    A row is written once. Whoever holds the rows before a new one keeps them as they are, and if
    these grow once more, otherwise, they are copied first.
    """

    def __init__(self) -> None:
        self._buffers: dict[str, tuple[np.ndarray, int]] = {}

    def behind(self, name: str, before: Any, new: Any) -> np.ndarray:
        """The rows of before and, behind them, new ones.

        Args:
            name: of the array that grows.
            before: `[n, …]`.
            new: `[k, …]`.
        """
        before, new = np.asarray(before), np.asarray(new)
        count, total, dtype = len(before), len(before) + len(new), np.result_type(before, new)
        buffer, end = self._buffers.get(name, (before, -1))
        goes_on = end == count and before.base is buffer and buffer.dtype == dtype
        if not goes_on or total > len(buffer):
            buffer = np.empty((2 * total, *before.shape[1:]), dtype)
            buffer[:count] = before
        buffer[count:total] = new
        self._buffers[name] = buffer, total
        return buffer[:total]

    def transforms_behind(self, name: str, before: Any, new: Any) -> Any:
        """The same of Lie `[n]` and `[k]`."""
        rows = self.behind(name, *(lie.parameters(lie.as_numpy(each)) for each in (before, new)))
        return lie.group_of(before)(rows)
