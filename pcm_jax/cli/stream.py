"""`pcm-jax stream`: closures one after another, and a line whenever the answer changes."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pcm_jax.cli import _outputs as outputs
from pcm_jax.cli._inputs import graph_to_merge
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures, MultiRobotGraph
from pcm_jax.online import IncrementalPcm

TICK = 0.2
"""Seconds between looks at files that may have grown."""


def run(options: Any) -> None:
    """Reads, takes in closure after closure, prints what changes and, at the end, what is held."""
    _check(options)
    sizes = _sizes(options)  # before they are read: what grows meanwhile is read again
    given = graph_to_merge(options).graph
    rule = ("confidence", "minimum_inliers", "significance", "separation", "seed")
    asked = {name: getattr(options, name) for name in rule}
    none = given.closures[:0]
    maps = MultiRobotGraph(given.maps, none)
    online = IncrementalPcm(maps, **{k: v for k, v in asked.items() if v is not None})
    told = _Told(online, options.json)
    _take_in(told, in_order(given, options.order), options.every)
    if options.follow:
        for grown in _grown(options, sizes):
            _go_on(online, grown)
            _take_in(told, in_order(grown, options.order), options.every)
    if options.save:
        online.save(options.save)
    told.end()


def in_order(graph: MultiRobotGraph, order: str) -> LoopClosures:
    """The closures in the order in which they come.

    Args:
        graph: maps and closures.
        order: "stamps", "lines", or "auto".

    Raises:
        InputError: for "stamps" where a pose that a closure touches has none.
    """
    closures = graph.closures
    if order == "lines":
        return closures
    ends = ("robot_a", "pose_a"), ("robot_b", "pose_b")
    times = [_stamps(graph, *end) for end in ends]
    at = np.maximum(*times)
    if np.isfinite(at).all():
        return closures[np.argsort(at, kind="stable")]
    if order == "stamps":
        row = int(np.flatnonzero(~np.isfinite(at))[0])
        end = ends[0 if not np.isfinite(times[0][row]) else 1]
        robot, pose = (int(getattr(closures, name)[row]) for name in end)
        name = graph.maps[robot].pose_name(pose)
        raise InputError(f"--order: stamps given, but pose {name} of closure {row} has no time")
    return closures


def _stamps(graph: MultiRobotGraph, robot: str, pose: str) -> Float[np.ndarray, " m"]:
    """The times of the poses at one end of the closures, NaN without one."""
    robots, poses = (np.asarray(getattr(graph.closures, name)) for name in (robot, pose))
    found = np.full(len(robots), np.nan)
    for index, one in enumerate(graph.maps):
        if one.stamps is not None:
            found[robots == index] = one.stamps[poses[robots == index]]
    return found


def _check(options: Any) -> None:
    if options.patience is not None and not options.follow:
        raise InputError("--patience: given without --follow, expected both")
    if options.patience is not None and not options.patience >= 0.0:
        raise InputError(f"--patience: {options.patience} given, expected seconds, at least 0")
    if options.save:
        inputs = [*options.files, *(options.closures or [])]
        outputs.check_outputs([options.save], inputs)


def _take_in(told: _Told, closures: LoopClosures, every: int) -> None:
    for row in range(len(closures)):
        told.online.add(closures[[row]])
        if (row + 1) % every == 0 or row + 1 == len(closures):
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
                graph = graph_to_merge(options).graph
            except (InputError, OSError):
                continue  # somebody is writing: the rest of a line comes
        yield graph
        since = time.monotonic()


def _sizes(options: Any) -> list[int]:
    files: list[Path] = [*options.files, *(options.closures or [])]
    return [file.stat().st_size if file.exists() else -1 for file in files]


def _go_on(online: IncrementalPcm, grown: MultiRobotGraph) -> None:
    """Takes the maps that have more poses or edges than before."""
    before = online.graph.maps
    same = [
        one.num_poses == other.num_poses and one.num_edges == other.num_edges
        for one, other in zip(before, grown.maps, strict=False)
    ]
    if all(same) and len(before) == len(grown.maps):
        return
    kept = zip(before, grown.maps, same, strict=False)
    maps = [one if is_same else other for one, other, is_same in kept]
    online.replace_maps([*maps, *grown.maps[len(before) :]])


class _Told:
    """The answer that was printed last.

    Args:
        online: of which answers are asked.
        as_json: whether lines are JSON.
    """

    def __init__(self, online: IncrementalPcm, as_json: bool) -> None:
        self.online, self._json = online, as_json
        self._accepted: set[int] = set()

    def changes(self) -> None:
        """Prints a line if other closures are believed than before."""
        selection = self.online.result()
        accepted = set(np.flatnonzero(selection.accepted).tolist())
        if accepted != self._accepted:
            self._line("changed", selection, accepted)
        self._accepted = accepted

    def end(self) -> None:
        """Prints what is believed at the end."""
        selection = self.online.result()
        self._line("end", selection, set(np.flatnonzero(selection.accepted).tolist()))

    def _line(self, event: str, selection: Any, accepted: set[int]) -> None:
        graph = self.online.graph
        entered, left = sorted(accepted - self._accepted), sorted(self._accepted - accepted)
        told = {
            "event": event,
            "closures": len(graph.closures),
            "accepted": len(accepted),
            "entered": [_named(graph, row) for row in entered],
            "left": [_named(graph, row) for row in left],
            "robot_pairs": [_of_pair(graph, pair) for pair in selection.pairs],
            "waiting": selection.waiting,
            "repeated": self.online.repeated,
        }
        text = json.dumps(told, ensure_ascii=False) if self._json else _in_words(told)
        print(text, flush=True)


def _in_words(told: dict[str, Any]) -> str:
    pairs = told["robot_pairs"]
    counts = [f"{one['a']}-{one['b']} {one['accepted']} of {one['measured']}" for one in pairs]
    believed = f"{told['closures']} closures, {told['accepted']} believed"
    where = ", ".join(counts) or "no pair of robots"
    if told["event"] == "changed":
        return f"{believed} (+{len(told['entered'])} −{len(told['left'])}): {where}"
    besides = f"; {told['repeated']} repeated" * (told["repeated"] > 0)
    besides += f"; {told['waiting']} wait for poses" * (told["waiting"] > 0)
    why = [f"  {one['a']}-{one['b']}: {one['why']}" for one in pairs]
    return "\n".join([f"end: {believed}: {where}{besides}", *why])


def _of_pair(graph: MultiRobotGraph, pair: Any) -> dict[str, Any]:
    return {
        "a": graph.maps[pair.robot_a].name,
        "b": graph.maps[pair.robot_b].name,
        "measured": len(pair.accepted),
        "accepted": int(pair.accepted.sum()),
        "why": pair.verdict.why,
    }


def _named(graph: MultiRobotGraph, row: int) -> dict[str, Any]:
    """One closure: its place in the order in which they came, its poses, where it was read."""
    closures = graph.closures
    ends = (closures.robot_a, closures.pose_a), (closures.robot_b, closures.pose_b)
    a, b = (graph.maps[int(robot[row])].pose_name(int(pose[row])) for robot, pose in ends)
    return {"index": row, "a": a, "b": b, "source": str(closures.source[row])}
