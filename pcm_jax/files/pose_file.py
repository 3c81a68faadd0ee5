"""One g2o, TORO or iSAM file as arrays: ids, transforms and information, with their lines.

What the ids mean (whose poses they are) is decided later, over all files together.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.errors import FileFormatError, InputError, InputWarning
from pcm_jax.files import coordinates
from pcm_jax.files.tags import COLUMNS, FORMATS, SILENT, TAGS, Tag, is_skipped
from pcm_jax.files.text import Rows, line_fault, read_lines, rows_by_tag
from pcm_jax.graph.validation import (
    Fault,
    check_information,
    check_self_loops,
    clip_to_definite,
)

INFORMATION = ("as-written", "sqrt")
ROTATION_INFORMATION = ("tangent", "quaternion")
REPAIR = (None, "clip")


@dataclasses.dataclass(frozen=True)
class Reading:
    """How a file's numbers are to be taken: `read_graph`'s options, checked.

    Raises:
        InputError: for a value that is not one of those expected.
    """

    information: str = "as-written"
    rotation_information: str = "tangent"
    repair: str | None = None
    format: str | None = None

    def __post_init__(self) -> None:
        allowed = {
            "information": INFORMATION,
            "rotation_information": ROTATION_INFORMATION,
            "repair": REPAIR,
            "format": (None, *FORMATS),
        }
        for argument, values in allowed.items():
            given = getattr(self, argument)
            if given not in values:
                raise InputError(f"{argument}: {given!r} given, expected one of {values}")


@dataclasses.dataclass(frozen=True)
class Lines:
    """Vertices or edges in the order of their lines.

    Attributes:
        ids: int64 `[k, 1]` (vertices) or `[k, 2]` (edges).
        transforms: jaxlie's parameters, `[k, 4]` or `[k, 7]`.
        information: `[k, d, d]` over the tangent; zeros for vertices.
        line: int64 `[k]`.
    """

    ids: Int[np.ndarray, "k ends"]
    transforms: Float[np.ndarray, "k p"]
    information: Float[np.ndarray, "k d d"]
    line: Int[np.ndarray, " k"]

    def __len__(self) -> int:
        return len(self.line)


@dataclasses.dataclass(frozen=True)
class PoseFile:
    """What one file holds.

    Attributes:
        path: the file.
        group: `jaxlie.SE2` or `jaxlie.SE3`.
        vertices: its poses.
        edges: its measurements, information positive definite.
        comments: its comment lines.
        clipped: how many information matrices were repaired.
    """

    path: str
    group: type[Any]
    vertices: Lines
    edges: Lines
    comments: list[str]
    clipped: int


def read_pose_file(path: str | PathLike[str], reading: Reading) -> PoseFile:
    """Reads one file; see `pcm_jax.files.read_graph` for what is accepted.

    Raises:
        FileFormatError: naming the file, the line, what is wrong and what was expected.

    Warns:
        InputWarning: for lines that were skipped (landmarks, priors and the like), counted by tag,
            and for quaternions further than 1e-3 from unit length.
    """
    path = str(path)
    lines = read_lines(path)
    rows, comments = rows_by_tag(path, lines)
    known = _known_tags(path, rows, reading.format)
    for tag, found in known.items():
        found.check_width(TAGS[tag].width, TAGS[tag].layout, len(lines))
    toro = reading.format == "toro" or any(tag.startswith("VERTEX") for tag in known)
    vertices = [_read_tag(TAGS[tag], found) for tag, found in known.items() if not TAGS[tag].edge]
    edges = [
        _read_edges(TAGS[tag], found, reading, toro)
        for tag, found in known.items()
        if TAGS[tag].edge
    ]
    group = TAGS[next(iter(known))].group
    measured, clipped = _checked(path, _in_order(group, edges, 2), reading.repair)
    return PoseFile(path, group, _in_order(group, vertices, 1), measured, comments, clipped)


def _known_tags(path: str, rows: dict[str, Rows], wanted: str | None) -> dict[str, Rows]:
    """The rows that are poses and measurements; errors for unknown tags, a warning for skipped."""
    unknown = [tag for tag in rows if tag not in TAGS and tag not in SILENT and not is_skipped(tag)]
    if unknown:
        tag = min(unknown, key=lambda tag: rows[tag].line[0])
        expected = ", ".join(list(TAGS)[:4])
        raise FileFormatError(
            path,
            int(rows[tag].line[0]),
            f"unknown tag {tag[:40]!r}, expected one of {expected}, or TORO's and iSAM's",
        )
    skipped = {tag: len(found) for tag, found in rows.items() if is_skipped(tag)}
    known = {tag: found for tag, found in rows.items() if tag in TAGS}
    if not known:
        raise FileFormatError(path, None, "no VERTEX or EDGE line, expected a pose graph")
    _check_kinds(path, known, wanted)
    if skipped:
        counts = ", ".join(f"{count} {tag}" for tag, count in skipped.items())
        warnings.warn(
            InputWarning(f"{path}: skipped {sum(skipped.values())} lines ({counts})"), stacklevel=2
        )
    return known


def _check_kinds(path: str, known: dict[str, Rows], wanted: str | None) -> None:
    """One group throughout, and the format that the caller said."""
    first = next(iter(known))
    for tag, found in known.items():
        line = int(found.line[0])
        if TAGS[tag].group is not TAGS[first].group:
            raise FileFormatError(
                path, line, f"{tag} in a file that began with {first}: SE(2) and SE(3) are mixed"
            )
        if wanted is not None and wanted not in TAGS[tag].formats:
            raise FileFormatError(path, line, f"{tag} is no tag of the format {wanted!r} asked for")


def _read_tag(tag: Tag, rows: Rows) -> Lines:
    """Ids and transforms of one tag's lines."""
    start = 1 + tag.ids
    values = rows.floats(start, start + len(COLUMNS[tag.coordinates]))
    d = 3 if tag.coordinates == "angle" else 6
    return Lines(
        ids=rows.integers(1, start),
        transforms=coordinates.parameters(tag.coordinates, values, rows.fault),
        information=np.zeros((len(rows), d, d)),
        line=rows.line,
    )


def _read_edges(tag: Tag, rows: Rows, reading: Reading, toro: bool) -> Lines:
    """The same with information over the tangent, which is not checked yet."""
    edges = _read_tag(tag, rows)
    triangle = rows.floats(tag.width - tag.triangle, tag.width)
    if "g2o" not in tag.formats and tag.coordinates == "angle" and "toro" in tag.formats:
        if reading.format is None:
            toro = coordinates.looks_like_toro(triangle, expected=toro)
        if toro:
            triangle = coordinates.from_toro_order(triangle)
    square_root = reading.information == "sqrt"
    information = coordinates.information(triangle, square_root=square_root)
    if "g2o" not in tag.formats:
        information = coordinates.from_start_frame(information, tag.group(edges.transforms))
    elif tag.coordinates == "quaternion" and reading.rotation_information == "quaternion":
        information = coordinates.from_quaternion_vector(information)
    return dataclasses.replace(edges, information=information)


def _in_order(group: type[Any], parts: Sequence[Lines], ids: int) -> Lines:
    """Lines of several tags, in the file's order."""
    d = lie.tangent_dim(group)
    nothing = Lines(
        ids=np.zeros((0, ids), np.int64),
        transforms=np.zeros((0, lie.module_of(group).PARAMETERS_DIM)),
        information=np.zeros((0, d, d)),
        line=np.zeros(0, np.int64),
    )
    if len(parts) == 1:
        return parts[0]
    joined = {
        field.name: np.concatenate([getattr(part, field.name) for part in (nothing, *parts)])
        for field in dataclasses.fields(Lines)
    }
    order = np.argsort(joined["line"], kind="stable")
    return Lines(**{name: values[order] for name, values in joined.items()})


def _checked(path: str, edges: Lines, repair: str | None) -> tuple[Lines, int]:
    """Edges between different poses with positive definite information; how many were repaired."""
    fault = line_fault(path, edges.line)
    check_self_loops(edges.ids[:, 0], edges.ids[:, 1], fault)
    information, clipped = definite(edges.information, fault, repair)
    return dataclasses.replace(edges, information=information), clipped


def definite(
    information: Float[np.ndarray, "e d d"], fault: Fault, repair: str | None
) -> tuple[Float[np.ndarray, "e d d"], int]:
    """Positive definite `[e, d, d]`, and how many were clipped to be that.

    Raises:
        InputError: through `fault`, for one that is not and is not to be repaired.
    """
    clipped = 0
    if repair == "clip":
        information, clipped = clip_to_definite(information)
    hint = "" if repair else '; repair="clip" (--repair clip) would clip its eigenvalues'
    return check_information(information, lambda row, text: fault(row, text + hint)), clipped
