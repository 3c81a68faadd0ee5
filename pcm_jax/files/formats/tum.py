"""Trajectories: TUM's, KITTI's and EuRoC's text, and CSV with column names.

| format | a line |
|---|---|
| TUM | `timestamp x y z qx qy qz qw`, seconds or nanoseconds; commas will do |
| KITTI | the upper 3 × 4 of a homogeneous matrix, row by row; commas will do |
| EuRoC | `timestamp, x, y, z, qw, qx, qy, qz, …`, nanoseconds; a comment names the columns |
| CSV | columns by name, as Kimera-Multi's `robot_index,pose_index,qx,qy,qz,qw,tx,ty,tz` |

As maps their poses are joined by their own relative poses, whose uncertainty is the reader's to
say.
"""

from __future__ import annotations

import dataclasses
import re
from os import PathLike
from typing import Any

import jaxlie
import numpy as np
from jaxtyping import Float

from pcm_jax import lie
from pcm_jax.arrays import as_real
from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files import coordinates
from pcm_jax.files.formats._registry import Format, register
from pcm_jax.files.output import write_text
from pcm_jax.files.pose_file import PoseFile, Reading
from pcm_jax.files.source import Source
from pcm_jax.files.text import Rows, csv_rows, table_rows
from pcm_jax.files.trajectories import check_sigmas, trajectory_file
from pcm_jax.graph import checked
from pcm_jax.graph.pose_graph import PoseGraph

COLUMNS = "timestamp x y z qx qy qz qw"
_NANOSECONDS = 1e14  # stamps above are nanoseconds: as seconds, three million years


def read_tum(path: str | PathLike[str]) -> tuple[Float[np.ndarray, " n"], Any]:
    """Timestamps and poses of a TUM trajectory; blank lines and comments are skipped.

    Returns:
        Seconds `[n]`, and NumPy-backed `jaxlie.SE3` `[n]`, in the file's order.

    Raises:
        FileFormatError: for a line that is not eight finite numbers, a quaternion of norm zero, a
            file without poses.

    Warns:
        InputWarning: for quaternions further than 1e-3 from unit length, which are scaled.
    """
    source = Source(path)
    rows = _rows(source)
    if not len(rows):
        raise FileFormatError(path, None, f"no poses, expected lines of {COLUMNS}")
    rows.check_width(8, COLUMNS, int(rows.line[-1]))
    return _tum(rows, _order(source, rows))


def _order(source: Source, rows: Rows) -> list[int]:
    """Places of the columns of `COLUMNS`: a comment above the first row may name w before x."""
    named = source.comment_before(int(rows.line[0])) if len(rows) else None
    last = [re.sub(r"[^a-z]", "", word.lower())[-1:] for word in (named or [])[-4:]]
    return [0, 1, 2, 3, 5, 6, 7, 4] if last == ["w", "x", "y", "z"] else list(range(8))


def _tum(rows: Rows, order: list[int]) -> tuple[Float[np.ndarray, " n"], Any]:
    values = rows.floats(0, 8)[:, order]
    parameters = coordinates.parameters("quaternion", values[:, 1:], rows.fault)
    if len(values) and values[0, 0] >= _NANOSECONDS:
        values[:, 0] *= 1e-9
    return values[:, 0], lie.as_numpy(jaxlie.SE3(parameters))  # type: ignore[arg-type]


def _rows(source: Source) -> Rows:
    """Rows of a table, between whose columns is white space, or commas if the first row has any."""
    first = source.head[0][1] if source.head else ""
    split = csv_rows if "," in first else table_rows
    return split(source.path, source.lines)


def read_trajectory(
    path: str | PathLike[str], *, sigma_translation: float, sigma_rotation: float
) -> PoseGraph:
    """A TUM trajectory as an odometry chain: consecutive poses joined by their relative pose.

    Args:
        path: the file, plain or compressed.
        sigma_translation: standard deviation of each translation component of a step, metres.
        sigma_rotation: standard deviation of each rotation component of a step, radians.

    Raises:
        FileFormatError: as `read_tum`.
        InputError: for a sigma that is not positive.
    """
    seconds, poses = read_tum(path)
    graph = PoseGraph.from_trajectory(
        poses, sigma_translation=sigma_translation, sigma_rotation=sigma_rotation
    )
    return dataclasses.replace(graph, stamps=seconds)


def write_trajectory(path: str | PathLike[str], poses: Any, *, timestamps: Any = None) -> None:
    """Writes poses in the TUM format, whole or not at all; `.gz` and `.xz` compress.

    Args:
        path: the file.
        poses: a `PoseGraph`, `jaxlie.SE3` or `jaxlie.SE2` `[n]` (written with z = 0), or
            homogeneous matrices.
        timestamps: seconds `[n]`; by default those of a `PoseGraph` that has them, else 0, 1,
            2, …

    Raises:
        InputError: for bad poses, or timestamps of another length.
        FileFormatError: for a folder that does not exist or cannot be written to.
    """
    given = poses.poses if isinstance(poses, PoseGraph) else poses
    parameters = np.asarray(lie.parameters(checked.as_transforms(given, "poses")))
    if parameters.shape[1] == 4:
        parameters = _in_space(parameters)
    count = len(parameters)
    if timestamps is None and isinstance(poses, PoseGraph) and poses.stamps is not None:
        timestamps = poses.stamps
    timestamps = np.arange(count) if timestamps is None else timestamps
    seconds = as_real(timestamps, "timestamps")
    if seconds.shape != (count,):
        raise InputError(f"timestamps: shape {seconds.shape} given, expected ({count},)")
    rows = np.concatenate([seconds[:, None], coordinates.columns(parameters)], axis=1)
    lines = (" ".join(map(repr, row)) for row in rows.tolist())
    write_text(path, "\n".join([f"# {COLUMNS}", *lines, ""]))


def _in_space(parameters: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 7"]:
    """SE(3) parameters of SE(2) ones: rotations about z."""
    cos, sin, x, y = parameters.T
    half = 0.5 * np.arctan2(sin, cos)
    zero = np.zeros_like(x)
    return np.stack([np.cos(half), zero, zero, np.sin(half), x, y, zero], axis=1)


def _numbers(source: Source) -> list[float] | None:
    """The first row's numbers, None where something else stands there."""
    if not source.head:
        return None
    try:
        return [float(word) for word in source.head[0][1].replace(",", " ").split()]
    except ValueError:
        return None


def _is_tum(source: Source) -> float:
    first = _numbers(source)
    if first is None or len(first) != 8:
        return 0.0
    return 0.9 * (first[0] < _NANOSECONDS or "," not in source.head[0][1])


def _is_kitti(source: Source) -> float:
    first = _numbers(source)
    return 0.9 * (first is not None and len(first) == 12)


def _is_euroc(source: Source) -> float:
    first = _numbers(source)
    known = first is not None and len(first) >= 8 and "," in source.head[0][1]
    return 0.95 * (known and first is not None and first[0] >= _NANOSECONDS)


def _read_tum(source: Source, reading: Reading) -> PoseFile:
    check_sigmas(source.path, source.head[0][0] if source.head else 1, reading)
    rows = _rows(source)
    rows.check_width(8, COLUMNS, len(source.lines))
    seconds, poses = _tum(rows, _order(source, rows))
    return trajectory_file(source.path, "tum", poses, rows.line, reading, stamps=seconds)


def _read_kitti(source: Source, reading: Reading) -> PoseFile:
    check_sigmas(source.path, source.head[0][0] if source.head else 1, reading)
    rows = _rows(source)
    rows.check_width(12, "the upper 3 x 4 of a matrix, row by row", len(source.lines))
    matrices = np.tile(np.eye(4), (len(rows), 1, 1))
    matrices[:, :3] = rows.floats(0, 12).reshape(-1, 3, 4)
    poses = checked.as_transforms(matrices, "poses", rows.fault)
    return trajectory_file(source.path, "kitti", poses, rows.line, reading)


def _read_euroc(source: Source, reading: Reading) -> PoseFile:
    check_sigmas(source.path, source.head[0][0] if source.head else 1, reading)
    rows = _rows(source)
    rows.check_width(len(rows.first), "timestamp,x,y,z,qw,qx,qy,qz,…", len(source.lines))
    values = rows.floats(1, 8)
    order = [0, 1, 2, 4, 5, 6, 3]  # qw comes first
    parameters = coordinates.parameters("quaternion", values[:, order], rows.fault)
    poses = lie.as_numpy(jaxlie.SE3(parameters))  # type: ignore[arg-type]
    stamps = rows.integers(0, 1)[:, 0] * 1e-9
    return trajectory_file(source.path, "euroc", poses, rows.line, reading, stamps=stamps)


_STEPS = "of each step: --sigmas M RAD"


def _trajectory(name: str, recognise: Any, read: Any, stamps: str = "kept") -> Format:
    about = "a trajectory, 3D"
    return register(Format(name, about, recognise, read, information=_STEPS, stamps=stamps))


TUM = _trajectory("tum", _is_tum, _read_tum)
KITTI = _trajectory("kitti", _is_kitti, _read_kitti, stamps="none")
EUROC = _trajectory("euroc", _is_euroc, _read_euroc)
