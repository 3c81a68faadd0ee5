"""Trajectories in the TUM format: `timestamp x y z qx qy qz qw`, one pose a line."""

from __future__ import annotations

from os import PathLike
from typing import Any

import jaxlie
import numpy as np
from jaxtyping import Float

from pcm_jax import lie
from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files import coordinates
from pcm_jax.files.output import write_text
from pcm_jax.files.source import read_lines
from pcm_jax.files.text import table_rows
from pcm_jax.graph import checked
from pcm_jax.graph.pose_graph import PoseGraph

COLUMNS = "timestamp x y z qx qy qz qw"


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
    lines = read_lines(path)
    rows = table_rows(str(path), lines)
    if not len(rows):
        raise FileFormatError(path, None, f"no poses, expected lines of {COLUMNS}")
    rows.check_width(8, COLUMNS, len(lines))
    values = rows.floats(0, 8)
    parameters = coordinates.parameters("quaternion", values[:, 1:], rows.fault)
    return values[:, 0], lie.as_numpy(jaxlie.SE3(parameters))  # type: ignore[arg-type]


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
    _, poses = read_tum(path)
    return PoseGraph.from_trajectory(
        poses, sigma_translation=sigma_translation, sigma_rotation=sigma_rotation
    )


def write_trajectory(path: str | PathLike[str], poses: Any, *, timestamps: Any = None) -> None:
    """Writes poses in the TUM format, whole or not at all; `.gz` and `.xz` compress.

    Args:
        path: the file.
        poses: a `PoseGraph`, `jaxlie.SE3` or `jaxlie.SE2` `[n]` (written with z = 0), or
            homogeneous matrices.
        timestamps: seconds `[n]`; 0, 1, 2, … by default.

    Raises:
        InputError: for bad poses, or timestamps of another length.
        FileFormatError: for a folder that does not exist or cannot be written to.
    """
    given = poses.poses if isinstance(poses, PoseGraph) else poses
    parameters = np.asarray(lie.parameters(checked.as_transforms(given, "poses")))
    if parameters.shape[1] == 4:
        parameters = _in_space(parameters)
    count = len(parameters)
    seconds = np.arange(count, dtype=np.float64) if timestamps is None else np.asarray(timestamps)
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
