"""Trajectories as maps: poses in order, joined by their own relative poses."""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.errors import FileFormatError
from pcm_jax.files._scope import Scope
from pcm_jax.files.pose_file import Lines, PoseFile, Reading


def trajectory_file(
    path: str,
    format: str,
    poses: Any,
    line: Int[np.ndarray, " n"],
    reading: Reading,
    *,
    ids: Int[np.ndarray, " n"] | None = None,
    stamps: Float[np.ndarray, " n"] | None = None,
    scope: Scope | None = None,
) -> PoseFile:
    """Makes a map of a trajectory's file: its poses, and a step from each to the next.

    Args:
        path: the file.
        format: its format's name.
        poses: NumPy-backed Lie `[n]`, in order.
        line: where each stands.
        reading: the options of reading; its default sigmas are the steps' standard deviations.
        ids: of the poses; 0 … n − 1 by default.
        stamps: seconds of the poses.
        scope: whose the ids are, where the file says so.

    Raises:
        FileFormatError: without default sigmas, and for no poses.
    """
    group, count = lie.group_of(poses), len(line)
    if not count:
        raise FileFormatError(path, None, "no poses, expected a trajectory")
    check_sigmas(path, int(line[0]), reading)
    information = reading.default_information(group)
    own = np.arange(count) if ids is None else ids
    order = np.argsort(own, kind="stable")
    poses, own, line = lie.take(poses, order), own[order], line[order]
    steps = lie.between(lie.take(poses, slice(None, -1)), lie.take(poses, slice(1, None)))
    d = lie.tangent_dim(group)
    return PoseFile(
        path,
        group,
        Lines(own[:, None], np.asarray(lie.parameters(poses)), np.zeros((count, d, d)), line),
        Lines(
            np.stack([own[:-1], own[1:]], axis=1),
            np.asarray(lie.parameters(steps)),
            np.tile(cast(Any, information), (count - 1, 1, 1)),
            line[1:],
        ),
        format=format,
        scope=scope,
        stamps=None if stamps is None else (own, stamps[order]),
        how="default sigmas, of each step",
        notes=_backwards(stamps[order], line) if stamps is not None else (),
    )


def _backwards(stamps: Float[np.ndarray, " n"], line: Int[np.ndarray, " n"]) -> tuple[str, ...]:
    """A line on times that run backwards: steps are taken in the order of poses."""
    back = np.flatnonzero(np.diff(stamps) < 0.0)
    if not back.size:
        return ()
    row = int(back[0]) + 1
    return (
        f"line {line[row]}: time {stamps[row]:.9g} after {stamps[row - 1]:.9g}; a step goes from"
        " each pose to the next one all the same",
    )


def joined_in_order(file: PoseFile, reading: Reading) -> PoseFile:
    """Joins the poses of a file without measurements by steps, in the order of their ids.

    A file that has measurements, or an id twice, is left as it is.
    """
    ids, vertices = file.vertices.ids[:, 0], file.vertices
    if len(file.edges) or not len(vertices) or len(np.unique(ids)) < len(ids):
        return file
    poses = file.group(vertices.transforms)
    made = trajectory_file(file.path, file.format, poses, vertices.line, reading, ids=ids)
    return dataclasses.replace(file, edges=made.edges)


def check_sigmas(path: str, line: int, reading: Reading) -> None:
    """Raises `FileFormatError` without default sigmas, before a long file is taken to numbers."""
    if reading.default_sigmas is None:
        raise FileFormatError(
            path,
            line,
            "a trajectory says nothing of its steps' uncertainty; give default_sigmas=(metres,"
            " radians) (--sigmas M RAD)",
        )
