"""Progress on standard error, for work that takes more than two seconds."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType

PATIENCE = 2.0  # seconds of silence
TICK = 0.5  # seconds between looks at the clock
DOING = {
    "optimize": "optimising map {number} of {total}",
    "consistency": "weighing closures: %",
    "clique": "selecting closures: pair {number} of {total}",
    "merge": "merging the maps",
    "refine": "refining the merged map",
}
"""What the library's stages are called here."""


class Progress:
    """A scope in which calling the object with a line of text announces the next stage.

    On a terminal, work of more than two seconds has one line that counts them and vanishes at the
    end. Elsewhere (a log file) every stage of more than two seconds gets a line of its own; the
    first one none, so that bad input, which shows there, leaves its one line and no other.
    """

    def __init__(self, stage: str) -> None:
        self._start = self._stage_start = time.monotonic()
        self._stage = self._shown = stage
        self._terminal = sys.stderr.isatty()
        self._finished = threading.Event()
        self._ticker = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Progress:
        self._ticker.start()
        return self

    def __call__(self, stage: str, done: int = 0, total: int = 0) -> None:
        """Announces the next stage, or how far one of the library's has come."""
        if stage in DOING:
            stage = DOING[stage].format(number=min(done + 1, total), total=total)
            percent = 100 * done // max(total, 1)
            stage = stage.replace("%", f"{percent} %")
        if stage != self._stage:
            self._stage_start = time.monotonic()
            self._stage = stage

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._finished.set()
        self._ticker.join()
        if self._terminal:
            self._write("")

    def _watch(self) -> None:
        while not self._finished.wait(TICK):
            now, stage = time.monotonic(), self._stage
            if self._terminal and now - self._start > PATIENCE:
                self._write(f"{stage} ({now - self._start:.0f} s)")
            elif not self._terminal and stage != self._shown and now - self._stage_start > PATIENCE:
                print(f"{stage} ...", file=sys.stderr, flush=True)
                self._shown = stage

    def _write(self, line: str) -> None:
        """Replaces the terminal's line."""
        print(f"\r\033[K{line}", end="", file=sys.stderr, flush=True)
