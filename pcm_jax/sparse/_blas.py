"""The number of BLAS threads: a setting of the whole process, changed by one owner.

BLAS runs on one thread except in large fronts: threading products of tiny matrices costs an order
of magnitude. Two threads of a program that each set the number and put back what they found would
leave the process at the wrong one, and the last bits of large fronts would depend on who else was
at work. So here sections on one thread share the setting, sections on many exclude all others.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@functools.cache
def _libraries() -> tuple[Any, ...]:
    """Handles of the BLAS libraries in use: NumPy's and SciPy's."""
    import scipy.linalg  # noqa: F401  (loads SciPy's own BLAS, so that it is found)
    from threadpoolctl import ThreadpoolController

    return tuple(ThreadpoolController().select(user_api="blas").lib_controllers)


def _is_per_thread(library: Any) -> bool:
    """True where the setting is each thread's own: OpenBLAS on OpenMP."""
    return getattr(library, "threading_layer", None) == "openmp"


def _set_threads(library: Any, number: int) -> None:
    """Sets the number, from whichever thread.

    Newer versions of threadpoolctl let one thread at a time do so, and ignore all others silently.
    """
    release = getattr(library, "clear_controlling_thread", lambda **_: None)
    release(force=True)
    library.set_num_threads(number)
    release(force=True)


class _Held(threading.local):
    """The sections that the current thread is in, and its own settings outside them."""

    depth = 0
    many = False
    before: tuple[int, ...] = ()


class BlasThreads:
    """Scopes in which BLAS uses one thread, or as many as the user allows.

    The user's own setting is in force outside all scopes, and inside `many`.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._sharing = 0  # threads in `one`
        self._waiting = 0  # threads that want `many`, ahead of those that want `one`
        self._alone = False  # a thread is in `many`
        self._before: tuple[int, ...] = ()  # the user's settings, while anyone shares
        self._held = _Held()

    @contextmanager
    def one(self) -> Iterator[None]:
        """A scope of one thread for BLAS, in any number of the program's threads at once."""
        held = self._held
        if held.depth == 0 and not held.many:
            self._share()
        held.depth += 1
        try:
            yield
        finally:
            held.depth -= 1
            if held.depth == 0 and not held.many:
                self._unshare()

    @contextmanager
    def many(self, wanted: bool = True) -> Iterator[None]:
        """A scope of the user's number of threads, which no other scope runs beside.

        A surrounding `one` is left for its length. With `wanted` false nothing changes.
        """
        held = self._held
        if not wanted or held.many:
            yield
            return
        if held.depth:
            self._unshare()
        self._exclude()
        held.many = True
        try:
            yield
        finally:
            held.many = False
            self._include()
            if held.depth:
                self._share()

    def _share(self) -> None:
        with self._changed:
            self._changed.wait_for(lambda: not (self._alone or self._waiting))
            now = tuple(library.num_threads for library in _libraries())
            self._held.before = now
            if self._sharing == 0:
                self._before = now
            self._sharing += 1
            for library in _libraries():
                if self._sharing == 1 or _is_per_thread(library):
                    _set_threads(library, 1)

    def _unshare(self) -> None:
        with self._changed:
            self._sharing -= 1
            settings = zip(_libraries(), self._before, self._held.before, strict=True)
            for library, users, own in settings:
                if _is_per_thread(library):
                    _set_threads(library, own)
                elif self._sharing == 0:
                    _set_threads(library, users)
            self._changed.notify_all()

    def _exclude(self) -> None:
        with self._changed:
            self._waiting += 1
            try:
                self._changed.wait_for(lambda: not (self._alone or self._sharing))
                self._alone = True
            finally:
                self._waiting -= 1

    def _include(self) -> None:
        with self._changed:
            self._alone = False
            self._changed.notify_all()
