"""Two robots that call their poses by the same letter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pcm_jax.errors import FileFormatError
from pcm_jax.files._scope import Scope
from pcm_jax.files.pose_file import PoseFile
from pcm_jax.graph import symbols
from pcm_jax.graph.copies import first_copies


def conflicting_letters(files: Sequence[PoseFile], scopes: Sequence[Scope]) -> dict[int, str]:
    """Places of files that share their one letter with another file's robot, and why.

    Two files contradict one another about a letter when they measure the odometry between the same
    poses differently in more than half of the places that both measure.

    Raises:
        FileFormatError: where such files also speak of other letters, so that it cannot be told
            whose poses are meant; naming both lines.
    """
    if len(files) < 2:
        return {}
    alone = [len(np.unique(symbols.letters_of(file.ids))) == 1 for file in files]
    found: dict[int, str] = {}
    owners: dict[tuple[int, str], list[int]] = {}
    for place, file in enumerate(files):
        ends = symbols.letters_of(file.edges.ids)
        for code in np.unique(ends[ends[:, 0] == ends[:, 1]]).tolist():
            robot = int(scopes[place].locate(np.array([code << symbols.INDEX_BITS]))[0][0])
            owners.setdefault((code, scopes[place].labels[robot]), []).append(place)
    for (code, _), places in owners.items():
        for k, one in enumerate(places):
            for other in places[k + 1 :]:
                lines = _contradiction(files[one], files[other], code)
                if lines is None:
                    continue
                if not (alone[one] and alone[other]):
                    raise _unclear(files[one], files[other], lines, code)
                told = f"{chr(code)} is measured differently"
                found[one] = f"{told} in {files[other].path}:{lines[1]}"
                found[other] = f"{told} in {files[one].path}:{lines[0]}"
    return found


def _unclear(one: PoseFile, other: PoseFile, lines: tuple[int, int], code: int) -> FileFormatError:
    return FileFormatError(
        other.path,
        lines[1],
        f"measures the odometry of letter {chr(code)} differently than {one.path}:{lines[0]}: two"
        " robots of one letter? Expected a letter for each robot, or ids='per-file' (--ids"
        " per-file)",
    )


def _contradiction(one: PoseFile, other: PoseFile, code: int) -> tuple[int, int] | None:
    """The lines of the first contradiction, where most of what both measure is one."""
    rows = [_odometry(file, code) for file in (one, other)]
    keys = [_pairs(file, row) for file, row in zip((one, other), rows, strict=True)]
    _, a, b = np.intersect1d(keys[0], keys[1], return_indices=True)
    if not len(a):
        return None
    parts = [file.edges[row[k]] for file, row, k in zip((one, other), rows, (a, b), strict=True)]
    ends = np.concatenate([part.ids for part in parts])
    zero = np.zeros(len(ends), np.int64)
    group = one.group
    first = first_copies(
        np.stack([zero, ends[:, 0], zero, ends[:, 1]], axis=1),
        group(np.concatenate([part.transforms for part in parts])),
        np.concatenate([part.information for part in parts]),
    )
    differ = first[len(a) :] == np.arange(len(a), 2 * len(a))
    if 2 * differ.sum() <= len(a):
        return None
    row = int(np.argmax(differ))
    return int(parts[0].line[row]), int(parts[1].line[row])


def _odometry(file: PoseFile, code: int) -> np.ndarray:
    ids = file.edges.ids
    own = (symbols.letters_of(ids) == code).all(axis=1)
    return np.flatnonzero(own & (np.abs(ids[:, 0] - ids[:, 1]) == 1))


def _pairs(file: PoseFile, rows: np.ndarray) -> np.ndarray:
    return file.edges.ids[rows].min(axis=1)
