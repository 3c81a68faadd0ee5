"""Candidate loop closures from a CSV file.

Columns: `robot_a, id_a, robot_b, id_b`, then the pose of b seen from a as `x, y, theta` or
`x, y, z, qx, qy, qz, qw`, then nothing, one standard deviation per tangent direction (3 or 6), or
the upper triangle of the information row by row (6 or 21), over (translation, rotation) in metres
and radians. A first line of column names is optional; `write_candidates` writes it, and the upper
triangle.
"""

from __future__ import annotations

import csv
import io
import warnings
from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np

from pcm_jax import lie
from pcm_jax.errors import InputWarning
from pcm_jax.files import coordinates
from pcm_jax.files.formats._tags import COLUMNS
from pcm_jax.files.output import write_text
from pcm_jax.files.pose_file import Reading, definite
from pcm_jax.files.source import read_lines
from pcm_jax.files.text import Rows, csv_rows
from pcm_jax.graph.loop_closures import LoopClosures, pose_indices
from pcm_jax.graph.multi_robot import MultiRobotGraph
from pcm_jax.graph.pose_graph import PoseGraph
from pcm_jax.graph.validation import raise_first

SMALLEST_SIGMA = 1e-30  # so that its information still is a number
ENDS = ("robot_a", "id_a", "robot_b", "id_b")


def read_candidates(
    path: str | PathLike[str], maps: Sequence[PoseGraph], reading: Reading
) -> tuple[LoopClosures, int]:
    """The closures of a CSV file, and how many information matrices were repaired.

    Robots are given by name, or by letter: a is the first map. Ids are those of the maps' files,
    for symbol keys the key or its index.

    Raises:
        FileFormatError: naming the line, what is wrong and what was expected.

    Warns:
        InputWarning: where there are no columns for the uncertainty. Each tangent direction then
            gets the median standard deviation of the maps' edges.
    """
    rows = csv_rows(str(path), read_lines(path))
    coordinate = "angle" if maps[0].tangent_dim == 3 else "quaternion"
    measured = COLUMNS[coordinate]
    rows = _without_header(rows, (*ENDS, *measured))
    if not len(rows):
        return LoopClosures.empty(maps[0].group), 0
    start = len(ENDS) + len(measured)
    extra = _extra_columns(rows, start, (*ENDS, *measured), maps[0].tangent_dim)
    transforms = coordinates.parameters(coordinate, rows.floats(4, start), rows.fault)
    uncertainty = rows.floats(start, start + extra)
    if extra == maps[0].tangent_dim:
        _check_sigmas(uncertainty, rows)
    information = _information(uncertainty, maps, str(path))
    information, clipped = definite(information, rows.fault, reading.repair)
    ends = [end for side in (0, 2) for end in _end(rows, side, maps)]
    raise_first(
        ends[0] == ends[2],
        rows.fault,
        lambda row: f"closure from robot {rows.column(0)[row]!r} to itself, expected two robots",
    )
    measurement = maps[0].group(transforms)
    return LoopClosures.from_checked(tuple(ends), measurement, information, rows.source), clipped


def write_candidates(path: str | PathLike[str], graph: MultiRobotGraph) -> None:
    """Writes a graph's closures as a CSV file of candidates, whole or not at all.

    `read_graph(..., closures=path)` with the same maps reads the same closures, in this order.

    Args:
        path: the file; `.gz` and `.xz` compress it.
        graph: closures, and the maps whose names and ids they are written with.

    Raises:
        FileFormatError: for a folder that does not exist or cannot be written to.
    """
    closures = graph.closures
    parameters = np.asarray(lie.parameters(lie.as_numpy(closures.measurement)))
    triangle = coordinates.upper_triangle(np.asarray(closures.information))
    numbers = np.concatenate([coordinates.columns(parameters), triangle], axis=1).tolist()
    measured = COLUMNS["angle" if graph.tangent_dim == 3 else "quaternion"]
    rows, columns = np.triu_indices(graph.tangent_dim)
    information = (f"information_{r + 1}{c + 1}" for r, c in zip(rows, columns, strict=True))
    ends = zip(
        _robots_and_ids(graph, closures.robot_a, closures.pose_a),
        _robots_and_ids(graph, closures.robot_b, closures.pose_b),
        strict=True,
    )
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow([*ENDS, *measured, *information])
    table.writerows([*a, *b, *values] for (a, b), values in zip(ends, numbers, strict=True))
    write_text(path, text.getvalue())


def _robots_and_ids(graph: MultiRobotGraph, robots: Any, poses: Any) -> list[tuple[str, int]]:
    return [
        (graph.maps[robot].name, int(graph.maps[robot].ids[pose]))
        for robot, pose in zip(np.asarray(robots), np.asarray(poses), strict=True)
    ]


def _without_header(rows: Rows, expected: tuple[str, ...]) -> Rows:
    """The rows after a line of column names, whose beginning must be as expected."""
    if rows.first[:1] != ["robot_a"]:
        return rows
    if tuple(rows.first[: len(expected)]) != expected:
        raise rows.fault(
            0, f"columns {','.join(rows.first)[:80]} given, expected {','.join(expected)},…"
        )
    return rows.rest


def _extra_columns(rows: Rows, start: int, expected: tuple[str, ...], d: int) -> int:
    """Columns of uncertainty: 0, d or d (d + 1) / 2, the same in every row."""
    allowed = (0, d, d * (d + 1) // 2)
    extra = len(rows.first) - start
    if extra not in allowed:
        raise rows.fault(
            0,
            f"{len(rows.first)} columns, expected {','.join(expected)} and"
            f" {allowed[0]}, {allowed[1]} (standard deviations) or {allowed[2]} (information) more",
        )
    rows.check_width(start + extra, ",".join(expected) + f" and {extra} more, as in the first row")
    return extra


def _information(extra: np.ndarray, maps: Sequence[PoseGraph], path: str) -> np.ndarray:
    """Information `[m, d, d]`, not checked yet, from the columns of uncertainty."""
    d = maps[0].tangent_dim
    if extra.shape[1] == d * (d + 1) // 2:
        return coordinates.symmetric(extra)
    sigmas = extra
    if extra.shape[1] == 0:
        typical = _median_sigmas(maps)
        sigmas = np.broadcast_to(typical, (len(extra), d))
        text = ", ".join(f"{sigma:.3g}" for sigma in typical)
        warnings.warn(
            InputWarning(
                f"{path}: no columns for the uncertainty; the median standard deviations of the"
                f" maps' edges ({text}) are used"
            ),
            stacklevel=2,
        )
    return (sigmas**-2.0)[:, :, None] * np.eye(d)


def _check_sigmas(sigmas: np.ndarray, rows: Rows) -> None:
    wrong = sigmas < SMALLEST_SIGMA
    raise_first(
        wrong.any(axis=1),
        rows.fault,
        lambda row: f"{sigmas[row][wrong[row]][0]:g} given, expected a standard deviation above 0",
    )


def _median_sigmas(maps: Sequence[PoseGraph]) -> np.ndarray:
    """Median standard deviation of the maps' edges in each tangent direction, `[d]`."""
    information = np.concatenate([np.asarray(graph.information) for graph in maps])
    if not len(information):
        return np.ones(maps[0].tangent_dim)
    variances = np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)
    return np.sqrt(np.median(np.abs(variances), axis=0))


def _end(rows: Rows, side: int, maps: Sequence[PoseGraph]) -> tuple[np.ndarray, np.ndarray]:
    """Robots and poses, as indices, of the columns `side` and `side + 1`."""
    letters = {chr(ord("a") + index): index for index in range(min(len(maps), 26))}
    known = letters | {graph.name: index for index, graph in enumerate(maps) if graph.name}
    names = rows.column(side)
    robots = np.array([known.get(name, -1) for name in names], np.int64)
    raise_first(
        robots < 0,
        rows.fault,
        lambda row: f"there is no robot {names[row][:40]!r}, expected one of {', '.join(known)}",
    )
    ids = rows.integers(side + 1, side + 2)[:, 0]
    return robots, pose_indices(maps, robots, ids, rows.fault)
