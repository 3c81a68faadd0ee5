"""`pcm-jax stream`: closures one after another, and a line whenever the answer changes."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcm_jax.cli import _outputs as outputs
from pcm_jax.cli._drives import Drive, OneRobot, Team
from pcm_jax.cli._inputs import graph_to_stream
from pcm_jax.errors import InputError
from pcm_jax.graph import MultiRobotGraph

TICK = 0.2
"""Seconds between looks at files that may have grown."""


def run(options: Any) -> None:
    """Reads, takes in closure after closure, prints what changes and, at the end, what is held."""
    _check(options)
    sizes = _sizes(options)  # before they are read: what grows meanwhile is read again
    given = graph_to_stream(options).graph
    rule = ("confidence", "minimum_inliers", "significance", "separation", "seed")
    asked = {name: getattr(options, name) for name in rule if getattr(options, name) is not None}
    drive: Drive = OneRobot(given, asked) if len(given.maps) == 1 else Team(given, asked)
    told = _Told(drive, options.json)
    _take_in(told, drive.arrivals(given, options.order), options.every)
    if options.follow:
        for grown in _grown(options, sizes):
            drive = drive.go_on(grown)
            told.of(drive)
            _take_in(told, drive.arrivals(grown, options.order), options.every)
    if options.save:
        drive.online.save(options.save)
    told.end()


def _check(options: Any) -> None:
    if options.patience is not None and not options.follow:
        raise InputError("--patience: given without --follow, expected both")
    if options.patience is not None and not options.patience >= 0.0:
        raise InputError(f"--patience: {options.patience} given, expected seconds, at least 0")
    if options.save:
        inputs = [*options.files, *(options.closures or [])]
        outputs.check_outputs([options.save], inputs)


def _take_in(told: _Told, arrivals: Sequence[Callable[[], Any]], every: int) -> None:
    for count, arrives in enumerate(arrivals, start=1):
        arrives()
        if count % every == 0 or count == len(arrivals):
            told.changes()


def _grown(options: Any, known: list[int]) -> Iterator[MultiRobotGraph]:
    """The graph in the files, each time that they have grown and can be read."""
    since = time.monotonic()
    while options.patience is None or time.monotonic() - since <= options.patience:
        sizes = _sizes(options)
        if sizes == known:
            time.sleep(TICK)
            continue
        known, since = sizes, time.monotonic()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # told when the files were read first
            try:
                graph = graph_to_stream(options).graph
            except (InputError, OSError):
                continue  # somebody is writing: the rest of a line comes
        yield graph
        since = time.monotonic()


def _sizes(options: Any) -> list[int]:
    files: list[Path] = [*options.files, *(options.closures or [])]
    return [file.stat().st_size if file.exists() else -1 for file in files]


class _Told:
    """The answer that was printed last.

    Args:
        drive: whose answers are told.
        as_json: whether lines are JSON.
    """

    def __init__(self, drive: Drive, as_json: bool) -> None:
        self._drive, self._json = drive, as_json
        self._accepted: set[int] = set()

    def of(self, drive: Drive) -> None:
        """Goes on with another drive, if it is one: says so, and that nothing is believed yet."""
        if drive is self._drive:
            return
        self._drive, self._accepted = drive, set()
        self._print({"event": "robots", "robots": list(drive.online.graph.names)})

    def changes(self) -> None:
        """Prints a line if other closures are believed than before."""
        selection = self._drive.online.result()
        accepted = set(np.flatnonzero(selection.accepted).tolist())
        if accepted != self._accepted:
            self._line("changed", selection, accepted)
        self._accepted = accepted

    def end(self) -> None:
        """Prints what is believed at the end."""
        selection = self._drive.online.result()
        self._line("end", selection, set(np.flatnonzero(selection.accepted).tolist()))

    def _line(self, event: str, selection: Any, accepted: set[int]) -> None:
        named = self._drive.named
        entered, left = sorted(accepted - self._accepted), sorted(self._accepted - accepted)
        told = {
            "event": event,
            "closures": len(selection.accepted),
            "accepted": len(accepted),
            "entered": [named(row) for row in entered],
            "left": [named(row) for row in left],
            **self._drive.judged(selection),
            "waiting": len(self._drive.online.waiting),
            "repeated": self._drive.online.repeated,
        }
        self._print(told)

    def _print(self, told: dict[str, Any]) -> None:
        text = json.dumps(told, ensure_ascii=False) if self._json else _in_words(told)
        print(text, flush=True)


def _in_words(told: dict[str, Any]) -> str:
    if told["event"] == "robots":
        return f"robots {', '.join(told['robots'])}: closures between them from here on"
    where, why = _of_robots(told)
    believed = f"{told['closures']} closures, {told['accepted']} believed"
    if told["event"] == "changed":
        return f"{believed} (+{len(told['entered'])} −{len(told['left'])}){where}"
    besides = f"; {told['repeated']} repeated" * (told["repeated"] > 0)
    besides += f"; {told['waiting']} wait for poses" * (told["waiting"] > 0)
    return "\n".join([f"end: {believed}{where}{besides}", *why])


def _of_robots(told: dict[str, Any]) -> tuple[str, list[str]]:
    """The numbers of each pair of robots behind a line, and the reasons under it."""
    if "robot_pairs" not in told:
        return "", [f"  {told['why']}"]
    pairs = told["robot_pairs"]
    counts = [f"{one['a']}-{one['b']} {one['accepted']} of {one['measured']}" for one in pairs]
    why = [f"  {one['a']}-{one['b']}: {one['why']}" for one in pairs]
    return f": {', '.join(counts) or 'no pair of robots'}", why
