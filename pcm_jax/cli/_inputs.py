"""The graph that a command's options describe."""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from pcm_jax.errors import InputError, InputWarning
from pcm_jax.files.account import Account
from pcm_jax.files.pose_file import Reading
from pcm_jax.files.read import read_with_account
from pcm_jax.graph import MultiRobotGraph, PoseGraph, split

COMPONENTS = "components"


@dataclasses.dataclass(frozen=True)
class Given:
    """Input of a command, as given.

    Attributes:
        graph: what was read, cut if asked for.
        account: how it was read.
        cuts: where a trajectory was cut and what that dropped, one line each.
    """

    graph: MultiRobotGraph
    account: Account
    cuts: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """The account as JSON has it, with the cuts."""
        return {**self.account.as_dict(), "cuts": list(self.cuts)}


def read(options: Any, *, repair: str | None = None) -> Given:
    """Reads the files of a command's options.

    Raises:
        InputError: for bad files and options.
    """
    reading = Reading(
        information=options.information,
        repair=repair or options.repair,
        ids=options.ids,
        default_sigmas=options.default_sigmas,
        components=options.split in (COMPONENTS, [COMPONENTS]),
        **({} if options.byte_limit is None else {"byte_limit": options.byte_limit}),
    )
    graph, account = read_with_account(
        list(map(str, options.files)),
        list(map(str, options.closures)) if options.closures else None,
        reading,
        skip_bad=options.skip_bad,
        ignore_priors=options.ignore_priors,
    )
    return Given(graph, account)


def graph_to_merge(options: Any) -> Given:
    """Reads and cuts, and checks that there is something to merge.

    Raises:
        InputError: for bad files, and for too few robots or no closures between them.

    Warns:
        InputWarning: of what was read otherwise than it may have been meant.
    """
    given = _read_and_cut(options)
    _check_mergeable(given.graph, options.files)
    return given


def graph_to_stream(options: Any) -> Given:
    """Reads and cuts, and checks that there are closures, between robots or inside one's map.

    Raises:
        InputError: for bad files, several robots without closures between them, one without a loop.

    Warns:
        InputWarning: as `graph_to_merge`.
    """
    given = _read_and_cut(options)
    first, *others = given.graph.maps
    if others or first.num_edges < first.num_poses:
        _check_mergeable(given.graph, options.files)
    return given


def _read_and_cut(options: Any) -> Given:
    given = read(options)
    for line in given.account.warnings():
        warnings.warn(InputWarning(line), stacklevel=3)
    at = _indices(options, given.graph)
    return _cut(given, at, options) if at else given


def _indices(options: Any, graph: MultiRobotGraph) -> list[int]:
    """The poses to cut before, as indices."""
    if options.split_id:
        one = _only(graph, options.files, "--split-id")
        index = {int(pose): k for k, pose in enumerate(one.ids)}
        unknown = [pose for pose in options.split_id if pose not in index]
        if unknown:
            raise InputError(
                f"--split-id: pose {unknown[0]} given, expected one of the poses"
                f" {one.ids.min()} to {one.ids.max()}"
            )
        return [index[pose] for pose in options.split_id]
    if not options.split or options.split == [COMPONENTS]:
        return []
    wrong = [text for text in options.split if not text.lstrip("-").isdigit()]
    if wrong:
        raise InputError(f"--split: {wrong[0]!r} given, expected poses or {COMPONENTS!r}")
    return [int(text) for text in options.split]


def _only(graph: MultiRobotGraph, files: list[Path], option: str) -> PoseGraph:
    trajectory, *others = graph.maps
    if others:
        raise InputError(
            f"{option}: {_names(files)} hold {1 + len(others)} robots, expected one to cut"
        )
    return trajectory


def _cut(given: Given, at: list[int], options: Any) -> Given:
    option = "--split-id" if options.split_id else "--split"
    one = _only(given.graph, options.files, option)
    try:
        graph = split(one, at)
    except InputError as error:
        raise InputError(f"{option}: {str(error).removeprefix('at: ')}") from None
    return dataclasses.replace(given, graph=graph, cuts=tuple(_told(one, at, options)))


def _told(one: PoseGraph, at: list[int], options: Any) -> Any:
    """Lines on where a trajectory was cut, and what that dropped."""
    ids = [str(one.ids[index]) for index in at]
    plain = bool((one.ids == np.arange(one.num_poses)).all())
    yield f"cut before the poses with ids {', '.join(ids)}"
    if not plain and not options.split_id:
        numbers = ", ".join(map(str, at))
        warnings.warn(
            InputWarning(
                f"--split: poses {numbers} have the ids {', '.join(ids)}, since the ids are not 0,"
                f" 1, 2, ...; --split-id {' '.join(map(str, at))} cuts before these ids"
            ),
            stacklevel=2,
        )
    for index in at:
        between = [f"{one.ids[k]}-{one.ids[j]}" for k, j in _across(one, index)]
        if between:
            yield f"dropped, as odometry across the cut: {', '.join(between)}"


def _across(one: PoseGraph, index: int) -> list[tuple[int, int]]:
    """The edges between the two poses next to a cut."""
    tail, head = np.asarray(one.tail), np.asarray(one.head)
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    rows = np.flatnonzero((low == index - 1) & (high == index))
    return [(int(tail[row]), int(head[row])) for row in rows]


def _check_mergeable(graph: MultiRobotGraph, files: list[Path]) -> None:
    first, *others = graph.maps
    if not others:
        raise InputError(
            f"{_names(files)}: one robot, expected at least two; give each robot's file, or cut"
            f" this trajectory, in its middle for example: --split {max(1, first.num_poses // 2)}"
        )
    if not len(graph.closures):
        raise InputError(
            f"{_names(files)}: robots {', '.join(graph.names)} and no loop closure between them,"
            " expected at least one; candidates can come from a CSV file: --closures"
        )


def _names(files: list[Path]) -> str:
    return ", ".join(map(str, files))
