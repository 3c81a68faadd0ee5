"""Trajectories as CSV with column names, several robots' in one file if it says so.

Kimera-Multi's `robot_index, pose_index, qx, qy, qz, qw, tx, ty, tz` and
`keyframe_stamp_ns, keyframe_id, submap_id, qx, …`, and the like: the names decide.
"""

from __future__ import annotations

import dataclasses

import jaxlie
import numpy as np

from pcm_jax import lie
from pcm_jax.errors import FileFormatError
from pcm_jax.files import coordinates
from pcm_jax.files._scope import Scope, made_scope
from pcm_jax.files.formats._registry import Format, register
from pcm_jax.files.formats._tags import COLUMNS
from pcm_jax.files.pose_file import PoseFile, Reading
from pcm_jax.files.source import Source
from pcm_jax.files.text import Rows, csv_rows, delimiter_of
from pcm_jax.files.trajectories import trajectory_file

NAMES = {
    "robot": ("robot_index", "robot_id", "robot"),
    "id": ("pose_index", "pose_id", "keyframe_id", "id", "index"),
    "seconds": ("timestamp", "stamp", "time", "t"),
    "nanoseconds": ("stamp_ns", "keyframe_stamp_ns", "timestamp_ns", "timestamp [ns]"),
    "x": ("x", "tx", "px"),
    "y": ("y", "ty", "py"),
    "z": ("z", "tz", "pz"),
    "theta": ("theta", "yaw"),
    "roll": ("roll",),
    "pitch": ("pitch",),
    **{name: (name,) for name in ("qx", "qy", "qz", "qw")},
}
_OF = {name: column for column, names in NAMES.items() for name in names}
_ROBOT_BITS = 40  # ids of several robots' poses side by side


def _columns(source: Source) -> dict[str, int] | None:
    """Places of the columns, if the first line names a pose's and no other end's."""
    if not source.head:
        return None
    line = source.head[0][1]
    mark = delimiter_of(line)
    if mark is None:
        return None
    at: dict[str, int] = {}
    for index, word in enumerate(line.split(mark)):
        column = _OF.get(word.strip().strip('"').lower())
        if column is not None:
            at.setdefault(column, index)
    whole = any(
        all(name in at for name in names) for names in (COLUMNS["angle"], COLUMNS["quaternion"])
    )
    return at if whole else None


def _recognise(source: Source) -> float:
    return 0.9 * (_columns(source) is not None)


def _read(source: Source, reading: Reading) -> PoseFile:
    at = _columns(source)
    if at is None:
        raise FileFormatError(source.path, 1, "expected columns named x, y, z, qx, qy, qz, qw")
    rows = csv_rows(source.path, source.lines)
    width = len(rows.first)
    rows = rows.rest
    rows.check_width(width, "as many as the first line has names", len(source.lines))
    coordinate = "quaternion" if "qw" in at else "angle"
    if coordinate == "angle" and {"z", "roll", "pitch"} <= at.keys():
        coordinate, at = "euler", {**at, "yaw": at["theta"]}
    values = np.concatenate(
        [rows.floats(at[name], at[name] + 1) for name in COLUMNS[coordinate]], axis=1
    )
    group = jaxlie.SE2 if coordinate == "angle" else jaxlie.SE3
    poses = lie.as_numpy(group(coordinates.parameters(coordinate, values, rows.fault)))  # type: ignore[arg-type]
    ids = rows.integers(at["id"], at["id"] + 1)[:, 0] if "id" in at else np.arange(len(rows))
    scope = None
    if "robot" in at:
        ids, scope = _robots(rows, at["robot"], ids)
    unique, counts = np.unique(ids, return_counts=True)
    if len(unique) < len(ids):
        again = unique[np.argmax(counts > 1)]
        row = int(np.flatnonzero(ids == again)[1])
        raise rows.fault(row, "this pose again, expected every id once")
    file = trajectory_file(
        source.path,
        "poses",
        poses,
        rows.line,
        reading,
        ids=ids,
        stamps=_stamps(rows, at),
        scope=scope,
    )
    return file if scope is None else _apart(file)


def _robots(rows: Rows, column: int, ids: np.ndarray) -> tuple[np.ndarray, Scope]:
    """Ids that are unique over the file's robots, and a scope that gives them back."""
    names = rows.column(column)
    order = {name: number for number, name in enumerate(dict.fromkeys(names))}
    robot = np.array([order[name] for name in names], np.int64)
    unique = (robot << _ROBOT_BITS) + ids
    rank = np.argsort(unique, kind="stable")
    return unique, made_scope(
        [f"robot {name}" for name in order],
        list(order),
        kind="table",
        rule=f"the column of robots ({', '.join(order)})",
        codes=unique[rank],
        robots=robot[rank],
        ids=ids[rank],
    )


def _apart(file: PoseFile) -> PoseFile:
    """Without the steps from one robot's last pose to another's first."""
    whose = file.edges.ids >> _ROBOT_BITS
    return dataclasses.replace(file, edges=file.edges[whose[:, 0] == whose[:, 1]])


def _stamps(rows: Rows, at: dict[str, int]) -> np.ndarray | None:
    if "nanoseconds" in at:
        return rows.integers(at["nanoseconds"], at["nanoseconds"] + 1)[:, 0] * 1e-9
    if "seconds" in at:
        return rows.floats(at["seconds"], at["seconds"] + 1)[:, 0]
    return None


POSES = register(
    Format(
        name="poses",
        about="trajectories as CSV with column names",
        recognise=_recognise,
        read=_read,
        information="of each step: --sigmas M RAD",
        stamps="kept",
    )
)
