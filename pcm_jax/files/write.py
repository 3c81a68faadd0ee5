"""Writing pose graphs: the front door."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files.formats import Format, formats, named
from pcm_jax.graph.multi_robot import MultiRobotGraph
from pcm_jax.graph.pose_graph import PoseGraph

COMPRESSED = (".gz", ".xz")


def write_graph(
    path: str | PathLike[str], graph: MultiRobotGraph | PoseGraph, *, format: str | None = None
) -> None:
    """Writes maps and closures in the format of a name, or of the path's suffix.

    Args:
        path: the file; `.gz` and `.xz` after the suffix compress it.
        graph: what to write.
        format: one of the formats that are written; by default the one of the suffix.

    Raises:
        InputError: for a format that is not written.
        FileFormatError: for a suffix that is no format's, and as the format's writer.
    """
    found = named(format) if format else _of_suffix(path)
    if found.write is None:
        raise InputError(f"format: {found.name!r} given, expected one that is written")
    whole = MultiRobotGraph((graph,)) if isinstance(graph, PoseGraph) else graph
    found.write(path, whole)


def format_of_suffix(path: str | PathLike[str]) -> str | None:
    """The name of the format that a path's suffix asks for, None where it is no written one's."""
    suffix = _suffix(path)
    names = (one.name for one in formats() if one.write is not None and suffix in one.suffixes)
    return next(names, None)


def _suffix(path: str | PathLike[str]) -> str:
    target = Path(path)
    bare = target.with_suffix("") if target.suffix in COMPRESSED else target
    return bare.suffix.lower()


def _of_suffix(path: str | PathLike[str]) -> Format:
    name = format_of_suffix(path)
    if name is not None:
        return named(name)
    known = ", ".join(suffix for one in formats() if one.write for suffix in one.suffixes)
    raise FileFormatError(path, None, f"suffix {_suffix(path)!r} given, expected one of {known}")
