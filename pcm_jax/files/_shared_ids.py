"""Plain ids that are unique over several files: which file's pose each of them is.

An edge between two ids that follow one another (in the order of all ids of all files) is odometry,
and a file's largest set of poses joined by odometry is its trajectory. Ids are shared when the
trajectories have no pose in common and an edge leads from one file's poses to another's. Two files
that both measure the steps to and from one id, in the order of their own ids, have it in common:
keyframes 10, 20, 30, … of one robot, beside 0, 1, 2, … of another. Of the files that mention a
pose, the one in whose trajectory it lies, or which joins it to most others by odometry, owns it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int

from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files.pose_file import PoseFile


@dataclasses.dataclass(frozen=True)
class Shared:
    """Whose each id is.

    Attributes:
        ids: int64 `[k]`, ascending.
        owner: int64 `[k]`, the place in `files` of each id's file.
        files: as given, without vertices that are another file's pose, and marked as candidates
            where they own none.
    """

    ids: Int[np.ndarray, " k"]
    owner: Int[np.ndarray, " k"]
    files: list[PoseFile]


def shared_ids(files: Sequence[PoseFile], *, required: bool = False) -> Shared | None:
    """Whose ids are whose, or None where each file's ids are its own.

    Args:
        files: files of plain ids.
        required: whether ids are known to be shared.

    Raises:
        FileFormatError: for a file of candidates whose ids may be several files' poses, and, if
            required, for two trajectories with a pose in common.
    """
    if len(files) < 2 and not (required and files):
        return None
    known = np.unique(np.concatenate([file.ids for file in files]))
    runs = [_runs(file, known) for file in files]
    defines = [
        _defines(file, own, runs, place)
        for place, (file, own) in enumerate(zip(files, runs, strict=True))
    ]
    if not any(defines):
        return None
    clash = _clash(runs, defines) or _both_pass(files, known, defines)
    owner = _owners(runs, defines, len(known))
    crossing = [
        _crosses(file, known, owner, place, defines[place]) for place, file in enumerate(files)
    ]
    if clash is not None:
        return _refused(files, known, clash, defines, required)
    if not required and not any(crossing):
        return None
    if (owner < 0).any():
        raise _unowned(files, known[owner < 0])
    return Shared(
        known, owner, [_own_part(file, known, owner, place) for place, file in enumerate(files)]
    )


def _runs(file: PoseFile, known: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
    """For each id how many poses the file joins to it by odometry; 0 where it has no such id."""
    mine = np.zeros(len(known), bool)
    mine[np.searchsorted(known, file.ids)] = True
    rank = np.searchsorted(known, file.edges.ids)
    link = np.zeros(len(known), bool)  # from an id to the next one
    low = rank.min(axis=1)[np.abs(rank[:, 0] - rank[:, 1]) == 1]
    link[low] = True
    run = np.cumsum(np.concatenate([[True], ~link[:-1]])) if len(known) else rank[:, 0]
    size = np.bincount(run)[run]
    return np.where(mine, size, 0)


def _main(run: Int[np.ndarray, " k"]) -> np.ndarray:
    """Finds the ids in the file's longest run."""
    return (run == run.max(initial=0)) & (run > 1)


def _defines(
    file: PoseFile, run: Int[np.ndarray, " k"], runs: Sequence[np.ndarray], place: int
) -> bool:
    """True if a file defines a robot: most of its poses are joined by odometry, or its own."""
    if file.candidates or not (run > 0).any():
        return False
    if 2 * (run > 1).sum() > (run > 0).sum() and len(file.vertices) + (run > 1).sum() > 2:
        return True
    others = np.zeros(len(run), bool)
    for number, other in enumerate(runs):
        if number != place:
            others |= other > 0
    return bool(((run > 0) & ~others).any())


def _clash(runs: Sequence[np.ndarray], defines: Sequence[bool]) -> tuple[int, int, int] | None:
    """Two files and the index of an id that both trajectories have, if any."""
    first = np.full(len(runs[0]), -1)
    for place, run in enumerate(runs):
        if not defines[place]:
            continue
        main = _main(run) if (run > 1).any() else run > 0
        both = main & (first >= 0)
        if both.any():
            index = int(np.argmax(both))
            return int(first[index]), place, index
        first[main] = place
    return None


def _both_pass(
    files: Sequence[PoseFile], known: Int[np.ndarray, " k"], defines: Sequence[bool]
) -> tuple[int, int, int] | None:
    """Two files whose trajectories go through one id, and its index.

    A pose that a file repeats from another one is met by closures, not by odometry from the id
    before it and to the id after it.
    """
    first = np.full(len(known), -1)
    for place, file in enumerate(files):
        if not defines[place]:
            continue
        passed = _passed(file, known)
        both = passed & (first >= 0)
        if both.any():
            index = int(np.argmax(both))
            return int(first[index]), place, index
        first[passed] = place
    return None


def _passed(file: PoseFile, known: Int[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
    """Marks the ids that a file measures both the step to and from, in the order of its own."""
    own = np.unique(file.ids)
    rank = np.searchsorted(own, file.edges.ids)
    step = np.zeros(len(own), bool)  # from an id to the next one
    step[rank.min(axis=1)[np.abs(rank[:, 0] - rank[:, 1]) == 1]] = True
    passed = np.zeros(len(known), bool)
    passed[np.searchsorted(known, own[1:][step[:-1] & step[1:]])] = True
    return passed


def _owners(runs: Sequence[np.ndarray], defines: Sequence[bool], count: int) -> np.ndarray:
    best, owner = np.zeros(count, np.int64), np.full(count, -1)
    for place, run in enumerate(runs):
        if defines[place]:
            better = run > best
            best[better], owner[better] = run[better], place
    return owner


def _crosses(
    file: PoseFile, known: np.ndarray, owner: np.ndarray, place: int, defines: bool
) -> bool:
    """True if an edge of the file leads to another file's pose."""
    whose = owner[np.searchsorted(known, file.edges.ids)]
    return bool((whose != place).any()) if defines else bool(len(file.edges))


def _refused(
    files: Sequence[PoseFile],
    known: np.ndarray,
    clash: tuple[int, int, int],
    defines: Sequence[bool],
    required: bool,
) -> None:
    """Nothing where files keep to themselves, else an error that names both files."""
    one, other, index = clash
    both = f"{files[one].path} and {files[other].path} both have a pose {known[index]}"
    if required:
        raise InputError(f"ids: 'shared' given, but {both}, expected ids unique over the files")
    for place, file in enumerate(files):
        if not defines[place] and (file.candidates or not len(file.vertices)) and len(file.edges):
            raise FileFormatError(
                file.path,
                int(file.edges.line[0]),
                f"edge between poses {file.edges.ids[0, 0]} and {file.edges.ids[0, 1]}, but {both}:"
                " whose is meant? Expected ids unique over the files, or candidates as CSV, which"
                " names the robots",
            )


def _unowned(files: Sequence[PoseFile], lost: np.ndarray) -> FileFormatError:
    for file in files:
        wrong = np.isin(file.edges.ids, lost).any(axis=1)
        if wrong.any():
            row = int(np.argmax(wrong))
            pose = next(one for one in file.edges.ids[row].tolist() if one in lost)
            paths = ", ".join(other.path for other in files if other is not file)
            return FileFormatError(
                file.path,
                int(file.edges.line[row]),
                f"edge to pose {pose}, which no file given has ({paths})",
            )
    return FileFormatError(files[0].path, None, f"pose {lost[0]} is no file's")


def _own_part(file: PoseFile, known: np.ndarray, owner: np.ndarray, place: int) -> PoseFile:
    """Without vertices that are another file's poses: they may stand in another frame."""
    whose = owner[np.searchsorted(known, file.vertices.ids[:, 0])]
    mine = whose == place
    notes = list(file.notes)
    if not mine.all():
        notes.append(f"{int((~mine).sum())} vertices are other files' poses, left out")
    return dataclasses.replace(
        file,
        vertices=file.vertices[mine],
        notes=notes,
        candidates=file.candidates or not (owner == place).any(),
    )
