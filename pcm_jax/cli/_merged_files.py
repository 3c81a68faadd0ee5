"""The files of a merge: merged maps group by group, or robot by robot; rejected closures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files import write_candidates, write_g2o, write_trajectory
from pcm_jax.files.formats.g2o import fit_keys, table_path
from pcm_jax.files.output import check_target, folder_written_whole
from pcm_jax.files.write import format_of_suffix, write_graph
from pcm_jax.graph import LoopClosures, MultiRobotGraph


def is_folder(output: str) -> bool:
    """True where an output is a folder of files: its name ends with a slash."""
    return output.endswith(("/", "\\"))


def check_folder(output: str) -> None:
    """Raises `FileFormatError` unless files can be written to the folder, which may be made."""
    folder = Path(output)
    if folder.exists() and not folder.is_dir():
        raise FileFormatError(folder, None, "this is a file, expected a folder to write to")
    check_target(folder / "closures.csv" if folder.is_dir() else folder)


def write_merged(output: str, result: Any) -> Iterator[Path]:
    """Writes the merged maps with the accepted closures, and gives the files' paths.

    Robots that nothing joins stand in frames of their own: each group gets a file, `merged.g2o`
    and `merged.group2.g2o` and so on; where ids fit no symbol key they are sequential, with a table
    beside the file. A folder gets a g2o file and a TUM trajectory for each
    robot, and the accepted closures as CSV.
    """
    if is_folder(output):
        yield from _robot_by_robot(Path(output), result.graph)
        return
    target = Path(output)
    for number, group in enumerate(result.groups, start=1):
        path = target if number == 1 else target.with_name(_numbered(target.name, number))
        graph = part_of(result.graph, group)
        if format_of_suffix(path) in (None, "g2o"):
            ids = "original" if fit_keys(graph.maps) else "sequential"
            write_g2o(path, graph, ids=ids, frame=result.graph.names[group[0]])
            if ids == "sequential":
                yield table_path(path)
        else:
            write_graph(path, graph)
        yield path


def _numbered(name: str, number: int) -> str:
    """A group's file name: "merged.group2.g2o.gz" of "merged.g2o.gz"."""
    stem, dot, suffixes = name.partition(".")
    return f"{stem}.group{number}{dot}{suffixes}"


def _robot_by_robot(folder: Path, graph: MultiRobotGraph) -> Iterator[Path]:
    names = []
    with folder_written_whole(folder) as place:
        for one in graph.maps:
            if "/" in one.name or one.name in (".", ".."):
                raise InputError(f"--output: the robot name {one.name!r} is no file name")
            write_g2o(place / f"{one.name}.g2o", one)
            write_trajectory(place / f"{one.name}.tum", one)
            names += [f"{one.name}.g2o", f"{one.name}.tum"]
        write_candidates(place / "closures.csv", graph)
    yield from (folder / name for name in [*names, "closures.csv"])


def write_rejected(path: Path, result: Any) -> None:
    """Writes the candidates that were not accepted, as CSV."""
    rejected = result.candidates[~np.asarray(result.accepted, bool)]
    write_candidates(path, MultiRobotGraph(result.graph.maps, rejected))


def part_of(graph: MultiRobotGraph, robots: Sequence[int]) -> MultiRobotGraph:
    """The maps of some robots, in that order, and the closures among them."""
    place = np.full(len(graph.maps), -1)
    place[list(robots)] = np.arange(len(robots))
    closures = graph.closures
    a, b = place[np.asarray(closures.robot_a)], place[np.asarray(closures.robot_b)]
    rows = np.flatnonzero((a >= 0) & (b >= 0))
    kept = closures[rows]
    ends = (a[rows], np.asarray(kept.pose_a), b[rows], np.asarray(kept.pose_b))
    return MultiRobotGraph(
        tuple(graph.maps[robot] for robot in robots),
        LoopClosures.from_checked(
            ends,
            kept.measurement,
            np.asarray(kept.information),
            kept.source,
            kept.weight,
            kept.is_true,
        ),
    )
