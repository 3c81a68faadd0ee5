"""RTAB-Map's database: sessions of one or several robots, in SQLite.

`Node`: id, map_id (the session, a robot here), stamp (seconds), pose (odometry's, 3 × 4 floats, row
by row), ground_truth_pose. `Link`: from_id, to_id, type, information_matrix (6 × 6 doubles over x,
y, z, roll, pitch, yaw) and transform (3 × 4 floats): the pose of `to` seen from `from`. Neighbours
are odometry; closures between sessions are candidates; links of a node to itself are priors on
its pose; landmarks are left out.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import jaxlie
import numpy as np

from pcm_jax import lie
from pcm_jax.errors import FileFormatError
from pcm_jax.files._scope import Scope, made_scope
from pcm_jax.files.formats._registry import Format, register
from pcm_jax.files.pose_file import Lines, PoseFile, Reading, checked, no_lines
from pcm_jax.files.source import Source
from pcm_jax.files.text import line_fault
from pcm_jax.graph.checked import as_transforms

MAGIC = b"SQLite format 3\0"
NEIGHBOURS, CLOSURES, PRIOR = (0, 6), (1, 2, 3, 4), 7
KINDS = {5: "virtual closure", 8: "landmark"}
MOST = 10_000_000  # rows
INTEGERS = ("id", "map_id", "from_id", "to_id", "type")


def _recognise(source: Source) -> float:
    return 1.0 * source.magic.startswith(MAGIC)


def read_rtabmap(source: Source, reading: Reading) -> PoseFile:
    """Reads a database's nodes and links.

    Raises:
        FileFormatError: for a database of another program, a damaged one, and naming the link or
            node that holds something else.
    """
    try:
        address = f"{Path(source.path).absolute().as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(address, uri=True)) as base:
            nodes = _rows(base, source, "Node", ("id", "map_id", "pose"))
            stamps = _optional(base, "Node", "id", "stamp")
            truth = _optional(base, "Node", "id", "ground_truth_pose")
            links, how = _links(base, source, reading)
    except (sqlite3.Error, UnicodeDecodeError) as error:  # the latter: of sqlite's own messages
        raise FileFormatError(source.path, None, f"damaged database: {error}") from None
    except MemoryError:  # what SQLite says of a row that states such a length
        problem = "damaged database: a row is too long for memory"
        raise FileFormatError(source.path, None, problem) from None
    known = {row[0] for row in nodes}
    links = [row for row in links if row[0] in known and (row[1] in known or row[2] in KINDS)]
    lost = [row for row in links if _is_empty(row[4])]
    links = [row for row in links if not _is_empty(row[4])]
    nodes, alone = _linked(nodes, links)
    edges, clipped = _edges(source.path, links, reading)
    if not len(edges) and not nodes:
        raise FileFormatError(source.path, None, "no nodes, expected a map")
    return PoseFile(
        source.path,
        jaxlie.SE3,
        _poses(source.path, [(row[0], row[2]) for row in nodes]) or no_lines(jaxlie.SE3, 1),
        edges,
        clipped=clipped,
        format="rtabmap",
        scope=_sessions(nodes),
        left_out=_left_out(links, lost, alone),
        priors=_priors(source.path, links),
        stamps=_stamps(stamps),
        truth=_poses(source.path, truth),
        how=how,
    )


def _linked(
    nodes: list[tuple[Any, ...]], links: list[tuple[Any, ...]]
) -> tuple[list[tuple[Any, ...]], int]:
    """The nodes that a link joins to another one, and how many there are besides."""
    joined = {end for row in links if row[2] in (*NEIGHBOURS, *CLOSURES) for end in row[:2]}
    kept = [row for row in nodes if row[0] in joined] if joined else nodes
    return kept, len(nodes) - len(kept)


def _is_empty(transform: Any) -> bool:
    return transform is None or (isinstance(transform, bytes) and not any(transform))


def _stamps(rows: list[tuple[Any, ...]]) -> tuple[np.ndarray, np.ndarray] | None:
    if not rows:
        return None
    seconds = [float(row[1]) if isinstance(row[1], int | float) else np.nan for row in rows]
    return np.array([row[0] for row in rows], np.int64), np.array(seconds)


_UNCERTAINTY = (
    (("information_matrix",), "as written, over x, y, z, roll, pitch, yaw"),
    (("trans_variance", "rot_variance"), "variances of translation and rotation"),
    (("variance",), "one variance of all directions"),
    ((), "default sigmas"),
)


def _links(
    base: sqlite3.Connection, source: Source, reading: Reading
) -> tuple[list[tuple[Any, ...]], str]:
    """Rows of from_id, to_id, type, 6 × 6 doubles of information, and transform; and how."""
    found = {row[1] for row in base.execute("PRAGMA table_info(Link)")}
    columns, how = next(one for one in _UNCERTAINTY if set(one[0]) <= found)
    rows = _rows(base, source, "Link", ("from_id", "to_id", "type", "transform", *columns))
    if columns == ("information_matrix",):
        return [(*row[:3], row[4], row[3]) for row in rows], how
    if columns:
        return [(*row[:3], _of_variances(row[4], row[-1]), row[3]) for row in rows], how
    default = reading.default_information(jaxlie.SE3)
    if default is None:
        raise FileFormatError(
            source.path,
            None,
            "links without information; give default_sigmas=(metres, radians) (--default-sigmas M"
            " RAD)",
        )
    return [(*row[:3], default.tobytes(), row[3]) for row in rows], how


def _of_variances(translation: Any, rotation: Any) -> bytes | None:
    """Information as doubles; None where a variance is no positive number."""
    given = (translation, rotation)
    if not all(isinstance(one, int | float) and one > 0.0 for one in given):
        return None
    return np.diag(1.0 / np.repeat(np.array(given, np.float64), 3)).tobytes()


def _rows(
    base: sqlite3.Connection, source: Source, name: str, columns: tuple[str, ...]
) -> list[tuple[Any, ...]]:
    found = {row[1] for row in base.execute(f"PRAGMA table_info({name})")}
    missing = [column for column in columns if column not in found]
    if missing:
        raise FileFormatError(
            source.path, None, f"no column {name}.{missing[0]}, expected an RTAB-Map database"
        )
    order = "id" if name == "Node" else "rowid"
    query = f"SELECT {', '.join(columns)} FROM {name} ORDER BY {order} LIMIT {MOST}"
    rows = base.execute(query).fetchall()
    for k, column in enumerate(columns):
        if column in INTEGERS:
            _check_integers(source.path, f"{name}.{column}", [row[k] for row in rows])
    return rows


def _check_integers(path: str, column: str, values: list[Any]) -> None:
    """SQLite keeps any kind of value in a column of any type."""
    for number, value in enumerate(values, start=1):
        if not isinstance(value, int):
            raise FileFormatError(
                path, None, f"row {number}: {column} is {str(value)[:40]!r}, expected an integer"
            )


def _optional(base: sqlite3.Connection, name: str, *columns: str) -> list[tuple[Any, ...]]:
    found = {row[1] for row in base.execute(f"PRAGMA table_info({name})")}
    if not set(columns) <= found:
        return []
    return base.execute(f"SELECT {', '.join(columns)} FROM {name} LIMIT {MOST}").fetchall()


def _sessions(nodes: list[tuple[Any, ...]]) -> Scope:
    """A robot for each session that has poses."""
    ids = np.array([row[0] for row in nodes], np.int64)
    session = np.array([row[1] for row in nodes], np.int64)
    names = np.unique(session)
    order = np.argsort(ids)
    labels = [f"session {name}" for name in names.tolist()]
    return made_scope(
        labels,
        [f"session{name}" for name in names.tolist()],
        kind="table",
        rule=f"sessions (map_id {', '.join(map(str, names.tolist()))}), each a robot",
        codes=ids[order],
        robots=np.searchsorted(names, session)[order],
        ids=ids[order],
    )


def _edges(path: str, links: list[tuple[Any, ...]], reading: Reading) -> tuple[Lines, int]:
    """Odometry and closures; a link is stored from either end, once or twice."""
    chosen, seen = [], set()
    for number, row in enumerate(links, start=1):
        if row[2] not in (*NEIGHBOURS, *CLOSURES) or row[0] == row[1]:
            continue
        if (row[1], row[0], row[2]) in seen:
            continue  # the same link, stored at its other end
        seen.add((row[0], row[1], row[2]))
        chosen.append((number, row))
    return (
        checked(path, _lines(path, chosen, 2), reading.repair)
        if chosen
        else (no_lines(jaxlie.SE3, 2), 0)
    )


def _priors(path: str, links: list[tuple[Any, ...]]) -> Lines | None:
    chosen = [(number, row) for number, row in enumerate(links, start=1) if row[2] == PRIOR]
    return _lines(path, chosen, 1) if chosen else None


def _lines(path: str, chosen: list[tuple[int, tuple[Any, ...]]], ends: int) -> Lines:
    line = np.array([number for number, _ in chosen], np.int64)
    fault = line_fault(path, line)
    matrices = np.tile(np.eye(4), (len(chosen), 1, 1))
    information = np.empty((len(chosen), 6, 6))
    for k, (_, row) in enumerate(chosen):
        weight, transform = _blob(row[3], np.float64, 36), _blob(row[4], np.float32, 12)
        if weight is None or transform is None:
            raise fault(
                k,
                f"link {row[0]}-{row[1]}: expected 36 doubles"
                f"{' or positive variances' * (weight is None)} and 12 floats",
            )
        information[k] = weight.reshape(6, 6)
        matrices[k, :3] = transform.reshape(3, 4)
    poses = as_transforms(matrices, "transform", fault)
    ids = np.array([row[:ends] for _, row in chosen], np.int64)
    return Lines(ids, np.asarray(lie.parameters(poses)), information, line)


def _poses(path: str, rows: list[tuple[Any, ...]]) -> Lines | None:
    """Poses by id; None where there are none."""
    found = [(row[0], blob) for row in rows if (blob := _blob(row[1], np.float32, 12)) is not None]
    found = [(node, blob) for node, blob in found if np.abs(blob).sum() > 0.0]
    if not found:
        return None
    line = np.array([node for node, _ in found], np.int64)
    matrices = np.tile(np.eye(4), (len(found), 1, 1))
    matrices[:, :3] = np.array([blob for _, blob in found]).reshape(-1, 3, 4)
    poses = as_transforms(matrices, "pose", line_fault(path, line))
    return Lines(
        line[:, None], np.asarray(lie.parameters(poses)), np.zeros((len(line), 6, 6)), line
    )


def _blob(value: Any, dtype: Any, count: int) -> np.ndarray | None:
    """Numbers of a blob, None where it holds another number of them."""
    if not isinstance(value, bytes) or len(value) != count * np.dtype(dtype).itemsize:
        return None
    with np.errstate(invalid="ignore"):  # of NaNs that signal; they are refused later
        return np.frombuffer(value, dtype).astype(np.float64)


def _left_out(
    links: list[tuple[Any, ...]], lost: list[tuple[Any, ...]], alone: int
) -> dict[str, int]:
    counts = {"link without a transform": len(lost), "node without a link": alone}
    counts = {kind: count for kind, count in counts.items() if count}
    for row in links:
        if row[2] not in (*NEIGHBOURS, *CLOSURES, PRIOR):
            name = KINDS.get(row[2], f"link of type {row[2]}")
            counts[name] = counts.get(name, 0) + 1
    return counts


RTABMAP = register(
    Format(
        name="rtabmap",
        about="RTAB-Map's database",
        recognise=_recognise,
        read=read_rtabmap,
        information="kept",
        priors="kept",
        stamps="kept",
        labels="true poses",
        binary=True,
    )
)
