"""g2o's text, read and written."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any

import jaxlie
import numpy as np

from pcm_jax import lie
from pcm_jax.errors import InputError, check_choice, check_class
from pcm_jax.files import coordinates
from pcm_jax.files.formats._registry import Format, register
from pcm_jax.files.formats._tagged import read_tagged, tagged_lines
from pcm_jax.files.names import stem_of
from pcm_jax.files.output import write_text
from pcm_jax.files.scopes import (
    FRAME_LINE,
    ORDER_LINE,
    ROBOT_LINE,
    TABLE_COLUMNS,
    TABLE_DIGEST_LINE,
    TABLE_LINE,
    table_digest,
)
from pcm_jax.graph import symbols
from pcm_jax.graph.multi_robot import MultiRobotGraph
from pcm_jax.graph.pose_graph import PoseGraph

IDS = ("original", "sequential")


def write_g2o(
    path: str | PathLike[str],
    graph: MultiRobotGraph | PoseGraph,
    *,
    ids: str = "original",
    frame: str = "",
) -> None:
    """Writes maps and closures as one g2o file, from which `read_graph` makes the same graph.

    The file has all vertices robot by robot, then the maps' edges, then the closures, in their
    order; numbers have 17 digits, information is over the tangent. It is written whole or not at
    all; `.gz` and `.xz` compress it.

    Args:
        path: the file.
        graph: what to write.
        ids: "original": one robot's ids as they are; several robots' as GTSAM symbol keys, which
            name the robot by letter. Comments in the file say how to get names and ids back.
            "sequential": 0, 1, 2, … over all robots, as g2o_viewer expects, with a table of
            robots and ids beside the file: `merged.ids.csv` for `merged.g2o`.
        frame: the robot in whose frame all poses stand, for a comment; none by default.

    Raises:
        FileFormatError: for a folder that does not exist or cannot be written to.
        InputError: for another value of `ids`, poses that are neither SE(2) nor SE(3), a robot's
            name that is not printable text, and for "original" where ids do not fit a symbol key
            (0 … 2^56 − 1) or there are more robots than letters (94).
    """
    check_choice("ids", ids, IDS)
    check_class("path", path, "a path", str, PathLike)
    check_class("graph", graph, "a MultiRobotGraph or PoseGraph", MultiRobotGraph, PoseGraph)
    if isinstance(graph, PoseGraph):
        graph = MultiRobotGraph((graph,))
    _check_writable(graph)
    if ids == "sequential":
        starts = np.cumsum([0, *(pose_graph.num_poses for pose_graph in graph.maps)])
        keys = [np.arange(a, b) for a, b in pairwise(starts)]
        table = table_path(Path(path))
        if not table.name.isprintable() or table.name.strip() != table.name:
            raise InputError(
                f"path: {table.name!r} cannot be named in a comment, expected printable text"
                " without space around it"
            )
        text = _id_table(graph.maps)
        write_text(table, text)
        header = [
            TABLE_LINE.format(file=table.name),
            TABLE_DIGEST_LINE.format(digest=table_digest(text)),
        ]
    else:
        header, keys = original_keys(graph.maps, own_name=stem_of(str(path)))
    if any((np.diff(pose_graph.ids) < 0).any() for pose_graph in graph.maps):
        header.append(ORDER_LINE)
    if frame:
        header.append(FRAME_LINE.format(name=frame))
    # At the end: GTSAM's reader of 2D files stops at the first line that it does not know.
    write_text(path, "\n".join([*_body(graph, keys), *header, ""]))


def check_group(graph: MultiRobotGraph) -> None:
    """Raises `InputError` for a group that formats do not know."""
    if graph.group not in (jaxlie.SE2, jaxlie.SE3):
        raise InputError(f"graph: {graph.group.__name__} given, expected SE2 or SE3")


def _check_writable(graph: MultiRobotGraph) -> None:
    """The group has a tag, and the names fit into a comment."""
    check_group(graph)
    for name in graph.names:
        if not name.isprintable() or name.strip() != name:
            raise InputError(
                f"graph: the robot name {name!r} cannot be written, expected printable text"
                " without space around it"
            )


def table_path(path: Path) -> Path:
    """`merged.ids.csv` beside `merged.g2o`, `NAME.ids.csv` beside any other NAME."""
    return path.with_suffix(".ids.csv") if path.suffix == ".g2o" else Path(f"{path}.ids.csv")


def _id_table(maps: Sequence[PoseGraph]) -> str:
    """CSV text with the columns vertex, robot, id."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(TABLE_COLUMNS)
    named = ((graph.name, pose) for graph in maps for pose in graph.ids.tolist())
    table.writerows((vertex, *row) for vertex, row in enumerate(named))
    return text.getvalue()


def original_keys(
    maps: Sequence[PoseGraph], own_name: str = ""
) -> tuple[list[str], list[np.ndarray]]:
    """Comments, and the ids to write for each robot's poses: one robot's own, else symbol keys.

    Args:
        maps: the robots'.
        own_name: the name that a file's one robot has without a comment.

    Raises:
        InputError: for ids that fit no symbol key, or more robots than letters.
    """
    if len(maps) == 1 and not (
        symbols.are_symbols(maps[0].ids) or symbols.are_labelled(maps[0].ids)
    ):
        name = maps[0].name
        header = [] if name == own_name else [ROBOT_LINE.format(letter="-", kind="id", name=name)]
        return header, [maps[0].ids]
    marks = _label_marks(maps)
    if marks:
        lines = [
            ROBOT_LINE.format(letter=mark, kind="label", name=graph.name)
            for mark, graph in zip(marks, maps, strict=True)
        ]
        plain = marks == [graph.name for graph in maps] and marks == sorted(marks)
        return [] if plain else lines, [graph.ids for graph in maps]
    header, keys = [], []
    for graph, letter in zip(maps, _letters(maps), strict=True):
        kept = bool((symbols.letters_of(graph.ids) == ord(letter)).all())
        kind = "key" if kept else "index"
        header.append(ROBOT_LINE.format(letter=letter, kind=kind, name=graph.name))
        keys.append(graph.ids if kept else as_keys(letter, graph))
    standard = [ROBOT_LINE.format(letter=g.name, kind="key", name=g.name) for g in maps]
    ordered = all(a.name < b.name for a, b in pairwise(maps))
    return ([] if header == standard and ordered else header), keys


def _label_marks(maps: Sequence[PoseGraph]) -> list[str]:
    """The label of each robot's keys; empty where some robot's are not of one label of its own."""
    codes = [np.unique(symbols.labels_of(graph.ids)) for graph in maps]
    if any(len(code) != 1 or not code[0] for code in codes):
        return []
    letters = {int(code[0]) >> 8 for code in codes}
    marks = [chr(int(code[0]) & 0xFF) for code in codes]
    return marks if len(letters) == 1 and len(set(marks)) == len(marks) else []


def _letters(maps: Sequence[PoseGraph]) -> list[str]:
    """A letter for each robot: that of its symbol keys, its name where it is a letter, or free."""
    wanted = []
    for graph in maps:
        codes = np.unique(symbols.letters_of(graph.ids))
        own = chr(codes[0]) if len(codes) == 1 and codes[0] else graph.name
        printable = len(own) == 1 and symbols.FIRST_LETTER <= ord(own) <= symbols.LAST_LETTER
        wanted.append(own if printable else "")
    wanted = [own if own not in wanted[:index] else "" for index, own in enumerate(wanted)]
    alphabet = sorted(map(chr, range(symbols.FIRST_LETTER, symbols.LAST_LETTER + 1)), key=_rank)
    free = [letter for letter in alphabet if letter not in wanted]
    if wanted.count("") > len(free):
        raise InputError(
            f"graph: {len(maps)} robots, but symbol keys have {len(alphabet)} letters;"
            ' ids="sequential" can name more'
        )
    return [own or free.pop(0) for own in wanted]


def _rank(letter: str) -> tuple[bool, bool, str]:
    """Lower case letters first, then upper case ones, then the rest."""
    return (not letter.isalpha(), not letter.islower(), letter)


def fit_keys(maps: Sequence[PoseGraph]) -> bool:
    """True if `write_g2o` can keep all ids, as one robot's own or as symbol keys."""
    try:
        original_keys(maps)
    except InputError:
        return False
    return True


def as_keys(letter: str, graph: PoseGraph) -> np.ndarray:
    """A robot's ids as the keys of a letter.

    Raises:
        InputError: for an id that fits none.
    """
    wrong = (graph.ids < 0) | (graph.ids >= symbols.INDEX_LIMIT)
    if wrong.any():
        raise InputError(
            f"graph: robot {graph.name!r} has the id {graph.ids[wrong][0]}, which fits no symbol"
            f' key (0 … 2^{symbols.INDEX_BITS} − 1); ids="sequential" can keep it'
        )
    return symbols.keys(letter, graph.ids)


def _body(graph: MultiRobotGraph, keys: list[np.ndarray]) -> Iterable[str]:
    """The VERTEX and EDGE lines; `keys` are the ids to write, robot by robot."""
    for pose_graph, ids in zip(graph.maps, keys, strict=True):
        yield from _lines("VERTEX", [ids], pose_graph.poses)
    for pose_graph, ids in zip(graph.maps, keys, strict=True):
        ends = [ids[np.asarray(pose_graph.tail)], ids[np.asarray(pose_graph.head)]]
        yield from _lines("EDGE", ends, pose_graph.measurement, pose_graph.information)
    closures = graph.closures
    ends = closure_keys(graph, keys)
    yield from _lines("EDGE", ends, closures.measurement, closures.information)
    yield from _prior_lines(graph, keys)


def _prior_lines(graph: MultiRobotGraph, keys: list[np.ndarray]) -> Iterable[str]:
    """Priors, after all that GTSAM's readers know."""
    held = [(one.priors, ids) for one, ids in zip(graph.maps, keys, strict=True) if one.priors]
    solid = graph.group is jaxlie.SE3
    if held and solid:
        yield "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1"
    tag, offset = ("EDGE_SE3_PRIOR", " 0") if solid else ("EDGE_PRIOR_SE2", "")
    for priors, ids in held:
        numbers = coordinates.columns(np.asarray(lie.parameters(priors.measurement)))
        triangle = coordinates.upper_triangle(np.asarray(priors.information))
        rows = np.concatenate([numbers, triangle], axis=1).tolist()
        for pose, row in zip(ids[priors.pose].tolist(), rows, strict=True):
            yield f"{tag} {pose}{offset} {' '.join(map(repr, row))}"


def closure_keys(graph: MultiRobotGraph, keys: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The ids of the poses that closures start and end at, of `keys`, robot by robot."""
    joined, start = np.concatenate(keys), np.cumsum([0, *map(len, keys)])
    closures = graph.closures
    ends = (closures.robot_a, closures.pose_a), (closures.robot_b, closures.pose_b)
    return [joined[start[np.asarray(robot)] + np.asarray(pose)] for robot, pose in ends]


def _lines(
    kind: str, ids: list[np.ndarray], transforms: Any, information: Any = None
) -> Iterable[str]:
    """Text lines with the shortest numbers that read back exactly."""
    parameters = np.asarray(lie.parameters(lie.as_numpy(transforms)))
    numbers = coordinates.columns(parameters)
    if information is not None:
        triangle = coordinates.upper_triangle(np.asarray(information, dtype=np.float64))
        numbers = np.concatenate([numbers, triangle], axis=1)
    tag = f"{kind}_SE2" if parameters.shape[1] == 4 else f"{kind}_SE3:QUAT"
    names = zip(*(column.tolist() for column in ids), strict=True)
    for name, row in zip(names, numbers.tolist(), strict=True):
        yield f"{tag} {' '.join(map(str, name))} {' '.join(map(repr, row))}"


G2O = register(
    Format(
        name="g2o",
        about="pose graphs, 2D and 3D",
        recognise=lambda source: tagged_lines(source, "g2o"),
        read=read_tagged,
        write=write_g2o,
        suffixes=(".g2o",),
        information="kept",
        priors="kept",
        stamps="hdl_graph_slam's",
    )
)
