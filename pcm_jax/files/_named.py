"""Candidates that call their robots by name, once the maps are known."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from pcm_jax.errors import FileFormatError
from pcm_jax.files._lettered import called_by_name, lettered
from pcm_jax.files.names import Roster
from pcm_jax.files.pose_file import TRUE, UNKNOWN, PoseFile
from pcm_jax.files.text import line_fault, sources
from pcm_jax.graph import symbols
from pcm_jax.graph.loop_closures import LoopClosures, pose_indices
from pcm_jax.graph.multi_robot import MultiRobotGraph
from pcm_jax.graph.pose_graph import PoseGraph
from pcm_jax.graph.validation import raise_first


def named_closures(file: PoseFile, graph: MultiRobotGraph) -> tuple[LoopClosures, tuple[str, ...]]:
    """The closures of a file whose robots are named, and notes on what was left out or assumed.

    Raises:
        FileFormatError: naming the line of a robot or pose that is not there, or of a closure
            inside one robot.
    """
    edges = file.edges
    fault = line_fault(file.path, edges.line)
    if file.group is not graph.group and len(edges):
        raise FileFormatError(
            file.path,
            int(edges.line[0]),
            f"{file.group.__name__} measurements, expected {graph.group.__name__} like the maps",
        )
    if not len(edges) or file.named is None:
        return LoopClosures.empty(graph.group), ()
    roster, called = Roster(graph.names), file.named
    count = len(edges)
    names = [str(name) for name in called.T.ravel()]  # both ends together tell what numbers mean
    found = roster.indices(names, lambda row, problem: fault(row % count, problem))
    raise_first(
        found < 0,
        lambda row, problem: fault(row % count, problem),
        lambda row: f"there is no robot {names[row][:40]!r}, expected one of {roster.expected()}",
    )
    robots = list(found.reshape(2, count))
    loops = (robots[0] == robots[1]) & (edges.ids[:, 0] == edges.ids[:, 1])
    raise_first(
        (robots[0] == robots[1]) & ~loops,
        fault,
        lambda row: (
            f"closure from robot {called[row, 0]!r} to itself, expected two robots; skip_bad"
            " (--skip-bad) leaves such candidates out"
        ),
    )
    rows = np.flatnonzero(~loops)
    kept, robots = edges[rows], [robot[rows] for robot in robots]
    own = line_fault(file.path, kept.line)
    poses = [pose_indices(graph.maps, robots[end], kept.ids[:, end], own) for end in (0, 1)]
    information, notes = kept.information, []
    if loops.any():
        notes.append(f"{file.path}: {int(loops.sum())} candidates from a pose to itself left out")
    if file.bare and len(kept):
        median, told = assumed(file.path, graph.maps)
        information = np.tile(median, (len(kept), 1, 1))
        notes.append(told)
    known = bool((kept.label != UNKNOWN).all())
    closures = LoopClosures.from_checked(
        (robots[0], poses[0], robots[1], poses[1]),
        graph.group(kept.transforms),
        information,
        sources(file.path, kept.line),
        kept.weight,
        kept.label == TRUE if known else None,
    )
    return closures, tuple(notes)


def candidates_between(file: PoseFile, graph: MultiRobotGraph) -> tuple[PoseFile, list[str]]:
    """The candidates of a file with their robots by name, and a note on who letters stand for.

    Raises:
        FileFormatError: as `named_by_ids`, or for letters that may mean any two of the robots.
    """
    if file.named is not None:
        return file, []
    known = np.concatenate([one.ids for one in graph.maps])
    if symbols.are_symbols(file.ids) and not np.isin(file.ids, known).any():
        return called_by_name(lettered(file), graph.names)
    return dataclasses.replace(file, named=named_by_ids(file, graph)), []


def named_by_ids(file: PoseFile, graph: MultiRobotGraph) -> np.ndarray:
    """The robots by name, object `[k, 2]`, of edges whose ids exactly one map has.

    Raises:
        FileFormatError: for an id that no map has, or several have.
    """
    ids = file.edges.ids
    holds = np.array([np.isin(ids, one.ids) for one in graph.maps])
    count = holds.sum(axis=0)
    raise_first(
        (count != 1).any(axis=1),
        line_fault(file.path, file.edges.line),
        lambda row: (
            f"pose {ids[row][count[row] != 1][0]} is in {count[row][count[row] != 1][0]} of the"
            " maps, expected in one"
        ),
    )
    names = np.array(graph.names, object)
    return names[np.argmax(holds, axis=0)] if ids.size else np.zeros((0, 2), object)


def assumed(path: str, maps: tuple[PoseGraph, ...]) -> tuple[Float[np.ndarray, "d d"], str]:
    """The information of candidates that come without, and a note that says so."""
    information = _median_information(maps)
    text = ", ".join(f"{sigma:.3g}" for sigma in 1.0 / np.sqrt(np.diagonal(information)))
    return information, (
        f"{path}: no columns for the uncertainty; the median standard deviations of the maps' edges"
        f" ({text}) are used"
    )


def _median_information(maps: tuple[PoseGraph, ...]) -> Float[np.ndarray, "d d"]:
    """Diagonal, of the median standard deviation of the maps' edges in each direction."""
    information = np.concatenate([np.asarray(graph.information) for graph in maps])
    if not len(information):
        return np.eye(maps[0].tangent_dim)
    variances = np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)
    return np.diag(1.0 / np.median(np.abs(variances), axis=0))
