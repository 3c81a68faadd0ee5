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
from jaxtyping import Bool, Float, Int

from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files.coordinates import upper_triangle
from pcm_jax.files.pose_file import Lines, PoseFile
from pcm_jax.files.scopes import ORDER_LINE, Scope
from pcm_jax.files.text import sources
from pcm_jax.graph import symbols
from pcm_jax.graph.loop_closures import LoopClosures, find
from pcm_jax.graph.pose_graph import PoseGraph
from pcm_jax.graph.spanning_tree import check_connected, spanning_tree_poses
from pcm_jax.graph.validation import Fault, raise_first

EQUAL = 1e-5  # relative: what copies of a number may differ by from file to file


@dataclasses.dataclass(frozen=True)
class Table:
    """Vertices or edges of all files, in the order of files and lines.

    Attributes:
        robot: int64 `[k, 1]` or `[k, 2]`, −1 for a robot that no file defines.
        ids: int64, likewise: the ids of poses, as their robot's map will have them.
        transforms: jaxlie's parameters `[k, 4]` or `[k, 7]`.
        information: `[k, d, d]`.
        file: int64 `[k]`, index of the file.
        line: int64 `[k]`.
        paths: the files.
    """

    robot: Int[np.ndarray, "k ends"]
    ids: Int[np.ndarray, "k ends"]
    transforms: Float[np.ndarray, "k p"]
    information: Float[np.ndarray, "k d d"]
    file: Int[np.ndarray, " k"]
    line: Int[np.ndarray, " k"]
    paths: tuple[str, ...]

    def __getitem__(self, rows: np.ndarray) -> Table:
        picked = {
            field.name: getattr(self, field.name)[rows]
            for field in dataclasses.fields(self)
            if field.name != "paths"
        }
        return Table(**picked, paths=self.paths)

    def __len__(self) -> int:
        return len(self.line)

    @property
    def first_path(self) -> str:
        """The file of the first row."""
        return self.paths[self.file[0]]

    @property
    def fault(self) -> Fault:
        """Names a row by its file and line."""
        return lambda row, problem: FileFormatError(
            self.paths[self.file[row]], int(self.line[row]), problem
        )

    @property
    def source(self) -> np.ndarray:
        """Object array `[k]` of strings "file:line"."""
        names = np.empty(len(self), dtype=object)
        for file in np.unique(self.file):
            rows = self.file == file
            names[rows] = sources(self.paths[file], self.line[rows])
        return names


def assemble(
    files: Sequence[PoseFile], scopes: Sequence[Scope]
) -> tuple[tuple[PoseGraph, ...], LoopClosures]:
    """The robots' maps and the closures between them.

    Raises:
        FileFormatError: for an edge to a vertex or robot that does not exist, a vertex repeated
            with another pose, and a map that is not connected.
    """
    robots = _robots(files, scopes)
    vertices = _table([file.vertices for file in files], files, scopes, list(robots))
    edges = _table([file.edges for file in files], files, scopes, list(robots))
    _check_robots(vertices, edges)
    edges = edges[first_copies(edges)]
    inside = edges.robot[:, 0] == edges.robot[:, 1]
    in_order = any(ORDER_LINE in file.comments for file in files)
    maps = []
    for robot, name in enumerate(robots.values()):
        own = edges[inside & (edges.robot[:, 0] == robot)]
        named = edges.ids[edges.robot == robot]
        mine = vertices[vertices.robot[:, 0] == robot]
        ids = _pose_order(mine.ids[:, 0], in_order) if len(mine) else np.unique(named)
        maps.append(_map(mine, own, ids, name))
    return tuple(maps), _closures(edges[~inside], maps)


def _robots(files: Sequence[PoseFile], scopes: Sequence[Scope]) -> dict[str, str]:
    """The robots' labels and names, in the order of the files that define them.

    A file defines a robot whose poses it has, or whose poses its edges join.
    """
    robots: dict[str, str] = {}
    for file, scope in zip(files, scopes, strict=True):
        vertex, _ = scope.locate(file.vertices.ids)
        edge, _ = scope.locate(file.edges.ids)
        defined = {*vertex[:, 0].tolist(), *edge[edge[:, 0] == edge[:, 1], 0].tolist()}
        for robot, label in enumerate(scope.labels):
            if robot in defined:
                robots.setdefault(label, scope.names[robot])
    return robots


def _table(
    parts: Sequence[Lines], files: Sequence[PoseFile], scopes: Sequence[Scope], robots: list[str]
) -> Table:
    """The files' vertices, or their edges, end to end."""
    located = []
    for part, scope in zip(parts, scopes, strict=True):
        local, ids = scope.locate(part.ids)
        known = [robots.index(label) if label in robots else -1 for label in scope.labels]
        located.append((np.array([*known, -1], np.int64)[local], ids))
    return Table(
        robot=np.concatenate([robot for robot, _ in located]),
        ids=np.concatenate([ids for _, ids in located]),
        transforms=np.concatenate([part.transforms for part in parts]),
        information=np.concatenate([part.information for part in parts]),
        file=np.repeat(np.arange(len(parts)), [len(part) for part in parts]),
        line=np.concatenate([part.line for part in parts]),
        paths=tuple(file.path for file in files),
    )


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
    key = np.array([pose], np.int64)
    letter = int(symbols.letters_of(key)[0])
    return f"{chr(letter)}{symbols.indices_of(key)[0]}" if letter else str(pose)


def first_copies(edges: Table) -> Bool[np.ndarray, " k"]:
    """Which edges to keep, bool `[k]`, so that one repeated from file to file counts once.

    An edge of a file is a copy when an earlier file has one between the same poses with the same
    numbers (to 1e-5) that no other edge of this file is the copy of. So an edge is kept as often as
    it occurs in the file that has it most often.
    """
    keep = np.ones(len(edges), bool)
    if len(np.unique(edges.file)) < 2:
        return keep
    ends = np.concatenate([edges.robot, edges.ids], axis=1)
    _, group = np.unique(ends, axis=0, return_inverse=True)
    order = np.argsort(group, kind="stable")
    bounds = np.flatnonzero(np.diff(group[order])) + 1
    for rows in np.split(order, bounds):
        if edges.file[rows[0]] != edges.file[rows[-1]]:
            keep[rows] = _kept(edges, rows)
    return keep


def _kept(edges: Table, rows: np.ndarray) -> list[bool]:
    """`first_copies` of edges between one pair of poses, in the files' order."""
    kept: list[int] = []
    matched: list[set[int]] = []  # for each kept edge, the files that have a copy of it
    flags = []
    for row in rows.tolist():
        file = int(edges.file[row])
        same = (
            slot
            for slot, original in enumerate(kept)
            if file not in matched[slot] and _same_numbers(edges, row, original)
        )
        slot = next(same, None)
        flags.append(slot is None)
        if slot is None:
            kept.append(row)
            matched.append({file})
        else:
            matched[slot].add(file)
    return flags


def _same_numbers(table: Table, row: int, other: int, information: bool = True) -> bool:
    """Whether two rows' numbers agree to 1e-5 of their size; q and −q are the same rotation."""
    a, b = table.transforms[row], table.transforms[other]
    size = 2 if len(a) == 4 else 4
    turned = -1.0 if size == 4 and a[:size] @ b[:size] < 0.0 else 1.0
    pairs = [(a[:size], turned * b[:size]), (a[size:], b[size:])]
    if information:
        both = upper_triangle(table.information[[row, other]])
        pairs.append((both[0], both[1]))
    return all(
        np.abs(x - y).max() <= EQUAL * max(np.abs(x).max(), np.abs(y).max()) for x, y in pairs
    )


def _pose_order(ids: np.ndarray, in_order: bool) -> np.ndarray:
    """The different ids of vertices: ascending, or in the order of their lines."""
    unique, first = np.unique(ids, return_index=True)
    return unique[np.argsort(first)] if in_order else unique


def _map(vertices: Table, edges: Table, ids: np.ndarray, name: str) -> PoseGraph:
    """One robot's map.

    Args:
        vertices: the robot's; none for files that have edges only.
        edges: those between the robot's own poses.
        ids: its poses' ids, in the order to be.
        name: the robot's.
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
    )


def _unrepeated(vertices: Table, ids: np.ndarray) -> np.ndarray:
    """The parameters of the vertex with each of `ids`; repeated ones must agree."""
    slot, _ = find(ids, vertices.ids[:, 0])
    first = np.full(len(ids), len(vertices))
    np.minimum.at(first, slot, np.arange(len(vertices)))
    original = first[slot]
    for row in np.flatnonzero(original != np.arange(len(vertices))).tolist():
        if not _same_numbers(vertices, row, int(original[row]), information=False):
            where = vertices[original[[row]]].source[0]
            raise vertices.fault(
                row,
                f"vertex {pose_text(vertices.ids[row, 0])} again, with another pose than at"
                f" {where}",
            )
    return vertices.transforms[first]


def positions(ids: np.ndarray, edges: Table, end: int) -> np.ndarray:
    """Where in `ids` the ends 0 or 1 of edges are, int64 `[k]`.

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


def _closures(edges: Table, maps: Sequence[PoseGraph]) -> LoopClosures:
    """Edges between robots as closures, in the order of files and lines."""
    ends = np.zeros((len(edges), 2), np.int64)
    for end in (0, 1):
        for robot in np.unique(edges.robot[:, end]):
            rows = edges.robot[:, end] == robot
            ends[rows, end] = positions(maps[robot].ids, edges[rows], end)
    return LoopClosures.from_checked(
        (edges.robot[:, 0], ends[:, 0], edges.robot[:, 1], ends[:, 1]),
        maps[0].group(edges.transforms),
        edges.information,
        edges.source,
    )
