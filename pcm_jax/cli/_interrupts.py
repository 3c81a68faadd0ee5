"""Ctrl-C, wherever it comes: some callbacks of the compiler's swallow an exception.

Others, in modules of C++ that are just being imported, end the process when one is raised.
"""

from __future__ import annotations

import signal
import sys
from types import FrameType, TracebackType
from typing import Any

TIMED = hasattr(signal, "setitimer")
SIGNALS = (signal.SIGINT, signal.SIGALRM) if TIMED else (signal.SIGINT,)
AGAIN = 0.5  # seconds until an interrupt that was swallowed is raised again
IMPORTING = "<frozen importlib."  # how Python names the files of its own import system


class Interrupts:
    """A scope in which Ctrl-C is remembered, raised until it is heeded, and leaves no traceback.

    While a module is imported it waits. Where there are no timers, as on Windows, it is then raised
    by the next Ctrl-C, or when the scope is left.
    Outside the main thread, where no handler can be set, it does nothing.
    """

    def __init__(self) -> None:
        self._came = False
        self._before: dict[signal.Signals, Any] = {}
        self._hook: Any = None
        self._around: FrameType | None = None

    def __enter__(self) -> Interrupts:
        self._hook, sys.unraisablehook = sys.unraisablehook, self._unraisable
        self._around = sys._getframe(1)
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
        self._around = None
        if self._came and TIMED:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        for name, handler in self._before.items():
            signal.signal(name, handler)
        if self._came:  # swallowed, or turned into another error, as when NumPy is being imported
            found = error.args if isinstance(error, KeyboardInterrupt) else ()
            raise KeyboardInterrupt(*found) from None

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if not self._came and TIMED:
            signal.setitimer(signal.ITIMER_REAL, AGAIN, AGAIN)
        self._came = True
        if not self._imports(frame):
            raise KeyboardInterrupt

    def _imports(self, frame: FrameType | None) -> bool:
        """True if a module is being imported, by what runs in this scope."""
        while frame is not None and frame is not self._around:
            if frame.f_code.co_filename.startswith(IMPORTING):
                return True
            frame = frame.f_back
        return False

    def _unraisable(self, told: Any) -> None:
        if not issubclass(told.exc_type, KeyboardInterrupt):
            self._hook(told)
