"""Reading pose graphs: the front door."""

from __future__ import annotations

import warnings
from os import PathLike

import numpy as np

from pcm_jax.errors import FileFormatError, InputError, InputWarning
from pcm_jax.files.candidates import read_candidates
from pcm_jax.files.header import Scope, scope_of
from pcm_jax.files.pose_file import PoseFile, Reading, read_pose_file
from pcm_jax.files.robots import assemble
from pcm_jax.graph.loop_closures import LoopClosures
from pcm_jax.graph.multi_robot import MultiRobotGraph


def read_graph(
    *paths: str | PathLike[str],
    closures: str | PathLike[str] | None = None,
    information: str = "as-written",
    rotation_information: str = "tangent",
    repair: str | None = None,
    format: str | None = None,
) -> MultiRobotGraph:
    """Reads pose-graph files: g2o, TORO or iSAM text, plain or compressed (gzip, xz).

    Robots. Ids that are GTSAM symbol keys name their robot by letter: a robot's file may speak of
    other robots' poses, and an edge repeated from file to file counts once (numbers equal to 1e-5;
    as often as in the file that has it most often). Other ids belong to their file, which is one
    robot; such robots are called a, b, c and so on, in the order of the files.

    A map's poses are in the order of their ids. Edges between two robots become closures, in the
    order of files and lines. A robot without VERTEX lines gets its poses by composing
    measurements along a spanning tree that prefers edges between consecutive poses.

    Args:
        paths: the files.
        closures: a CSV file of further candidates (see `pcm_jax.files.candidates`), appended.
        information: "as-written" takes the numbers for the information matrix, those of iSAM text
            as well, whose format means the square root: many files do not keep to it. "sqrt"
            squares them, Ω = Rᵀ R, whatever the format.
        rotation_information: what `EDGE_SE3:QUAT` lines weight: "tangent", the rotation vector
            (as GTSAM and SE-Sync read them), or "quaternion", the quaternion's vector part (as g2o
            itself does), half as long.
        repair: "clip" raises the eigenvalues of information that is not positive definite to 1e-9
            of the matrix's largest. None makes it an error.
        format: "g2o", "toro" or "isam", where the lines do not decide. `EDGE2` lines are TORO's if
            the file has vertices, else iSAM's, unless only the other order of their information
            is positive definite.

    Returns:
        The robots' maps and the closures between them, float64. Closures and edges know their
        "file:line".

    Raises:
        InputError: for an option that is none of those above, and without paths.
        FileFormatError: for a file that does not hold what its format requires: one line naming
            file, line, value and what was expected.

    Warns:
        InputWarning: for lines skipped (landmarks, priors), counted by tag; quaternions further
            than 1e-3 from unit length; matrices repaired, with their number.
    """
    reading = Reading(information, rotation_information, repair, format)
    if not paths:
        raise InputError("paths: none given, expected at least one file")
    files = [read_pose_file(path, reading) for path in paths]
    _check_one_group(files)
    maps, between = assemble(files, [_scope(file, number) for number, file in enumerate(files)])
    graph = MultiRobotGraph(maps, between)
    clipped = sum(file.clipped for file in files)
    if closures is not None:
        candidates, repaired = read_candidates(closures, graph.maps, reading)
        graph = MultiRobotGraph(graph.maps, LoopClosures.concatenate([between, candidates]))
        clipped += repaired
    if clipped:
        names = ", ".join(file.path for file in files)
        warnings.warn(
            InputWarning(f"{names}: {clipped} information matrices clipped to positive definite"),
            stacklevel=2,
        )
    return graph


def _scope(file: PoseFile, number: int) -> Scope:
    ids = np.concatenate([file.vertices.ids.ravel(), file.edges.ids.ravel()])
    return scope_of(file.path, number, ids, file.comments)


def _check_one_group(files: list[PoseFile]) -> None:
    for file in files:
        if file.group is not files[0].group:
            raise FileFormatError(
                file.path,
                None,
                f"holds {file.group.__name__} poses, but {files[0].path} holds"
                f" {files[0].group.__name__} poses: SE(2) and SE(3) are mixed",
            )
