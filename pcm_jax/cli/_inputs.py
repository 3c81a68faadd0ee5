"""The graph that a command's options describe."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pcm_jax.errors import InputError
from pcm_jax.files import read_graph
from pcm_jax.graph import MultiRobotGraph, split


def graph_to_merge(options: Any) -> MultiRobotGraph:
    """Reads and cuts, and checks that there is something to merge.

    Raises:
        InputError: for bad files, and for too few robots or no closures between them.
    """
    graph = read_graph(
        *options.files,
        closures=options.closures,
        information=options.information,
        repair=options.repair,
    )
    graph = _cut(graph, options.split, options.files) if options.split else graph
    _check_mergeable(graph, options.files)
    return graph


def _cut(graph: MultiRobotGraph, at: list[int], files: list[Path]) -> MultiRobotGraph:
    trajectory, *others = graph.maps
    if others:
        raise InputError(
            f"--split: {_names(files)} hold {1 + len(others)} robots, expected one to cut"
        )
    try:
        return split(trajectory, at)
    except InputError as error:
        raise InputError(f"--split: {str(error).removeprefix('at: ')}") from None


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
