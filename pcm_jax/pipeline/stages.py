"""Stages of a call: how long each took, and what is told of them meanwhile."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

STAGES: tuple[str, ...] = ("optimize", "marginals", "consistency", "clique", "chance")

Progress = Callable[[str, int, int], None]
"""Called with a stage, how many of its parts are done, and how many there are."""


def silent(stage: str, done: int, total: int) -> None:
    """Tells nobody."""


class StopWatch:
    """Wall-clock seconds by stage.

    Attributes:
        seconds: of every stage, 0 for one that was not entered.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = dict.fromkeys(STAGES, 0.0)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Adds the time within the scope to a stage's."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] += time.perf_counter() - start
