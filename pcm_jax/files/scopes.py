"""Whose poses a file's ids are, and the comments in which `write_g2o` says so.

A file of GTSAM symbol keys speaks of as many robots as it has letters. In any other file the ids
belong to one robot, that file's own. Comments of `write_g2o` can add to that (g2o, and whatever
else reads its files, skips them):

    # pcm_jax robot a key NAME      robot a is called NAME; its poses' ids are the symbol keys
    # pcm_jax robot a index NAME    …; its poses' ids are the keys' indices
    # pcm_jax robot - id NAME       the file's one robot is called NAME
    # pcm_jax id-table FILE         the ids are sequential; FILE beside this one says whose they are
    # pcm_jax order lines           poses are in the order of their lines, not of their ids
"""

from __future__ import annotations

import dataclasses
import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int

from pcm_jax.errors import FileFormatError, InputWarning
from pcm_jax.files.source import read_lines
from pcm_jax.files.text import csv_rows
from pcm_jax.graph import symbols

ROBOT_LINE = "# pcm_jax robot {letter} {kind} {name}"
TABLE_LINE = "# pcm_jax id-table {file}"
ORDER_LINE = "# pcm_jax order lines"
TABLE_COLUMNS = ("vertex", "robot", "id")
_ROBOT = re.compile(r"# pcm_jax robot (\S) (key|index|id) (.+)")
_TABLE = re.compile(r"# pcm_jax id-table (\S.*)")


@dataclasses.dataclass(frozen=True)
class Scope:
    """Turns a file's ids into robots and their poses' ids.

    Attributes:
        labels: one per robot the file speaks of, in the robots' order; equal labels in two files
            are one robot.
        names: their names; empty where the file gives none.
        codes: int64, ascending: the symbol letters (or table vertices) that `robots` belong to;
            empty for a file of one robot.
        robots: int64, for each of `codes` the index of its robot.
        ids: int64, for each of `codes` of a table the pose's id.
        indexed: bool per robot, whether its poses' ids are the keys' indices.
    """

    labels: tuple[str, ...]
    names: tuple[str, ...]
    codes: Int[np.ndarray, " c"]
    robots: Int[np.ndarray, " c"]
    ids: Int[np.ndarray, " c"]
    indexed: Bool[np.ndarray, " r"]

    def locate(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Robots (indices of `labels`, −1 where unknown) and their poses' ids, of a file's ids."""
        if not len(self.codes):
            return np.zeros(ids.shape, np.int64), ids
        table = len(self.ids) > 0
        wanted = ids if table else symbols.letters_of(ids)
        slot = np.minimum(np.searchsorted(self.codes, wanted), len(self.codes) - 1)
        robot = np.where(self.codes[slot] == wanted, self.robots[slot], -1)
        if table:
            return robot, np.where(robot >= 0, self.ids[slot], ids)
        return robot, np.where(self.indexed[robot], symbols.indices_of(ids), ids)


def scope_of(path: str, number: int, ids: np.ndarray, comments: Sequence[str]) -> Scope:
    """How the ids `[k]` of the file `path`, the `number`-th of those read, are meant.

    Raises:
        FileFormatError: for an id table that is not what its file says.

    Warns:
        InputWarning: when the file names an id table that is not beside it.
    """
    found = [_ROBOT.fullmatch(comment.rstrip()) for comment in comments]
    said = {match[1]: (match[2], match[3]) for match in found if match}
    tables = [match[1] for comment in comments if (match := _TABLE.fullmatch(comment.rstrip()))]
    if tables and Path(tables[-1]).name == tables[-1]:
        table = Path(path).with_name(tables[-1])
        if os.path.isfile(table):  # noqa: PTH113 -- Path.is_file raises for names too long
            return _table_scope(str(table), number)
        warnings.warn(
            InputWarning(
                f"{path}: the id table {table.name} is not beside it, so that its poses are taken"
                " for one robot's"
            ),
            stacklevel=2,
        )
    if symbols.are_symbols(ids):
        return _symbol_scope(ids, said)
    name = said.get("-", ("id", ""))[1]
    return _scope([f"file {number}"], [name])


def _scope(
    labels: Sequence[str],
    names: Sequence[str],
    *,
    codes: Sequence[int] | np.ndarray = (),
    robots: Sequence[int] | np.ndarray = (),
    ids: Sequence[int] | np.ndarray = (),
    indexed: Sequence[bool] = (),
) -> Scope:
    flags = np.asarray(indexed, bool) if len(indexed) else np.zeros(len(labels), bool)
    return Scope(
        tuple(labels),
        tuple(names),
        np.asarray(codes, np.int64),
        np.asarray(robots, np.int64),
        np.asarray(ids, np.int64),
        flags,
    )


def _symbol_scope(ids: np.ndarray, said: dict[str, tuple[str, str]]) -> Scope:
    present = [chr(code) for code in np.unique(symbols.letters_of(ids))]
    letters = [letter for letter in said if letter in present]
    letters += [letter for letter in present if letter not in said]
    kinds = [said.get(letter, ("key", letter)) for letter in letters]
    order = np.argsort([ord(letter) for letter in letters])
    return _scope(
        [
            f"symbol {letter} {kind} {name}"
            for letter, (kind, name) in zip(letters, kinds, strict=True)
        ],
        [name for _, name in kinds],
        codes=np.array([ord(letter) for letter in letters])[order],
        robots=order,
        indexed=[kind == "index" for kind, _ in kinds],
    )


def _table_scope(table: str, number: int) -> Scope:
    """From an id table: a CSV file with the columns vertex, robot, id."""
    rows = csv_rows(table, read_lines(table))
    if tuple(rows.first) != TABLE_COLUMNS:
        raise FileFormatError(table, 1, f"expected the columns {','.join(TABLE_COLUMNS)}")
    rows = rows.rest
    rows.check_width(3, ",".join(TABLE_COLUMNS))
    vertices, ids = rows.integers(0, 1)[:, 0], rows.integers(2, 3)[:, 0]
    names: dict[str, int] = {}
    robots = np.array([names.setdefault(name, len(names)) for name in rows.column(1)], np.int64)
    order = np.argsort(vertices, kind="stable")
    return _scope(
        [f"file {number} robot {name}" for name in names],
        list(names),
        codes=vertices[order],
        robots=robots[order],
        ids=ids[order],
    )
