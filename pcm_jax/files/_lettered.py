"""Candidates whose ids name robots by letters, beside maps of plain ids.

ROMAN writes the closures of two robots as `EDGE_SE3:QUAT a12 b7`, a file a pair, while its maps'
poses are 0, 1, 2, …: a and b are the file's own letters for the two, whoever they are. So letters
are names of robots where there are robots of these names. Else the two that the file or its folder
is called after (`align/alice_bob/align.g2o`) are meant, or the robots in their order where there
are as many as letters; with more robots than that it cannot be known.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pcm_jax.errors import FileFormatError
from pcm_jax.files.names import stem_of
from pcm_jax.files.pose_file import PoseFile
from pcm_jax.graph import symbols


def lettered_candidates(files: Sequence[PoseFile]) -> list[PoseFile]:
    """Marks the files that are candidates between other files' robots, by letters of their own.

    These have edges only, each between two letters, of which no other file has a pose, while
    other files have poses of plain ids.
    """
    keyed = [symbols.are_symbols(file.ids) for file in files]
    plain = [
        file for file in files if file.named is None and not symbols.letters_of(file.ids).all()
    ]
    if not plain:
        return list(files)
    return [
        lettered(file) if keyed[number] and _is_between_strangers(number, files, keyed) else file
        for number, file in enumerate(files)
    ]


def _is_between_strangers(number: int, files: Sequence[PoseFile], keyed: Sequence[bool]) -> bool:
    file = files[number]
    if len(file.vertices) or symbols.are_labelled(file.ids):
        return False
    letters = symbols.letters_of(file.edges.ids)
    others = [
        symbols.letters_of(other.ids)
        for place, other in enumerate(files)
        if keyed[place] and (len(other.vertices) or not _crosses(other))
    ]
    taken = np.isin(letters, np.concatenate([*others, np.zeros(0, np.int64)]))
    return _crosses(file) and not taken.any()


def _crosses(file: PoseFile) -> bool:
    """True if all edges lead from one letter to another."""
    letters = symbols.letters_of(file.edges.ids)
    return bool(len(letters)) and bool((letters[:, 0] != letters[:, 1]).all())


def lettered(file: PoseFile) -> PoseFile:
    """Makes a file of candidates that call robots by their ids' letters."""
    letters = symbols.letters_of(file.edges.ids)
    named = np.array([[chr(code) for code in pair] for pair in letters.tolist()], object)
    edges = dataclasses.replace(file.edges, ids=symbols.indices_of(file.edges.ids))
    return dataclasses.replace(file, edges=edges, named=named, candidates=True, lettered=True)


def called_by_name(file: PoseFile, names: Sequence[str]) -> tuple[PoseFile, list[str]]:
    """Names the robots that a lettered file speaks of, and a note that says who is meant.

    Args:
        file: of `lettered_candidates`.
        names: of the robots.

    Raises:
        FileFormatError: where the letters may mean any two of several robots.
    """
    letters = sorted(set(file.named.ravel().tolist()))  # type: ignore[union-attr]
    known = tuple(letters) if set(letters) <= set(names) else None
    after = _called_after(file.path, names) if len(letters) == 2 else None
    if known and after in (None, known):
        return file, []
    meant = after or (tuple(names) if len(letters) == len(names) else None)
    if known or meant is None:
        called = f"the file is called after {' and '.join(after)}" if after else "which are they"
        raise FileFormatError(
            file.path,
            int(file.edges.line[0]),
            f"robots {', '.join(letters)} given, but {called}: expected letters that are robots'"
            f" names ({', '.join(names)}), or a file called after the two that it is about, as"
            f" {names[0]}_{names[-1]}.g2o",
        )
    of = dict(zip(letters, meant, strict=True))
    pairs = file.named.tolist()  # type: ignore[union-attr]
    named = np.array([[of[letter] for letter in pair] for pair in pairs], object)
    told = ", ".join(f"{letter} is {name}" for letter, name in of.items())
    return dataclasses.replace(file, named=named), [f"{file.path}: candidates by letters: {told}"]


def _called_after(path: str, names: Sequence[str]) -> tuple[str, str] | None:
    """The two robots whose names, joined by _ or -, are a file's or its folder's."""
    called = (stem_of(path), Path(path).absolute().parent.name)
    found = [
        (one, other)
        for title in called
        for one in names
        for other in names
        if title in (f"{one}_{other}", f"{one}-{other}")
    ]
    return found[0] if found else None
