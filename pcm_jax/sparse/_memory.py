"""Memory for one factorisation after another."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from jaxtyping import Float

MOST = 8
"""Arrays kept between factorisations: as many as may be at work in threads of their own."""


class SpareMemory:
    """Arrays that one factorisation leaves to the next, until `free`; never more than `MOST`.

    JAX calls back from one thread and another, and memory that one has freed is not for the others:
    without this a solve takes several times what its factor takes.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._idle: list[np.ndarray] = []

    @contextmanager
    def borrow(self, scalars: int, *, last: bool = False) -> Iterator[Float[np.ndarray, " s"]]:
        """`scalars` float64 numbers of any value, for the scope's length.

        Args:
            scalars: how many.
            last: whether this was the last of a solve's factorisations, so that nothing is kept.
        """
        with self._lock:
            memory = self._idle.pop() if self._idle else np.empty(0)
        if len(memory) < scalars:
            memory = np.empty(scalars)
        try:
            yield memory[:scalars]
        finally:
            with self._lock:
                if last:
                    self._idle.clear()
                elif len(self._idle) < MOST:
                    self._idle.append(memory)

    def free(self) -> None:
        """Gives back what is kept; what is borrowed comes back to be kept until the next time."""
        with self._lock:
            self._idle.clear()

    @property
    def nbytes(self) -> int:
        """Bytes kept and not borrowed."""
        with self._lock:
            return sum(memory.nbytes for memory in self._idle)
