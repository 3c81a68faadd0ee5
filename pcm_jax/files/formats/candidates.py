"""Candidate loop closures as CSV, with commas, semicolons, tabs or blanks between the columns.

Without a line of column names: `robot_a, id_a, robot_b, id_b`, then the pose of b seen from a as
`x, y, theta` or `x, y, z, qx, qy, qz, qw`, then nothing, one standard deviation per tangent
direction (3 or 6), or the upper triangle of the information row by row (6 or 21), over
(translation, rotation) in metres and radians.

Where the first line has names, they decide: `NAMES` lists what columns are called, in any order
(`robot1, pose1, robot2, pose2, qx, qy, qz, qw, tx, ty, tz, inliers` are Kimera-Multi's,
`robot_src, pose_src, robot_dst, pose_dst, …, kappa, tau` DPGO's), rotations in space may be roll,
pitch and yaw, `_uncertainty` says how columns of standard deviations, covariances and information
are called, and columns of other names are left out. An id may be text, "a12", which names the robot
as well.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from os import PathLike
from typing import Any

import jaxlie
import numpy as np

from pcm_jax import lie
from pcm_jax.files import coordinates
from pcm_jax.files.formats._registry import Format, register
from pcm_jax.files.formats._tags import COLUMNS
from pcm_jax.files.formats._uncertainty import entry_of, positive, stated
from pcm_jax.files.output import write_text
from pcm_jax.files.pose_file import (
    FALSE,
    TRUE,
    UNKNOWN,
    Lines,
    PoseFile,
    Reading,
    definite,
    no_lines,
)
from pcm_jax.files.source import Source
from pcm_jax.files.text import Rows, csv_rows, delimiter_of
from pcm_jax.graph.multi_robot import MultiRobotGraph
from pcm_jax.graph.validation import raise_first

ENDS = ("robot_a", "id_a", "robot_b", "id_b")
NAMES = {
    "robot_a": ("robot_a", "robot1", "robot_from", "robot_id_a", "robot_i", "r1", "robot_src"),
    "id_a": (
        "id_a",
        "pose1",
        "pose_a",
        "key1",
        "key_a",
        "key_from",
        "id1",
        "from",
        "i",
        "pose_src",
    ),
    "robot_b": ("robot_b", "robot2", "robot_to", "robot_id_b", "robot_j", "r2", "robot_dst"),
    "id_b": ("id_b", "pose2", "pose_b", "key2", "key_b", "key_to", "id2", "to", "j", "pose_dst"),
    "x": ("x", "tx", "px"),
    "y": ("y", "ty", "py"),
    "z": ("z", "tz", "pz"),
    "theta": ("theta", "yaw"),
    "roll": ("roll",),
    "pitch": ("pitch",),
    "qx": ("qx",),
    "qy": ("qy",),
    "qz": ("qz",),
    "qw": ("qw",),
    "weight": ("weight", "inliers", "inlier_num", "num_inliers", "score"),
    "is_true": ("is_true",),
}
_OF = {name: column for column, names in NAMES.items() for name in names}
_ID = re.compile(r"-?\d+")
_NUMBER = re.compile(r"[-+.\d]")
_TEXT_ID = re.compile(r"([A-Za-z])(\d+)")
_WIDTHS = {4 + k + extra for k, d in ((3, 3), (7, 6)) for extra in (0, d, d * (d + 1) // 2)}


def looks_like_candidates(source: Source) -> float:
    """Column names of ends, or a row of two robots and ids and as many numbers as there may be."""
    if not source.head:
        return 0.0
    line = source.head[0][1]
    mark = delimiter_of(line)
    if mark is None or line.startswith(("{", "[", "<")):
        return 0.0
    words = [
        word.strip().strip('"') for word in line.rstrip(mark).split(None if mark == " " else mark)
    ]
    known = [_OF.get(word.lower()) for word in words]
    if "id_a" in known and "id_b" in known:
        return 1.0
    ids = len(words) >= 7 and all(_ID.fullmatch(word) for word in (words[1], words[3]))
    whole = ids and len(words) in _WIDTHS
    if mark == " ":  # lines of other formats begin with a tag, or hold numbers alone
        return 0.5 * (whole and not any(_NUMBER.match(word) for word in (words[0], words[2])))
    if not ids:
        return 0.1 * (len(words) > 4)
    return 0.8 if whole and not words[0].isdigit() else 0.4


def read_candidates(source: Source, reading: Reading) -> PoseFile:
    """Reads candidates; their robots by name, their ids as they stand.

    Raises:
        FileFormatError: naming the line, what is wrong and what was expected.

    Warns:
        InputWarning: for quaternions further than 1e-3 from unit length.
    """
    rows = csv_rows(source.path, source.lines)
    header = [word.lower() for word in rows.first] if _is_header(rows.first) else None
    told = source.comment_before(rows.line[0]) if header is None and len(rows) else None
    if told is not None and _is_header(told) and len(told) == len(rows.first):
        rows, header = rows.under(told), [word.lower() for word in told]
    group = reading.group or _group_of(rows, header)
    standard = (*ENDS, *COLUMNS["angle" if group is jaxlie.SE2 else "quaternion"])
    if header is not None and tuple(header) == standard:
        rows, header = rows.rest, None  # whatever follows has no names
    columns = _Columns(rows, header, group)
    rows = rows.rest if header is not None else rows
    if not len(rows):
        return _file(source, group, no_lines(group, 2), np.zeros((0, 2), object), (), False, 0, "")
    columns.check(rows)
    named, ids = _ends(rows, columns)
    notes = columns.notes()
    transforms, degrees = _transforms(rows, columns)
    information, bare, how = _information(rows, columns, reading)
    clipped = 0
    if not bare:
        information, clipped = definite(information, rows.fault, reading.repair)
    edges = Lines(
        ids,
        transforms,
        information,
        rows.line,
        weight=_weights(rows, columns),
        label=_labels(rows, columns),
    )
    return _file(source, group, edges, named, (*notes, *degrees), bare, clipped, how)


def _file(
    source: Source,
    group: type[Any],
    edges: Lines,
    named: np.ndarray | None,
    notes: tuple[str, ...],
    bare: bool,
    clipped: int,
    how: str,
) -> PoseFile:
    return PoseFile(
        source.path,
        group,
        no_lines(group, 1),
        edges,
        format="csv",
        named=named,
        notes=notes,
        candidates=True,
        bare=bare,
        clipped=clipped,
        how=how,
    )


def _is_header(words: Sequence[str]) -> bool:
    return sum(word.lower() in _OF for word in words) >= 4


def _group_of(rows: Rows, header: list[str] | None) -> type[Any]:
    if header is not None:
        known = {_OF.get(name) for name in header}
        return jaxlie.SE2 if "theta" in known and "z" not in known else jaxlie.SE3
    return jaxlie.SE2 if len(rows.first) in (7, 10, 13) else jaxlie.SE3


def _coordinate_of(group: type[Any], header: list[str] | None) -> str:
    """The kind of coordinates, key of `COLUMNS`."""
    if group is jaxlie.SE2:
        return "angle"
    known = {_OF.get(name) for name in header or ()}
    return "euler" if {"roll", "pitch", "theta"} <= known and "qw" not in known else "quaternion"


class _Columns:
    """Places of the columns: by their names, or where they should be."""

    def __init__(self, rows: Rows, header: list[str] | None, group: type[Any]) -> None:
        self.coordinate = _coordinate_of(group, header)
        self.measured, self.d = COLUMNS[self.coordinate], lie.tangent_dim(group)
        self.standard = (*ENDS, *self.measured)
        self.width = len(rows.first)
        self.left_out: list[str] = []
        self.at = {name: index for index, name in enumerate(self.standard)}
        self.uncertainty = list(range(len(self.standard), self.width))
        self.entries: list[Any] = []  # what the columns of uncertainty state, if their names say so
        if header is not None:
            self._by_name(rows, header)

    def _by_name(self, rows: Rows, header: list[str]) -> None:
        self.at = {}
        for index, name in enumerate(header):
            if name in _OF:
                self.at.setdefault(_OF[name], index)
        if self.coordinate == "euler":
            self.at["yaw"] = self.at.pop("theta")
        missing = [name for name in ("id_a", "id_b", *self.measured) if name not in self.at]
        if missing:
            raise rows.fault(
                0,
                f"columns {','.join(rows.first)[:80]} given, expected {','.join(self.standard)},…"
                f" ({missing[0]} is missing)",
            )
        rest = [index for index, name in enumerate(header) if name not in _OF]
        entries = {k: entry for k in rest if (entry := entry_of(header[k], self.d)) is not None}
        in_place = tuple(_OF.get(name) for name in header[: len(self.standard)]) == self.standard
        whole = (self.d, self.d * (self.d + 1) // 2)
        positional = in_place and len(rest) in whole and not entries
        named = [rows.first[k] for k in rest if header[k].startswith(("cov", "var"))]
        if positional and named:
            raise rows.fault(0, f"column {named[0][:40]!r} given, expected names as cov_11, cov_xy")
        self.uncertainty = rest if positional else list(entries)
        self.entries = list(entries.values())
        self.left_out = [rows.first[k] for k in rest if k not in self.uncertainty]

    def check(self, rows: Rows) -> None:
        """Every row has the first one's columns, and these are as many as they may be."""
        allowed = (0, self.d, self.d * (self.d + 1) // 2)
        expected = ",".join(self.standard)
        known = bool(self.entries) or len(self.uncertainty) in allowed
        if not known or self.width < len(self.at):
            raise rows.fault(
                0,
                f"{self.width} columns, expected {expected} and {allowed[0]}, {allowed[1]}"
                f" (standard deviations) or {allowed[2]} (information) more",
            )
        extra = self.width - len(self.standard)
        rows.check_width(self.width, f"{expected} and {extra} more, as in the first row")

    def notes(self) -> tuple[str, ...]:
        """The columns left out, in one line."""
        return (f"columns left out: {', '.join(self.left_out)}",) if self.left_out else ()

    def floats(self, rows: Rows, names: Any) -> np.ndarray:
        """Columns by name, float64 `[m, k]`."""
        return np.concatenate([self._numbers(rows, self.at[name]) for name in names], axis=1)

    def _numbers(self, rows: Rows, index: int) -> np.ndarray:
        return rows.floats(index, index + 1)


def _ends(rows: Rows, columns: _Columns) -> tuple[np.ndarray | None, np.ndarray]:
    """The robots by name, object `[m, 2]`, None where keys tell them; and ids, int64 `[m, 2]`."""
    named = np.full((len(rows), 2), "", object)
    ids = np.zeros((len(rows), 2), np.int64)
    for side, end in enumerate("ab"):
        index = columns.at[f"id_{end}"]
        words = rows.column(index)
        texts = [_TEXT_ID.fullmatch(word) for word in words]
        if all(texts) and texts:
            ids[:, side] = [int(text[2]) for text in texts if text]
            named[:, side] = [text[1] for text in texts if text]
        else:
            ids[:, side] = rows.integers(index, index + 1)[:, 0]
        if f"robot_{end}" in columns.at:
            named[:, side] = rows.column(columns.at[f"robot_{end}"])
    return (named if (named != "").all() else None), ids


def _transforms(rows: Rows, columns: _Columns) -> tuple[np.ndarray, tuple[str, ...]]:
    values = columns.floats(rows, columns.measured)
    transforms = coordinates.parameters(columns.coordinate, values, rows.fault)
    angles = values[:, coordinates.FIRST_ANGLE.get(columns.coordinate, 0) :]
    doubt = coordinates.angle_doubt(columns.coordinate, angles, rows.line)
    return transforms, () if doubt is None else (doubt,)


def _information(rows: Rows, columns: _Columns, reading: Reading) -> tuple[np.ndarray, bool, str]:
    """Information `[m, d, d]`, not checked yet; whether there was none; and how it was read."""
    d, given = columns.d, columns.uncertainty
    if not given:
        default = reading.default_information(jaxlie.SE2 if d == 3 else jaxlie.SE3)
        if default is None:
            return np.zeros((len(rows), d, d)), True, "none given: the maps' median"
        return np.tile(default, (len(rows), 1, 1)), False, "none given: default sigmas"
    if columns.entries:
        information, how = stated(rows, given, columns.entries, d, reading.information)
        return information, False, how
    values = np.concatenate([rows.floats(index, index + 1) for index in given], axis=1)
    if len(given) == d:
        positive(values, rows, "a standard deviation")
        return (values**-2.0)[:, :, None] * np.eye(d), False, "standard deviations"
    information = coordinates.information(values, how=reading.information, fault=rows.fault)
    return information, False, reading.information


def _weights(rows: Rows, columns: _Columns) -> np.ndarray:
    if "weight" not in columns.at:
        return np.ones(len(rows))
    weight = columns.floats(rows, ("weight",))[:, 0]
    raise_first(
        weight < 0.0, rows.fault, lambda row: f"weight {weight[row]:g} given, expected at least 0"
    )
    return weight


def _labels(rows: Rows, columns: _Columns) -> np.ndarray:
    if "is_true" not in columns.at:
        return np.full(len(rows), UNKNOWN)
    words = [word.lower() for word in rows.column(columns.at["is_true"])]
    known = {"1": TRUE, "true": TRUE, "0": FALSE, "false": FALSE, "": UNKNOWN}
    raise_first(
        np.array([word not in known for word in words]),
        rows.fault,
        lambda row: f"is_true {words[row][:40]!r} given, expected 0 or 1",
    )
    return np.array([known[word] for word in words])


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
    names = [
        *(*ENDS, *measured),
        *(f"information_{r + 1}{c + 1}" for r, c in zip(rows, columns, strict=True)),
    ]
    extra: list[list[Any]] = [[] for _ in range(len(closures))]
    weight = np.asarray(closures.weight)
    if (weight != 1.0).any():
        names.append("weight")
        extra = [[*row, value] for row, value in zip(extra, weight.tolist(), strict=True)]
    if closures.is_true is not None:
        names.append("is_true")
        extra = [[*row, int(value)] for row, value in zip(extra, closures.is_true, strict=True)]
    ends = zip(
        _robots_and_ids(graph, closures.robot_a, closures.pose_a),
        _robots_and_ids(graph, closures.robot_b, closures.pose_b),
        strict=True,
    )
    text = io.StringIO()
    # A line that began with "#" would be a comment.
    quoted = any(name.startswith("#") or name != name.strip() for name in graph.names)
    quoting = csv.QUOTE_NONNUMERIC if quoted else csv.QUOTE_MINIMAL
    table = csv.writer(text, lineterminator="\n", quoting=quoting)
    table.writerow(names)
    table.writerows(
        [*a, *b, *values, *more] for (a, b), values, more in zip(ends, numbers, extra, strict=True)
    )
    write_text(path, text.getvalue())


def _robots_and_ids(graph: MultiRobotGraph, robots: Any, poses: Any) -> list[tuple[str, int]]:
    return [
        (graph.maps[robot].name, int(graph.maps[robot].ids[pose]))
        for robot, pose in zip(np.asarray(robots), np.asarray(poses), strict=True)
    ]


CANDIDATES = register(
    Format(
        name="csv",
        about="candidate closures",
        recognise=looks_like_candidates,
        read=read_candidates,
        write=write_candidates,
        suffixes=(".csv",),
        information="kept; standard deviations and covariances too; the maps' median where none is"
        " given",
        labels="kept (is_true)",
    )
)
