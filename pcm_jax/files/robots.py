"""From files to robots: whose poses they hold, and which measurements are the same one.

Vertices and edges of all files are put end to end, each with its file and line, and with robots
and ids in place of the file's own ids.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jaxlie
import numpy as np
from jaxtyping import Bool

from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files._table import Placed, Table
from pcm_jax.files.pose_file import TRUE, UNKNOWN, PoseFile, check_definite
from pcm_jax.files.scopes import ORDER_LINE, Scope
from pcm_jax.graph import symbols
from pcm_jax.graph.copies import EQUAL, first_copies
from pcm_jax.graph.loop_closures import LoopClosures, find
from pcm_jax.graph.pose_graph import PoseGraph
from pcm_jax.graph.priors import Priors
from pcm_jax.graph.spanning_tree import check_connected, spanning_tree_poses
from pcm_jax.graph.validation import raise_first


@dataclasses.dataclass(frozen=True)
class Assembled:
    """The robots' maps and what joins them.

    Attributes:
        maps: in the order of the files that define them.
        closures: edges between robots, in the order of files and lines.
        truth: each robot's true poses, None where no file has them.
        notes: what was left out, one line each.
    """

    maps: tuple[PoseGraph, ...]
    closures: LoopClosures
    truth: tuple[Any, ...] | None
    notes: tuple[str, ...]


def assemble(files: Sequence[PoseFile], scopes: Sequence[Scope]) -> Assembled:
    """Puts files together: the robots' maps and the closures between them.

    Raises:
        FileFormatError: for an edge to a vertex or robot that does not exist, a vertex repeated
            with another pose, singular information of a map's own edge, and a map that is not
            connected.
    """
    robots = _robots(files, scopes)
    if not robots:
        raise FileFormatError(files[0].path, None, "no map among the files, expected at least one")
    placed = Placed(files, scopes, list(robots))
    vertices, edges = placed.table("vertices"), placed.table("edges")
    _check_robots(vertices, edges)
    edges = edges[_kept_copies(edges)]
    robots, vertices, edges, notes = _without_landmarks(robots, vertices, edges)
    inside = edges.robot[:, 0] == edges.robot[:, 1]
    inner = np.flatnonzero(inside)
    check_definite(edges.information[inner], lambda row, text: edges.fault(int(inner[row]), text))
    in_order = any(ORDER_LINE in file.comments for file in files)
    priors, truth = placed.table("priors"), placed.table("truth")
    maps, true = [], []
    for robot, name in robots.items():
        own = edges[inside & (edges.robot[:, 0] == robot)]
        named = edges.ids[edges.robot == robot]
        mine = vertices[vertices.robot[:, 0] == robot]
        ids = _pose_order(mine.ids[:, 0], in_order) if len(mine) else np.unique(named)
        held = priors[priors.robot[:, 0] == robot]
        maps.append(_map(mine, own, ids, name, placed.stamps(robot, ids), held))
        true.append(_truth(truth[truth.robot[:, 0] == robot], ids, maps[-1].group))
    place = np.full(max(robots) + 1, -1)
    place[list(robots)] = np.arange(len(robots))
    known = tuple(true) if any(one is not None for one in true) else None
    return Assembled(tuple(maps), _closures(edges[~inside], maps, place), known, notes)


def _robots(files: Sequence[PoseFile], scopes: Sequence[Scope]) -> dict[str, str]:
    """The robots' labels and names, in the order of the files that define them.

    A file defines a robot whose poses it has, or whose poses its edges join.
    """
    robots: dict[str, str] = {}
    for file, scope in zip(files, scopes, strict=True):
        if file.candidates:
            continue
        vertex, _ = scope.locate(file.vertices.ids)
        edge, _ = scope.locate(file.edges.ids)
        defined = {*vertex[:, 0].tolist(), *edge[edge[:, 0] == edge[:, 1], 0].tolist()}
        for robot, label in enumerate(scope.labels):
            if robot in defined:
                robots.setdefault(label, scope.names[robot])
    return robots


def _check_robots(vertices: Table, edges: Table) -> None:
    """Every vertex is of a known robot, and every edge's robots are defined by some file."""
    unknown = edges.robot < 0

    def problem(row: int) -> str:
        pose = edges.ids[row, int(np.argmax(unknown[row]))]
        return (
            f"edge to pose {pose_text(pose)}, but no file given holds that robot's map;"
            " give its file as well"
        )

    raise_first(unknown.any(axis=1), edges.fault, problem)
    raise_first(
        vertices.robot[:, 0] < 0,
        vertices.fault,
        lambda row: f"vertex {vertices.ids[row, 0]} is not in the file's id table",
    )


def pose_text(pose: Any) -> str:
    """An id as messages show it: "b17" for a symbol key, else the number."""
    return symbols.key_text(int(pose))


def _kept_copies(edges: Table) -> Bool[np.ndarray, " k"]:
    """Finds the edges to keep, bool `[k]`: a map's edge repeated in other files counts once.

    An edge is kept as often as it occurs in the file that has it most often. (Closures are counted
    once whatever their source, when all of them are known: see `pcm_jax.files.read`.)
    """
    keep = np.ones(len(edges), bool)
    inside = np.flatnonzero(edges.robot[:, 0] == edges.robot[:, 1])
    if len(np.unique(edges.file[inside])) < 2:
        return keep
    keep[inside] = _kept(edges[inside])
    return keep


def _kept(edges: Table) -> Bool[np.ndarray, " k"]:
    ends = np.stack([edges.robot[:, 0], edges.ids[:, 0], edges.robot[:, 1], edges.ids[:, 1]], 1)
    group = jaxlie.SE2 if edges.transforms.shape[1] == 4 else jaxlie.SE3
    first = first_copies(ends, group(edges.transforms), edges.information)  # type: ignore[arg-type]
    order = np.lexsort((np.arange(len(edges)), edges.file, first))
    start = np.ones(len(edges), bool)
    start[1:] = (np.diff(first[order]) != 0) | (np.diff(edges.file[order]) != 0)
    run = np.maximum.accumulate(np.where(start, np.arange(len(edges)), 0))
    turn = np.empty(len(edges), np.int64)
    turn[order] = np.arange(len(edges)) - run  # how often the file had it before
    _, kept = np.unique(np.stack([first, turn], axis=1), axis=0, return_index=True)
    keep = np.zeros(len(edges), bool)
    keep[kept] = True
    return keep


def _same_numbers(table: Table, row: int, other: int) -> bool:
    """True if two rows' transforms agree to 1e-5 of their size; q and −q are the same rotation."""
    a, b = table.transforms[row], table.transforms[other]
    size = 2 if len(a) == 4 else 4
    turned = -1.0 if size == 4 and a[:size] @ b[:size] < 0.0 else 1.0
    pairs = [(a[:size], turned * b[:size]), (a[size:], b[size:])]
    return all(
        np.abs(x - y).max() <= EQUAL * max(np.abs(x).max(), np.abs(y).max()) for x, y in pairs
    )


def _without_landmarks(
    robots: dict[str, str], vertices: Table, edges: Table
) -> tuple[dict[int, str], Table, Table, tuple[str, ...]]:
    """Leaves out robots none of whose poses an edge joins: landmarks that have an attitude.

    Returns:
        The other robots' names by number, their vertices, the edges between them, and notes.
    """
    inside = edges.robot[:, 0] == edges.robot[:, 1]
    moving = set(edges.robot[inside, 0].tolist())
    whose = vertices.robot[:, 0]
    poses = {robot: np.unique(vertices.ids[whose == robot]) for robot in range(len(robots))}
    still = [
        robot
        for robot, ids in poses.items()
        if robot not in moving and len(ids) > 1 and moving and symbols.letters_of(ids).all()
    ]
    notes = []
    for robot in still:
        seen = int((edges.robot == robot).any(axis=1).sum())
        first = ", ".join(map(pose_text, poses[robot][:3].tolist()))
        more = ", …" if len(poses[robot]) > 3 else ""
        notes.append(
            f"no edge joins {first}{more} among themselves: landmarks, no trajectory;"
            f" {len(poses[robot])} poses and {seen} edges to them are left out"
        )
    names = {k: name for k, name in enumerate(robots.values()) if k not in still}
    if not still:
        return names, vertices, edges, ()
    vertices = vertices[~np.isin(whose, still)]
    return (
        names,
        vertices,
        edges[np.flatnonzero(~np.isin(edges.robot, still).any(axis=1))],
        tuple(notes),
    )


def _pose_order(ids: np.ndarray, in_order: bool) -> np.ndarray:
    """The different ids of vertices: ascending, or in the order of their lines."""
    unique, first = np.unique(ids, return_index=True)
    return unique[np.argsort(first)] if in_order else unique


def _map(
    vertices: Table,
    edges: Table,
    ids: np.ndarray,
    name: str,
    stamps: np.ndarray | None,
    priors: Table,
) -> PoseGraph:
    """One robot's map.

    Args:
        vertices: the robot's; none for files that have edges only.
        edges: those between the robot's own poses.
        ids: its poses' ids, in the order to be.
        name: the robot's.
        stamps: seconds of its poses, if known.
        priors: poses measured by themselves.
    """
    given = _unrepeated(vertices, ids) if len(vertices) else None
    tail, head = (positions(ids, edges, end) for end in (0, 1))
    group: Any = jaxlie.SE2 if edges.transforms.shape[1] == 4 else jaxlie.SE3
    measurement = group(edges.transforms)
    try:
        check_connected(tail, head, len(ids), ids=ids)
    except InputError as error:
        path = (vertices if len(vertices) else edges).first_path
        raise FileFormatError(path, None, str(error)) from None
    if given is None:
        poses = spanning_tree_poses(tail, head, measurement, len(ids), prefer="odometry")
    else:
        poses = group(given)
    return PoseGraph.from_checked(
        poses=poses,
        tail=tail,
        head=head,
        measurement=measurement,
        information=edges.information,
        ids=ids,
        name=name,
        source=edges.source,
        stamps=stamps,
        priors=_priors(priors, ids, group) if len(priors) else None,
    )


def _priors(table: Table, ids: np.ndarray, group: Any) -> Priors:
    return Priors(
        positions(ids, table, 0).astype(np.int32),
        group(table.transforms),
        table.information,
        table.source,
    )


def _truth(table: Table, ids: np.ndarray, group: Any) -> Any:
    """True poses `[n]` in the order of `ids`, None unless every pose has one."""
    slot, missing = find(table.ids[:, 0], ids) if len(table) else (ids, np.ones(len(ids), bool))
    return None if missing.any() else group(table.transforms[slot])


def _unrepeated(vertices: Table, ids: np.ndarray) -> np.ndarray:
    """The parameters of the vertex with each of `ids`; repeated ones must agree."""
    slot, _ = find(ids, vertices.ids[:, 0])
    first = np.full(len(ids), len(vertices))
    np.minimum.at(first, slot, np.arange(len(vertices)))
    original = first[slot]
    for row in np.flatnonzero(original != np.arange(len(vertices))).tolist():
        if not _same_numbers(vertices, row, int(original[row])):
            where = vertices[original[[row]]].source[0]
            raise vertices.fault(
                row,
                f"vertex {pose_text(vertices.ids[row, 0])} again, with another pose than at"
                f" {where}",
            )
    return vertices.transforms[first]


def positions(ids: np.ndarray, edges: Table, end: int) -> np.ndarray:
    """Places in `ids` of the ends 0 or 1 of edges, int64 `[k]`.

    Raises:
        FileFormatError: for an edge to a vertex that does not exist.
    """
    wanted = edges.ids[:, end]
    slot, missing = find(ids, wanted)
    raise_first(
        missing,
        edges.fault,
        lambda row: f"edge to pose {pose_text(wanted[row])}, which no VERTEX line defines",
    )
    return slot


def _closures(edges: Table, maps: Sequence[PoseGraph], place: np.ndarray) -> LoopClosures:
    """Edges between robots as closures, in the order of files and lines."""
    robots, ends = place[edges.robot], np.zeros((len(edges), 2), np.int64)
    for end in (0, 1):
        for robot in np.unique(robots[:, end]):
            rows = robots[:, end] == robot
            ends[rows, end] = positions(maps[robot].ids, edges[rows], end)
    known = len(edges) > 0 and bool((edges.label != UNKNOWN).all())
    return LoopClosures.from_checked(
        (robots[:, 0], ends[:, 0], robots[:, 1], ends[:, 1]),
        maps[0].group(edges.transforms),
        edges.information,
        edges.source,
        edges.weight,
        edges.label == TRUE if known else None,
    )
