"""What depends on a sparsity pattern alone is made once and then found by the pattern's content."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

T = TypeVar("T")

RESULTS = 64
BYTES = 256 << 20  # a plan of City10000 takes 17 MB, and a sweep of merges meets hundreds of plans


class _Kept(NamedTuple):
    """A result and the memory that its arrays take."""

    result: Any
    nbytes: int


class PatternCache(Generic[T]):
    """The most recently used results, by the content of integer arrays.

    Args:
        size: how many to keep.
        nbytes: how much memory they may take together; the latest is kept whatever it takes.
    """

    def __init__(self, size: int = RESULTS, nbytes: int = BYTES):
        self._size, self._nbytes = size, nbytes
        self._kept: OrderedDict[bytes, _Kept] = OrderedDict()

    def get(self, make: Callable[[], T], *pattern: np.ndarray | int | None) -> T:
        """The result for `pattern`, by `make()` unless it is kept already."""
        digest = hashlib.blake2b(digest_size=16)
        for part in pattern:
            values = np.ascontiguousarray([] if part is None else part, np.int64)
            digest.update(np.int64(-1 if part is None else values.size).tobytes())
            digest.update(values.tobytes())
        key = digest.digest()
        if key in self._kept:
            kept = self._kept.pop(key)
        else:
            result = make()
            kept = _Kept(result, array_bytes(result))
        self._kept[key] = kept
        while len(self._kept) > 1 and self._is_full():
            self._kept.popitem(last=False)
        return kept.result

    def _is_full(self) -> bool:
        total = sum(kept.nbytes for kept in self._kept.values())
        return len(self._kept) > self._size or total > self._nbytes


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
