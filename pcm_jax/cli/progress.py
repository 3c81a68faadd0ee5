"""What is being done, on standard error, for work that takes more than two seconds."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType

PATIENCE = 2.0  # seconds of silence
TICK = 0.5  # seconds between updates of a terminal's line


class Progress:
    """A scope in which calling the object with a line of text announces the next stage.

    Nothing is shown in the first two seconds. After them a terminal has one line that counts the
    seconds and vanishes at the end; elsewhere (a log file) every stage gets one line of its own.
    """

    def __init__(self) -> None:
        self._start = time.monotonic()
        self._stage = self._shown = ""
        self._finished = threading.Event()
        self._ticker = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Progress:
        self._ticker.start()
        return self

    def __call__(self, stage: str) -> None:
        """Announces the next stage."""
        self._stage = stage

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._finished.set()
        self._ticker.join()
        if self._shown and sys.stderr.isatty():
            print("\r\033[K", end="", file=sys.stderr, flush=True)

    def _watch(self) -> None:
        wait = PATIENCE
        while not self._finished.wait(wait):
            wait = TICK
            self._show()

    def _show(self) -> None:
        stage = self._stage
        if sys.stderr.isatty():
            seconds = time.monotonic() - self._start
            print(f"\r\033[K{stage} ({seconds:.0f} s)", end="", file=sys.stderr, flush=True)
        elif stage != self._shown:
            print(f"{stage} ...", file=sys.stderr, flush=True)
        self._shown = stage
