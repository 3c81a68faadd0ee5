"""Whose poses a file's ids are: the rules, in the order in which they are tried.

1. The format says so itself (JRL, RTAB-Map, bags), or a comment names a table of ids.
2. Every id of a file is a GTSAM `LabeledSymbol`: the label is the robot.
3. Every id of a file is a GTSAM symbol: the letter is the robot. Where two files measure the same
   odometry of one letter differently, and neither speaks of another letter, each is a robot. "a12"
   is robot a's symbol 12. A file of edges between letters that no map has, beside maps of plain
   ids, holds candidates, and its letters are names for two of the robots (`_lettered`).
4. Ids are plain numbers that are unique over the files, and some edge leads from one file's poses
   to another's: ids are shared, and a pose belongs to the file that holds its odometry. A file
   whose poses are all some other file's defines no robot; its edges are candidates.
5. Otherwise the ids belong to their file, which is one robot.

`ids="symbols"`, `"shared"` and `"per-file"` ask for 3, 4 and 5.

Comments of `write_g2o` name the robots (g2o, and whatever else reads its files, skips them):

    # pcm_jax robot a key NAME      robot a is called NAME; its poses' ids are the symbol keys
    # pcm_jax robot a index NAME    …; its poses' ids are the keys' indices
    # pcm_jax robot A label NAME    the robot of the label A is called NAME
    # pcm_jax robot - id NAME       the file's one robot is called NAME
    # pcm_jax id-table FILE         the ids are sequential; FILE beside this one says whose they are
    # pcm_jax frame NAME            all poses stand in the frame of the robot NAME
    # pcm_jax order lines           poses are in the order of their lines, not of their ids
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int

from pcm_jax.errors import FileFormatError, InputWarning
from pcm_jax.files._conflicts import conflicting_letters
from pcm_jax.files._scope import Scope, made_scope
from pcm_jax.files._shared_ids import Shared, shared_ids
from pcm_jax.files.names import stems_of
from pcm_jax.files.pose_file import PoseFile
from pcm_jax.files.source import Source
from pcm_jax.files.text import csv_rows
from pcm_jax.graph import symbols
from pcm_jax.graph.validation import raise_first
from pcm_jax.store import digest

ROBOT_LINE = "# pcm_jax robot {letter} {kind} {name}"
TABLE_LINE = "# pcm_jax id-table {file}"
TABLE_DIGEST_LINE = "# pcm_jax id-table-digest {digest}"
ORDER_LINE = "# pcm_jax order lines"
FRAME_LINE = "# pcm_jax frame {name}"
TABLE_COLUMNS = ("vertex", "robot", "id")
_ROBOT = re.compile(r"# pcm_jax robot (\S) (key|index|label|id) (.+)")
_TABLE = re.compile(r"# pcm_jax id-table (\S.*)")
_TABLE_DIGEST = re.compile(r"# pcm_jax id-table-digest ([0-9a-f]+)")


def scopes_of(files: Sequence[PoseFile], ids: str = "auto") -> tuple[list[PoseFile], list[Scope]]:
    """Decides how the ids of several files are meant, by the rules above.

    Args:
        files: what they hold.
        ids: "auto", "per-file", "shared" or "symbols".

    Returns:
        The files, without vertices of other files' robots where ids are shared, and marked as
        candidates where they define no robot; and their scopes.

    Raises:
        FileFormatError: for an id table that is not what its file says, an id that is no symbol
            where symbols are asked for, and for plain ids that may be several files' poses.

    Warns:
        InputWarning: when a file names an id table that is not beside it.
    """
    stems: list[str] = stems_of([file.path for file in files])
    scopes: list[Scope | None] = [
        file.scope or _table(file, number) for number, file in enumerate(files)
    ]
    rest = [number for number, scope in enumerate(scopes) if scope is None]
    if ids in ("auto", "symbols"):
        _by_letters(files, scopes, rest, stems, strict=ids == "symbols")
        rest = [number for number, scope in enumerate(scopes) if scope is None]
    chosen = [files[number] for number in rest]
    shared = None if ids == "per-file" else shared_ids(chosen, required=ids == "shared")
    out = list(files)
    for place, number in enumerate(rest):
        if shared is None:
            scopes[number] = _one(files[number], number, stems[number])
        else:
            out[number] = shared.files[place]
            scopes[number] = _shared(shared, [stems[k] for k in rest], rest, chosen)
    return out, [scope for scope in scopes if scope is not None]


def _said(file: PoseFile) -> dict[str, tuple[str, str]]:
    """Kinds and names of robots in a file's comments, by letter."""
    found = [_ROBOT.fullmatch(comment.rstrip()) for comment in file.comments]
    return {match[1]: (match[2], match[3]) for match in found if match}


def _one(file: PoseFile, number: int, stem: str, rule: str = "") -> Scope:
    name = _said(file).get("-", ("id", ""))[1]
    rule = rule or f"plain ids, the file's own: one robot, named by its {_where(name)}"
    return made_scope([f"file {number}"], [name or stem], kind="one", rule=rule)


def _where(name: str) -> str:
    return "comment" if name else "file"


def _by_letters(
    files: Sequence[PoseFile],
    scopes: list[Scope | None],
    rest: Sequence[int],
    stems: Sequence[str],
    *,
    strict: bool,
) -> None:
    """Fills in the scopes of files whose ids are keys."""
    keyed: list[int] = []
    for number in rest:
        ids = files[number].ids
        if symbols.are_labelled(ids):
            scopes[number] = _labelled(files[number], ids)
        elif symbols.are_symbols(ids):
            keyed.append(number)
        elif strict:
            raise _no_symbol(files[number])
    found = {number: _lettered(files[number]) for number in keyed}
    chosen = [] if strict else keyed
    lone = conflicting_letters(
        [files[number] for number in chosen], [found[number] for number in chosen]
    )
    for place, number in enumerate(keyed):
        if place in lone:
            rule = f"GTSAM symbols, but {lone[place]}: one robot a file, named by it"
            scopes[number] = _one(files[number], number, stems[number], rule)
        else:
            scopes[number] = found[number]


def _no_symbol(file: PoseFile) -> FileFormatError:
    for lines in (file.vertices, file.edges):
        wrong = (symbols.letters_of(lines.ids) == 0).any(axis=1)
        if wrong.any():
            row = int(np.argmax(wrong))
            return FileFormatError(
                file.path,
                int(lines.line[row]),
                f"id {lines.ids[row].min()} is no GTSAM symbol, as ids='symbols' expects (were the"
                " letters stripped? GTSAM's own writer does so on request)",
            )
    return FileFormatError(file.path, None, "no ids, as ids='symbols' expects")


def _lettered(file: PoseFile) -> Scope:
    said = _said(file)
    present = [chr(code) for code in np.unique(symbols.letters_of(file.ids))]
    letters = [letter for letter in said if letter in present]
    letters += [letter for letter in present if letter not in said]
    kinds = [said.get(letter, ("key", letter)) for letter in letters]
    order = np.argsort([ord(letter) for letter in letters])
    return made_scope(
        [
            f"symbol {letter} {kind} {name}"
            for letter, (kind, name) in zip(letters, kinds, strict=True)
        ],
        [name for _, name in kinds],
        kind="letters",
        rule=f"GTSAM symbols: the letter is the robot ({', '.join(letters)})",
        codes=np.array([ord(letter) for letter in letters])[order],
        robots=order,
        indexed=[kind == "index" for kind, _ in kinds],
    )


def _labelled(file: PoseFile, ids: Int[np.ndarray, " k"]) -> Scope:
    codes = np.unique(symbols.labels_of(ids))
    letters = np.unique(codes >> 8)
    marks = [chr(code & 0xFF) for code in codes.tolist()]
    if len(letters) > 1:
        marks = [f"{chr(code >> 8).strip(chr(0))}{chr(code & 0xFF)}" for code in codes.tolist()]
    said = _said(file)
    order = [mark for mark in said if mark in marks]
    order += [mark for mark in marks if mark not in said]
    return made_scope(
        [f"label {mark} {said.get(mark, ('label', mark))[1]}" for mark in order],
        [said.get(mark, ("label", mark))[1] for mark in order],
        kind="labels",
        rule=f"GTSAM labelled symbols: the label is the robot ({', '.join(order)})",
        codes=codes,
        robots=[order.index(mark) for mark in marks],
    )


def _shared(
    shared: Shared, stems: Sequence[str], numbers: Sequence[int], files: Sequence[PoseFile]
) -> Scope:
    """One scope for all files that share their ids."""
    owners = [int(owner) for owner in np.unique(shared.owner)]
    names = [_said(files[place]).get("-", ("id", ""))[1] or stems[place] for place in owners]
    return made_scope(
        [f"file {numbers[place]}" for place in owners],
        names,
        kind="table",
        rule="plain ids, shared by the files: a pose is of the file that holds its odometry"
        f" ({', '.join(names)})",
        codes=shared.ids,
        robots=[owners.index(owner) for owner in shared.owner.tolist()],
        ids=shared.ids,
    )


def table_digest(text: str) -> str:
    """Digests a table of ids, for a comment in the file that it belongs to."""
    return digest(text)


def _table(file: PoseFile, number: int) -> Scope | None:
    """From the id table that a comment names: a CSV file with the columns vertex, robot, id."""
    tables = [m[1] for comment in file.comments if (m := _TABLE.fullmatch(comment.rstrip()))]
    if not tables or Path(tables[-1]).name != tables[-1]:
        return None
    table = str(Path(file.path).with_name(tables[-1]))
    if not os.path.isfile(table):  # noqa: PTH113 -- Path.is_file raises for names too long
        warnings.warn(
            InputWarning(
                f"{file.path}: the id table {tables[-1]} is not beside it, so that its poses are"
                " taken for one robot's"
            ),
            stacklevel=2,
        )
        return None
    source = Source(table)
    rows = csv_rows(table, source.lines)
    if tuple(rows.first) != TABLE_COLUMNS:
        raise FileFormatError(table, 1, f"expected the columns {','.join(TABLE_COLUMNS)}")
    rows = rows.rest
    rows.check_width(3, ",".join(TABLE_COLUMNS))
    vertices, ids = rows.integers(0, 1)[:, 0], rows.integers(2, 3)[:, 0]
    names: dict[str, int] = {}
    robots = np.array([names.setdefault(name, len(names)) for name in rows.column(1)], np.int64)
    order = np.argsort(vertices, kind="stable")
    again = np.zeros(len(rows), bool)
    again[order[1:]] = vertices[order[1:]] == vertices[order[:-1]]
    raise_first(again, rows.fault, lambda row: f"vertex {vertices[row]} again, expected it once")
    digests = [m[1] for text in file.comments if (m := _TABLE_DIGEST.fullmatch(text.rstrip()))]
    if digests and digests[-1] != table_digest(source.data.decode(errors="replace")):
        raise FileFormatError(
            table, None, f"changed since {file.path} was written, whose ids it explains"
        )
    return made_scope(
        [f"file {number} robot {name}" for name in names],
        list(names),
        kind="table",
        rule=f"sequential ids: the robots and ids of the table {tables[-1]}",
        codes=vertices[order],
        robots=robots[order],
        ids=ids[order],
    )
