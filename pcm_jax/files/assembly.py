"""From what files hold to one graph: whose poses, one map a robot, closures counted once."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np

from pcm_jax.errors import FileFormatError
from pcm_jax.files._components import by_components
from pcm_jax.files._lettered import called_by_name, lettered_candidates
from pcm_jax.files._named import assumed, named_closures
from pcm_jax.files.account import Account, Copy, account_of
from pcm_jax.files.names import Roster
from pcm_jax.files.plausibility import doubts
from pcm_jax.files.pose_file import PoseFile, Reading, without_self_loops
from pcm_jax.files.robots import assemble
from pcm_jax.files.scopes import scopes_of
from pcm_jax.files.text import line_fault
from pcm_jax.graph.copies import counted_once
from pcm_jax.graph.loop_closures import LoopClosures
from pcm_jax.graph.multi_robot import MultiRobotGraph
from pcm_jax.graph.pose_graph import PoseGraph
from pcm_jax.graph.unsaid import told

MOST_BAD = 1000  # candidates that `skip_bad` leaves out of one file


def graph_of(
    files: Sequence[PoseFile],
    reading: Reading,
    notes: Sequence[str] = (),
    *,
    skip_bad: bool = False,
) -> tuple[MultiRobotGraph, Account]:
    """Puts files together, and tells how.

    Args:
        files: what they hold, candidates after the maps.
        reading: the options with which they were read.
        notes: what was left out before.
        skip_bad: whether candidates that name no pose are left out and counted.

    Raises:
        FileFormatError: as `read_graph`.
    """
    files = lettered_candidates(files) if reading.ids == "auto" else files
    own = [file for file in files if not (file.candidates and file.named is not None)]
    if not own or all(file.candidates for file in own):
        raise FileFormatError(files[0].path, None, "candidates only, expected a map as well")
    check_one_group([file for file in own if len(file.edges) or len(file.vertices)])
    placed, scopes = scopes_of(own, reading.ids)
    placed = [without_self_loops(file) for file in placed]
    if reading.components:
        scopes = [by_components(*both) for both in zip(placed, scopes, strict=True)]
    made = assemble(placed, scopes)
    closures, assumptions = _with_information(made.closures, own, made.maps)
    graph = MultiRobotGraph(made.maps, closures, made.truth)
    parts, notes = [closures], [*notes, *made.notes, *assumptions]
    for file in files:
        if file.candidates and file.named is not None:
            meant, told_names = called_by_name(file, graph.names) if file.lettered else (file, [])
            more, left_out = _tolerant(meant, graph, skip_bad)
            parts.append(more)
            notes += [*told_names, *left_out]
    bare = {file.path for file in files if file.bare}
    between, copies = _once(LoopClosures.concatenate(parts), bare)
    graph = MultiRobotGraph(made.maps, between, made.truth)
    accounts = {
        id(file): account_of(found, scope)
        for file, found, scope in zip(own, placed, scopes, strict=True)
    }
    clipped = sum(file.clipped for file in files)
    notes += told(np.asarray(between.information))
    account = Account(
        files=tuple(
            accounts.get(id(file)) or account_of(file, None, _who(file, graph.names))
            for file in files
        ),
        copies=copies,
        notes=tuple(notes),
        doubts=() if clipped else tuple(doubts(graph.maps, between, reading.information)),
        clipped=clipped,
    )
    return graph, account


def _who(file: PoseFile, names: Sequence[str]) -> str:
    """Who is meant by names in a file of candidates that are no robot's own; "" for none."""
    if file.named is None or file.lettered:
        return ""
    fault = line_fault(file.path, file.edges.line)
    try:
        return Roster(names).told(file.named.ravel().tolist(), fault)
    except FileFormatError:  # of candidates that were left out
        return ""


def _with_information(
    closures: LoopClosures, files: Sequence[PoseFile], maps: tuple[PoseGraph, ...]
) -> tuple[LoopClosures, list[str]]:
    """Closures of files that state no uncertainty with the maps' median, and notes on that."""
    information, notes = np.array(closures.information), []
    for path in [file.path for file in files if file.bare]:
        rows = [_path(source) == path for source in closures.source]
        if any(rows):
            information[np.array(rows)], told = assumed(path, maps)
            notes.append(told)
    return (dataclasses.replace(closures, information=information) if notes else closures), notes


def _path(source: object) -> str:
    return str(source).rpartition(":")[0]


def _once(
    closures: LoopClosures, bare: Collection[str] = ()
) -> tuple[LoopClosures, tuple[Copy, ...]]:
    """Closures without those that state another one again, and these.

    Args:
        closures: some.
        bare: the files that state no uncertainty.
    """
    assumed = np.array([_path(source) in bare for source in closures.source], bool)
    once, first, turned = counted_once(closures, assumed)
    again = first != np.arange(len(first))
    seen: set[tuple[int, str]] = set()
    copies = []
    for row in np.flatnonzero(again | np.isin(np.arange(len(first)), first[again])).tolist():
        key = (int(first[row]), _path(closures.source[row]))
        if again[row]:
            source, original = str(closures.source[row]), str(closures.source[first[row]])
            copies.append(Copy(source, original, bool(turned[row]), key not in seen))
        seen.add(key)
    return once, tuple(copies)


def closures_of(
    file: PoseFile, graph: MultiRobotGraph, skip_bad: bool
) -> tuple[LoopClosures, list[str], tuple[Copy, ...]]:
    """The closures of one file of candidates between a graph's maps, each once."""
    closures, left_out = _tolerant(file, graph, skip_bad)
    once, copies = _once(closures)
    return once, [*left_out, *told(np.asarray(once.information))], copies


def _tolerant(
    file: PoseFile, graph: MultiRobotGraph, skip_bad: bool
) -> tuple[LoopClosures, list[str]]:
    """`named_closures`, without the candidates that name no pose where these may be skipped."""
    bad: list[str] = []
    while True:
        try:
            closures, notes = named_closures(file, graph)
        except FileFormatError as error:
            good = file.edges.line != error.line
            if not skip_bad or error.line is None or good.all() or len(bad) >= MOST_BAD:
                raise
            bad.append(str(error))
            kept = None if file.named is None else file.named[good]
            file = dataclasses.replace(file, edges=file.edges[good], named=kept)
            continue
        left_out = [
            f"{file.path}: {len(bad)} bad candidates left out (the first: {one})" for one in bad
        ]
        return closures, [*notes, *left_out[:1]]


def check_one_group(files: Sequence[PoseFile]) -> None:
    """Raises `FileFormatError` unless all files hold poses of one group."""
    for file in files:
        if file.group is not files[0].group:
            raise FileFormatError(
                file.path,
                None,
                f"holds {file.group.__name__} poses, but {files[0].path} holds"
                f" {files[0].group.__name__} poses: SE(2) and SE(3) are mixed",
            )
