"""The reader of files whose lines begin with a tag: g2o, TORO and iSAM."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool

from pcm_jax.errors import FileFormatError
from pcm_jax.files import coordinates
from pcm_jax.files.formats._annotations import keyframe_stamps, scores
from pcm_jax.files.formats._priors import OFFSETS, WIDTHS, read_priors
from pcm_jax.files.formats._tags import COLUMNS, SILENT, TAGS, Tag, is_skipped
from pcm_jax.files.pose_file import Lines, PoseFile, Reading, checked, in_order
from pcm_jax.files.source import Source
from pcm_jax.files.text import Rows, rows_by_tag


def tagged_lines(source: Source, name: str) -> float:
    """The share of a format in the tags of the first lines, 0 to 1; shared tags count half."""
    tags = [words[0] for _, line in source.head if (words := line.split())]
    known = [TAGS[tag].formats for tag in tags if tag in TAGS]
    if not known:
        return 0.25 * any(tag in SILENT or is_skipped(tag) for tag in tags) * (name == "g2o")
    return sum((name in formats) / len(formats) for formats in known) / len(known)


def read_tagged(source: Source, reading: Reading) -> PoseFile:
    """Reads one file; see `pcm_jax.files.read_graph` for what is accepted.

    Raises:
        FileFormatError: naming the file, the line, what is wrong and what was expected.

    Warns:
        InputWarning: for quaternions further than 1e-3 from unit length.
    """
    path, lines = source.path, source.lines
    rows, comments = rows_by_tag(path, lines)
    known = _known_tags(path, rows, reading.format)
    bare = {
        tag: some
        for tag, found in known.items()
        if (some := _bare(TAGS[tag], found, len(lines))).any()
    }
    for tag, found in known.items():
        whole = found[~bare[tag]] if tag in bare else found
        whole.check_width(TAGS[tag].width, TAGS[tag].layout, len(lines))
    toro = reading.format == "toro" or any(tag.startswith("VERTEX") for tag in known)
    vertices = [_read_tag(TAGS[tag], found) for tag, found in known.items() if not TAGS[tag].edge]
    edges = []
    for tag, found in known.items():
        if not TAGS[tag].edge:
            continue
        whole = found
        if tag in bare:
            edges.append(_read_bare(TAGS[tag], found[bare[tag]], reading))
            whole = found[~bare[tag]]
        if len(whole):
            edges.append(_read_edges(TAGS[tag], whole, reading, toro))
    group = TAGS[next(iter(known))].group
    measured, clipped = checked(path, in_order(group, edges, 2), reading.repair)
    weight = scores(path, lines, comments, measured.line)
    if weight is not None:
        measured = dataclasses.replace(measured, weight=weight)
    poses = in_order(group, vertices, 1)
    priors, unread = read_priors(rows, group, poses, reading)
    skipped = {tag: len(found) for tag, found in rows.items() if is_skipped(tag)}
    if priors:
        skipped.pop(OFFSETS, None)
    left_out = {
        tag: unread.get(tag, 0) if tag in WIDTHS else count for tag, count in skipped.items()
    }
    return PoseFile(
        path,
        group,
        poses,
        measured,
        comments,
        clipped,
        format=_format_of(known),
        left_out={tag: count for tag, count in left_out.items() if count},
        notes=_angle_doubts(known),
        priors=in_order(group, priors, 1) if priors else None,
        stamps=keyframe_stamps(path),
        how=f"{reading.information}{'; default sigmas' if bare else ''}",
    )


def _angle_doubts(known: dict[str, Rows]) -> list[str]:
    """A line on the measured angles of each tag that are no radians."""
    doubts = []
    for tag, rows in known.items():
        kind = TAGS[tag]
        if kind.edge and kind.coordinates != "quaternion":
            first = kind.start + coordinates.FIRST_ANGLE[kind.coordinates]
            angles = rows.floats(first, kind.start + len(COLUMNS[kind.coordinates]))
            doubts.append(coordinates.angle_doubt(kind.coordinates, angles, rows.line))
    return [doubt for doubt in doubts if doubt is not None]


def _format_of(known: dict[str, Rows]) -> str:
    """The first format that has every tag, else that of the first tag."""
    names = [TAGS[tag].formats for tag in known]
    return next((name for name in names[0] if all(name in some for some in names)), names[0][0])


def _bare(tag: Tag, rows: Rows, last_line: int) -> Bool[np.ndarray, " n"]:
    """Marks the lines of a tag that end where their information would begin.

    Where others have information, the last line of a file without a newline is one cut short.
    """
    short = (rows.widths == tag.width - tag.triangle) & tag.edge
    return short & (short.all() | (rows.line != last_line))


def _read_bare(tag: Tag, rows: Rows, reading: Reading) -> Lines:
    """Edges without information, which get that of the default sigmas.

    Raises:
        FileFormatError: where there are none.
    """
    information = reading.default_information(tag.group)
    if information is None:
        raise rows.fault(
            0,
            f"{rows.widths[0]} columns, expected {tag.width}: {tag.layout}; for edges without"
            " information give default_sigmas=(metres, radians) (--default-sigmas M RAD)",
        )
    edges = _read_tag(tag, rows)
    return dataclasses.replace(edges, information=np.tile(information, (len(rows), 1, 1)))


def _known_tags(path: str, rows: dict[str, Rows], wanted: str | None) -> dict[str, Rows]:
    """The rows that are poses and measurements; errors for unknown tags."""
    unknown = [tag for tag in rows if tag not in TAGS and tag not in SILENT and not is_skipped(tag)]
    if unknown:
        tag = min(unknown, key=lambda tag: rows[tag].line[0])
        expected = ", ".join(list(TAGS)[:4])
        raise FileFormatError(
            path,
            int(rows[tag].line[0]),
            f"unknown tag {tag[:40]!r}, expected one of {expected}, or TORO's and iSAM's",
        )
    known = {tag: found for tag, found in rows.items() if tag in TAGS}
    if not known:
        raise FileFormatError(path, None, "no VERTEX or EDGE line, expected a pose graph")
    _check_kinds(path, known, wanted)
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
    values = rows.floats(tag.start, tag.start + len(COLUMNS[tag.coordinates]))
    d = 3 if tag.coordinates == "angle" else 6
    return Lines(
        ids=rows.ids(1, 1 + tag.ids),
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
    how = reading.information
    information = coordinates.information(triangle, how=how, fault=rows.fault)
    if "g2o" not in tag.formats:
        information = coordinates.from_start_frame(information, tag.group(edges.transforms))
    elif tag.coordinates == "quaternion" and reading.rotation_information == "quaternion":
        information = coordinates.from_quaternion_vector(information)
    return dataclasses.replace(edges, information=information)
