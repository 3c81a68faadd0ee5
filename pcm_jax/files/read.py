"""Reading pose graphs: the front door."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from os import PathLike
from typing import Any

from pcm_jax.errors import FileFormatError, InputError, InputWarning
from pcm_jax.files._named import candidates_between
from pcm_jax.files.account import Account, account_of
from pcm_jax.files.assembly import MOST_BAD, check_one_group, closures_of, graph_of
from pcm_jax.files.formats import named, recognised
from pcm_jax.files.names import check_given_once
from pcm_jax.files.plausibility import doubts
from pcm_jax.files.pose_file import PoseFile, Reading, without_self_loops
from pcm_jax.files.source import LIMIT, Source
from pcm_jax.files.trajectories import joined_in_order
from pcm_jax.graph.loop_closures import LoopClosures
from pcm_jax.graph.multi_robot import MultiRobotGraph
from pcm_jax.graph.pose_graph import PoseGraph

Paths = str | PathLike[str]


def read_graph(
    *paths: Paths | Sequence[Paths],
    closures: Paths | Sequence[Paths] | None = None,
    information: str = "as-written",
    rotation_information: str = "tangent",
    repair: str | None = None,
    format: str | None = None,
    ids: str = "auto",
    default_sigmas: tuple[float, float] | None = None,
    skip_bad: bool = False,
    ignore_priors: bool = False,
    byte_limit: int = LIMIT,
) -> MultiRobotGraph:
    """Reads the robots' maps and the closures between them, from files of any format known.

    `pcm_jax.files` lists the formats; each is told by its content, plain or compressed (gzip, xz).

    Robots. Whose a file's ids are is decided by the rules of `pcm_jax.files.scopes`: GTSAM symbol
    keys name their robot by letter or label, plain ids belong to their file, or are shared by the
    files where they are unique over them. Robots are called by a header, by their symbol, else by
    their file's name.

    A map's poses are in the order of their ids. Edges between two robots become closures, in the
    order of files and lines. An edge repeated from file to file counts once (numbers equal to
    1e-5; as often as in the file that has it most often), a closure that is stated again, in
    whatever source and from either end, once. A robot without VERTEX lines gets its poses by
    composing measurements along a spanning tree that prefers edges between consecutive poses.

    Args:
        paths: the files; a list of them will do. "-" is what comes on standard input.
        closures: files of further candidates, appended: CSV (see
            `pcm_jax.files.formats.candidates`), or any graph file, whose edges they are.
        information: "as-written" takes the numbers for the information matrix, those of iSAM text
            as well, whose format means the square root: many files do not keep to it. "sqrt"
            squares them, Ω = Rᵀ R, whatever the format. "covariance" inverts them.
        rotation_information: what `EDGE_SE3:QUAT` lines weight: "tangent", the rotation vector
            (as GTSAM and SE-Sync read them), or "quaternion", the quaternion's vector part (as g2o
            itself does), half as long.
        repair: "clip" raises the eigenvalues of information that is not positive definite to 1e-9
            of the matrix's largest. None makes it an error.
        format: a format's name, where the content does not decide. `EDGE2` lines are TORO's if
            the file has vertices, else iSAM's, unless only the other order of their information
            is positive definite.
        ids: "auto", or one of the rules: "per-file", "shared", "symbols".
        default_sigmas: standard deviations in metres and radians, of each direction of edges that
            come without information, and of a trajectory's steps.
        skip_bad: whether candidates that cannot be read are left out and counted. Maps' own edges
            must be good.
        ignore_priors: whether poses measured by themselves are left out.
        byte_limit: bytes that one file may have after decompression; 1 GiB by default.

    Returns:
        The robots' maps and the closures between them, float64. Closures and edges know their
        "file:line".

    Raises:
        InputError: for an option that is none of those above, without paths, and for a file given
            twice.
        FileFormatError: for a file that does not hold what its format requires: one line naming
            file, line, value and what was expected.

    Warns:
        InputWarning: for lines skipped (landmarks and the like), counted by tag; closures stated
            again; matrices repaired, with their number; information that cannot be meant as it
            was read; quaternions further than 1e-3 from unit length.

    Example:
        >>> graph = read_graph("a.g2o", "b.g2o", closures="candidates.csv")  # doctest: +SKIP
    """
    reading = Reading(
        information,
        rotation_information,
        repair,
        format,
        ids,
        default_sigmas,
        byte_limit=byte_limit,
    )
    graph, account = read_with_account(
        paths, closures, reading, skip_bad=skip_bad, ignore_priors=ignore_priors
    )
    for line in account.warnings():
        warnings.warn(InputWarning(line), stacklevel=2)
    return graph


def read_with_account(
    paths: Sequence[Any],
    closures: Any,
    reading: Reading,
    *,
    skip_bad: bool = False,
    ignore_priors: bool = False,
    join: bool = False,
) -> tuple[MultiRobotGraph, Account]:
    """Reads as `read_graph` does, and tells what was read and how instead of warning of it.

    With `join`, poses of a file without measurements are a trajectory, in the order of their ids.
    """
    given, others = _flat(paths, "paths"), _flat([] if closures is None else [closures], "closures")
    if not given:
        raise InputError("paths: none given, expected at least one file")
    check_given_once([*given, *others])
    files = [_read(Source(path, reading.byte_limit), reading) for path in given]
    if join:
        files = [joined_in_order(file, reading) for file in files]
    check_one_group(files)
    hinted = dataclasses.replace(reading, group=files[0].group, format=None)
    notes: list[str] = []
    for path in others:
        file, bad = _read_candidates(path, hinted, skip_bad)
        notes += bad
        files.append(dataclasses.replace(file, candidates=True))
    if ignore_priors:
        files = [dataclasses.replace(file, priors=None) for file in files]
    return graph_of(files, reading, notes, skip_bad=skip_bad)


def read_candidates(
    path: Paths,
    maps: MultiRobotGraph | Sequence[PoseGraph],
    *,
    information: str = "as-written",
    default_sigmas: tuple[float, float] | None = None,
    skip_bad: bool = False,
) -> LoopClosures:
    """Reads candidates between maps in memory: CSV, or a graph file whose ids the maps have.

    Args:
        path: the file.
        maps: a graph, or the robots' maps.
        information: as for `read_graph`.
        default_sigmas: likewise.
        skip_bad: likewise.

    Raises:
        FileFormatError: naming file, line, value and what was expected.

    Warns:
        InputWarning: for what was left out, assumed, doubted, or stated again.
    """
    graph = maps if isinstance(maps, MultiRobotGraph) else MultiRobotGraph(tuple(maps))
    reading = Reading(information, default_sigmas=default_sigmas, group=graph.group)
    file, notes = _read_candidates(str(path), reading, skip_bad)
    file = without_self_loops(dataclasses.replace(file, candidates=True))
    file, meant = candidates_between(file, graph)
    closures, told, copies = closures_of(file, graph, skip_bad)
    again = [f"{len(copies)} closures repeat earlier ones and are counted once"] if copies else []
    own = list(account_of(file, None).warnings())
    found = doubts(graph.maps, closures, information)
    doubted = [line for line, severe in found if severe and line.startswith("closures")]
    for line in [*own, *notes, *meant, *told, *again, *doubted]:
        warnings.warn(InputWarning(line), stacklevel=2)
    return closures


def _flat(given: Any, argument: str) -> list[str]:
    """Paths, given one by one or in lists."""
    out: list[str] = []
    for one in given:
        if isinstance(one, list | tuple):
            out += _flat(one, argument)
        elif isinstance(one, str | PathLike):
            out.append(str(one))
        else:
            hint = ""
            if type(one).__module__.split(".")[0] == "gtsam":
                hint = "; from_gtsam(factors, values) takes GTSAM's objects"
            raise InputError(f"{argument}: {type(one).__name__} given, expected a path{hint}")
    return out


def _read(source: Source, reading: Reading) -> PoseFile:
    """One file, in the format asked for or recognised."""
    found = named(reading.format) if reading.format else recognised(source)
    if found.read is None:
        raise InputError(f"format: {found.name!r} given, expected one that is read")
    file = found.read(source, reading)
    return file if file.format else dataclasses.replace(file, format=found.name)


def _read_candidates(path: str, reading: Reading, skip_bad: bool) -> tuple[PoseFile, list[str]]:
    """A file of candidates, without the lines that cannot be read where these may be skipped."""
    source, bad = Source(path, reading.byte_limit), []
    if not source.is_folder and not source.head:
        reading = dataclasses.replace(reading, format="csv")  # no candidates are some
    while True:
        try:
            file = _read(source, reading)
        except FileFormatError as error:
            if not skip_bad or error.line is None or len(bad) >= MOST_BAD:
                raise
            bad.append(str(error))
            source.without_line(error.line)
            continue
        notes = [f"{path}: {len(bad)} bad candidates left out (the first: {bad[0]})"] if bad else []
        return file, notes
