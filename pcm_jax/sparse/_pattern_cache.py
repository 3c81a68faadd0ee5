"""A cache of what depends on a sparsity pattern alone, found again by the pattern's content."""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

T = TypeVar("T")

RESULTS = 2048  # small ones: a batch may hold as many patterns
BYTES = 256 << 20  # a plan of City10000 takes 17 MB, and a sweep of merges meets hundreds of plans


class _Kept(NamedTuple):
    """A result and the memory that its arrays take."""

    result: Any
    nbytes: int


class PatternCache(Generic[T]):
    """The most recently used results, by the content of integer arrays; safe in any thread.

    Args:
        size: how many to keep.
        nbytes: how much memory they may take together; the latest is kept whatever it takes.
    """

    def __init__(self, size: int = RESULTS, nbytes: int = BYTES):
        self._size, self._limit = size, nbytes
        self._kept: OrderedDict[bytes, _Kept] = OrderedDict()
        self._nbytes = 0
        self._lock = threading.Lock()

    def get(self, make: Callable[[], T], *pattern: np.ndarray | int | None) -> T:
        """The result for `pattern`, by `make()` unless it is kept already.

        Threads that ask for one pattern at the same time may each make it; all get the first.
        """
        key = _digest(pattern)
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key].result
        result = make()
        return self._keep(key, _Kept(result, array_bytes(result)))

    @property
    def nbytes(self) -> int:
        """Memory that the arrays of all results take."""
        with self._lock:
            return self._nbytes

    def clear(self) -> None:
        """Forgets everything."""
        with self._lock:
            self._kept.clear()
            self._nbytes = 0

    def _keep(self, key: bytes, made: _Kept) -> T:
        with self._lock:
            kept = self._kept.setdefault(key, made)
            self._kept.move_to_end(key)
            if kept is made:
                self._nbytes += made.nbytes
            while len(self._kept) > 1 and self._is_full():
                self._nbytes -= self._kept.popitem(last=False)[1].nbytes
            return kept.result

    def _is_full(self) -> bool:
        return len(self._kept) > self._size or self._nbytes > self._limit


def _digest(pattern: Iterable[np.ndarray | int | None]) -> bytes:
    digest = hashlib.blake2b(digest_size=16)
    for part in pattern:
        values = np.ascontiguousarray([] if part is None else part, np.int64)
        digest.update(np.int64(-1 if part is None else values.size).tobytes())
        digest.update(values.data)
    return digest.digest()


def array_bytes(tree: Any) -> int:
    """Bytes of all arrays that an object holds, each counted once."""
    seen: set[int] = set()

    def count(node: Any) -> int:
        if id(node) in seen:
            return 0
        seen.add(id(node))
        if isinstance(node, np.ndarray):
            return node.nbytes if node.base is None else count(node.base)
        return sum(count(part) for part in _parts(node))

    return count(tree)


def _parts(node: Any) -> Iterable[Any]:
    if isinstance(node, dict):
        return node.values()
    if isinstance(node, (list, tuple)):
        return node
    return getattr(node, "__dict__", {}).values()
