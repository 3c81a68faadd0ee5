"""Results are found by content, and what is kept is bounded in number and in memory."""

from __future__ import annotations

import itertools
import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np

from pcm_jax.sparse._pattern_cache import PatternCache, array_bytes


def keys(*starts: int) -> list[np.ndarray]:
    return [np.arange(start, start + 3) for start in starts]


def test_equal_patterns_share_a_result():
    cache: PatternCache[int] = PatternCache()
    numbers = itertools.count()
    found = [cache.get(lambda: next(numbers), key, 5) for key in keys(0, 0, 1, 0)]
    assert found == [0, 0, 1, 0]
    assert cache.get(lambda: next(numbers), keys(0)[0], None) == 2
    assert cache.get(lambda: next(numbers), keys(0)[0].astype(np.int32), 5) == 0


def test_a_part_that_is_none_is_no_array():
    """Neither of no entries, nor of one, whatever stands beside it."""
    cache: PatternCache[int] = PatternCache()
    numbers = itertools.count()
    none, empty, one = None, np.zeros(0, int), np.ones(1, int)
    patterns = [(none, one), (one, none), (empty, one), (one, empty), (none, empty), (empty, none)]
    found = [cache.get(lambda: next(numbers), *pattern) for pattern in patterns]
    assert found == list(range(6))


def test_the_least_recently_used_goes_first():
    cache: PatternCache[int] = PatternCache(size=2)
    numbers = itertools.count()
    found = [cache.get(lambda: next(numbers), key) for key in keys(0, 1, 0, 2, 0, 1)]
    assert found == [0, 1, 0, 2, 0, 3]


def test_memory_is_bounded_but_for_the_latest():
    cache: PatternCache[np.ndarray] = PatternCache(nbytes=1_000)
    made: list[int] = []

    def get(size: int, start: int) -> None:
        def make() -> np.ndarray:
            made.append(start)
            return np.zeros(size, np.uint8)

        cache.get(make, *keys(start))

    get(400, 0), get(400, 1), get(400, 2)  # the third turns the first out
    get(400, 1), get(400, 2)
    assert made == [0, 1, 2]
    get(5_000, 3), get(5_000, 3)
    assert made == [0, 1, 2, 3]
    get(400, 2)
    assert made == [0, 1, 2, 3, 2]


def test_arrays_are_counted_once_wherever_they_lie():
    array = np.zeros(100)
    view = array[::2]
    node = SimpleNamespace(first=array, parts=(view, {"again": array}), number=3)
    node.itself = node
    assert array_bytes(node) == array.nbytes
    assert array_bytes([np.zeros(10), np.zeros(10)]) == 160


def test_threads_that_ask_at_once_get_one_result():
    cache: PatternCache[object] = PatternCache()
    together = threading.Barrier(8)

    def make() -> object:
        together.wait(30)  # every thread makes its own: one of them is kept
        return object()

    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda _: cache.get(make, keys(0)[0]), range(8)))
    assert len({id(each) for each in found}) == 1


def test_bounds_hold_in_threads():
    cache: PatternCache[np.ndarray] = PatternCache(size=5, nbytes=1_000)

    def ask(start: int) -> int:
        return cache.get(lambda: np.full(100, start, np.uint8), *keys(start))[0]

    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(ask, [k % 20 for k in range(400)]))
    assert found == [k % 20 for k in range(400)]
    assert cache.nbytes == 500


def test_clearing_forgets_everything():
    cache: PatternCache[int] = PatternCache()
    numbers = itertools.count()
    for _ in range(2):
        cache.get(lambda: next(numbers), keys(0)[0])
        cache.clear()
    assert next(numbers) == 2
