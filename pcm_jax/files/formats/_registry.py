"""The formats known: what each is called, how it is recognised, read and written.

A new format is one new module in this folder that calls `register`; a user's own module may call
it from anywhere.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable
from typing import Any

from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files.pose_file import PoseFile, Reading
from pcm_jax.files.source import Source

LIMIT = 100  # formats
_lock = threading.Lock()
_known: dict[str, Format] = {}


@dataclasses.dataclass(frozen=True)
class Format:
    """One file format.

    Attributes:
        name: what `format=` and `inspect` call it.
        about: its content in a few words.
        recognise: how sure a source's content makes it, 0 (no) to 1; looks at `magic` and `head`.
        read: a source and the options of reading to what the file holds; None where it is not read.
        write: a path and a `MultiRobotGraph` to a file; None where it is not written.
        suffixes: of files that are written in this format, the usual one first.
        information: what becomes of the measurements' information.
        priors: what becomes of priors on poses.
        stamps: what becomes of time stamps.
        labels: what becomes of labels (which closures are true) and true poses.
        binary: whether it is no text, and told by `magic` alone.
    """

    name: str
    about: str
    recognise: Callable[[Source], float]
    read: Callable[[Source, Reading], PoseFile] | None = None
    write: Callable[[Any, Any], None] | None = None
    suffixes: tuple[str, ...] = ()
    information: str = "kept"
    priors: str = "none"
    stamps: str = "none"
    labels: str = "none"
    binary: bool = False


def register(format: Format) -> Format:
    """Adds a format, or replaces the one of that name; gives it back.

    Raises:
        InputError: for more than `LIMIT` formats.
    """
    with _lock:
        if format.name not in _known and len(_known) >= LIMIT:
            raise InputError(f"format: {len(_known)} are registered, expected at most {LIMIT}")
        _known[format.name] = format
    return format


def unregister(name: str) -> None:
    """Forgets a format."""
    with _lock:
        _known.pop(name, None)


def formats() -> tuple[Format, ...]:
    """The formats registered, in the order of their names."""
    with _lock:
        return tuple(_known[name] for name in sorted(_known))


def named(name: str) -> Format:
    """The format of a name.

    Raises:
        InputError: where there is none.
    """
    with _lock:
        found = _known.get(name)
    if found is None:
        names = ", ".join(one.name for one in formats())
        raise InputError(f"format: {name!r} given, expected one of {names}")
    return found


def recognised(source: Source) -> Format:
    """The format that a source's content makes most likely.

    Raises:
        FileFormatError: for content that is no format's.
    """
    readable = [one for one in formats() if one.read is not None]
    for binary in (True, False):
        chances = [(one.recognise(source), one) for one in readable if one.binary is binary]
        sure, best = max(chances, key=lambda chance: chance[0], default=(0.0, None))
        if best is not None and sure > 0.0:
            return best
        if source.is_folder:
            break
    if source.is_folder:
        raise FileFormatError(source.path, None, "this is a folder, expected a file")
    if not source.head:
        raise FileFormatError(source.path, None, "no VERTEX or EDGE line, expected a pose graph")
    number, line = source.head[0]
    names = ", ".join(one.name for one in readable)
    raise FileFormatError(
        source.path,
        number,
        f"{line[:40]!r} begins no format known, expected one of {names}{_nearest(line)}",
    )


def _nearest(line: str) -> str:
    """The formats that a line comes closest to."""
    words = line.replace(",", " ").split()
    if not words:
        return ""
    if words[0].upper().startswith(("VERTEX", "EDGE")):
        return "; g2o's lines begin with VERTEX_SE2, EDGE_SE2, VERTEX_SE3:QUAT or EDGE_SE3:QUAT"
    try:
        [float(word) for word in words]
    except ValueError:
        return ""
    return f"; {len(words)} numbers a line, where TUM's have 8, KITTI's 12 and EuRoC's 8 or more"


HEAD = ("format", "holds", "read", "written", "information", "priors", "times", "labels")


def rows() -> list[list[str]]:
    """A row of `HEAD` for each format."""
    return [
        [
            one.name,
            one.about,
            "yes" if one.read else "no",
            ", ".join(one.suffixes) if one.write else "no",
            one.information,
            one.priors,
            one.stamps,
            one.labels,
        ]
        for one in formats()
    ]


def markdown() -> str:
    """The same as a table in Markdown."""
    lines = [HEAD, ["---"] * len(HEAD), *rows()]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
