"""Ctrl-C, wherever it comes: some callbacks of the compiler's swallow an exception."""

from __future__ import annotations

import signal
import sys
from types import TracebackType
from typing import Any

TIMED = hasattr(signal, "setitimer")
SIGNALS = (signal.SIGINT, signal.SIGALRM) if TIMED else (signal.SIGINT,)
AGAIN = 0.5  # seconds until an interrupt that was swallowed is raised again


class Interrupts:
    """A scope in which Ctrl-C is remembered, raised until it is heeded, and leaves no traceback.

    Outside the main thread, where no handler can be set, it does nothing.
    """

    def __init__(self) -> None:
        self._came = False
        self._before: dict[signal.Signals, Any] = {}
        self._hook: Any = None

    def __enter__(self) -> Interrupts:
        self._hook, sys.unraisablehook = sys.unraisablehook, self._unraisable
        try:
            self._before = {name: signal.signal(name, self._handle) for name in SIGNALS}
        except ValueError:
            self._before = {}
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        sys.unraisablehook = self._hook
        if self._came and TIMED:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        for name, handler in self._before.items():
            signal.signal(name, handler)
        if self._came:  # swallowed, or turned into another error, as when NumPy is being imported
            found = error.args if isinstance(error, KeyboardInterrupt) else ()
            raise KeyboardInterrupt(*found) from None

    def _handle(self, number: int, frame: Any) -> None:
        if not self._came and TIMED:
            signal.setitimer(signal.ITIMER_REAL, AGAIN, AGAIN)
        self._came = True
        raise KeyboardInterrupt

    def _unraisable(self, told: Any) -> None:
        if not issubclass(told.exc_type, KeyboardInterrupt):
            self._hook(told)
