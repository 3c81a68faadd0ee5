"""What depends on a sparsity pattern alone is made once and then found by the pattern's content."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

T = TypeVar("T")


class PatternCache(Generic[T]):
    """The most recently used results, by the content of integer arrays.

    Args:
        size: how many to keep.
    """

    def __init__(self, size: int):
        self._size = size
        self._kept: OrderedDict[bytes, T] = OrderedDict()

    def get(self, make: Callable[[], T], *pattern: np.ndarray | int | None) -> T:
        """The result for `pattern`, by `make()` unless it is kept already."""
        digest = hashlib.blake2b(digest_size=16)
        for part in pattern:
            values = np.ascontiguousarray([] if part is None else part, np.int64)
            digest.update(np.int64(-1 if part is None else values.size).tobytes())
            digest.update(values.tobytes())
        key = digest.digest()
        result = self._kept.pop(key) if key in self._kept else make()
        self._kept[key] = result
        while len(self._kept) > self._size:
            self._kept.popitem(last=False)
        return result
