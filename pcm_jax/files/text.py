"""From a file's lines to tables of numbers, with the line each row came from.

Lines are split and converted in bulk; only when that fails are they looked at one by one, to name
the culprit.
"""

from __future__ import annotations

import csv
import dataclasses
import itertools
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax.errors import FileFormatError
from pcm_jax.graph import symbols
from pcm_jax.graph.validation import Fault, check_finite, raise_first

_INTEGER = "an integer id of 64 bits"
MOST_TAGS = 300  # different first words: formats have fewer, other files as many as lines


@dataclasses.dataclass(frozen=True)
class Rows:
    """The split lines of one kind.

    All words stand in one flat list: a list per line would keep the garbage collector busy for
    longer than the conversion takes.

    Attributes:
        path: the file.
        line: int64 `[n]`, 1-based line numbers.
        widths: int64 `[n]`, how many words each line has.
        words: the words of all lines.
    """

    path: str
    line: Int[np.ndarray, " n"]
    widths: Int[np.ndarray, " n"]
    words: list[str]

    def __len__(self) -> int:
        return len(self.line)

    @property
    def fault(self) -> Fault:
        """Names a row by its file and line."""
        return line_fault(self.path, self.line)

    @property
    def source(self) -> np.ndarray:
        """Object array `[n]` of strings "file:line"."""
        return sources(self.path, self.line)

    @property
    def first(self) -> list[str]:
        """The words of the first row."""
        return self.words[: self.widths[0]] if len(self) else []

    def under(self, names: Sequence[str]) -> Rows:
        """The rows below a first one that has the columns' names."""
        first = self.line[:1] - 1
        widths = np.concatenate([[len(names)], self.widths])
        return Rows(self.path, np.concatenate([first, self.line]), widths, [*names, *self.words])

    @property
    def rest(self) -> Rows:
        """All rows but the first."""
        return Rows(self.path, self.line[1:], self.widths[1:], self.words[self.widths[0] :])

    def __getitem__(self, chosen: Bool[np.ndarray, " n"]) -> Rows:
        """The rows that a mask marks."""
        if chosen.all():
            return self
        words = list(itertools.compress(self.words, np.repeat(chosen, self.widths).tolist()))
        return Rows(self.path, self.line[chosen], self.widths[chosen], words)

    def check_width(self, width: int, expected: str, last_line: int = 0) -> None:
        """Every row has `width` words; to be called before `column`, `integers` and `floats`.

        Args:
            width: number of words.
            expected: the columns, for messages.
            last_line: the file's last line, at which too few words mean a truncated file.

        Raises:
            FileFormatError: for the first row that has more or fewer.
        """

        def problem(row: int) -> str:
            short = self.widths[row] < width and self.line[row] == last_line
            hint = " (is the file cut short?)" if short else ""
            return f"{self.widths[row]} columns, expected {width}: {expected}{hint}"

        raise_first(self.widths != width, self.fault, problem)

    def column(self, index: int) -> list[str]:
        """The words of one column."""
        return self.words[index :: self.widths[0]] if len(self) else []

    def integers(self, start: int, stop: int) -> Int[np.ndarray, "n k"]:
        """Columns `start` to `stop` as int64 `[n, stop - start]`, never by way of floats.

        Raises:
            FileFormatError: for a word that is not an integer of 64 bits.
        """
        return self._converted(start, stop, int, np.int64, _INTEGER)

    def ids(self, start: int, stop: int) -> Int[np.ndarray, "n k"]:
        """As `integers`; "a12" is the symbol key of robot a's pose 12.

        Raises:
            FileFormatError: for a word that is neither.
        """
        try:
            return self.integers(start, stop)
        except FileFormatError:
            return self._converted(start, stop, symbols.key_of, np.int64, _INTEGER)

    def floats(self, start: int, stop: int) -> Float[np.ndarray, "n k"]:
        """Columns `start` to `stop` as float64 `[n, stop - start]`.

        Raises:
            FileFormatError: for a word that is not a finite number.
        """
        table = self._converted(start, stop, float, np.float64, "a number")
        check_finite(table, self.fault)
        return table

    def _converted(
        self, start: int, stop: int, convert: Callable[[str], Any], dtype: Any, expected: str
    ) -> np.ndarray:
        table = np.empty((len(self), stop - start), dtype)
        for index in range(start, stop):
            words = self.column(index)
            try:
                text = "".join(words)
                if "_" in text or not text.isascii():  # Python reads 1_0 as 10, and ١٠ too
                    raise ValueError
                table[:, index - start] = list(map(convert, words))
            except (ValueError, OverflowError):
                row = next(k for k, word in enumerate(words) if not _fits(word, convert, dtype))
                problem = f"{words[row][:40]!r} given, expected {expected}{_hint(words[row])}"
                raise self.fault(row, problem) from None
        return table


def _hint(word: str) -> str:
    """Says what a word that is no number looks like."""
    if re.fullmatch(r"[-+]?\d+,\d*([eE][-+]?\d+)?", word):
        return " with a decimal point, not a decimal comma"
    return ", not columns with ';' between them" if ";" in word else ""


def _fits(word: str, convert: Callable[[str], Any], dtype: Any) -> bool:
    try:
        np.array(convert(word), dtype=dtype)
    except (ValueError, OverflowError):
        return False
    return "_" not in word and word.isascii()


def line_fault(path: str, line: np.ndarray) -> Fault:
    """Names a row by its file and line."""
    return lambda row, problem: FileFormatError(path, int(line[row]), problem)


def sources(path: str, line: np.ndarray) -> np.ndarray:
    """Object array `[n]` of strings "file:line"."""
    names = np.empty(len(line), dtype=object)
    names[:] = [f"{path}:{number}" for number in line.tolist()]
    return names


def rows_by_tag(path: str, lines: Sequence[str]) -> tuple[dict[str, Rows], list[str]]:
    """Splits lines at white space and groups them by their first word.

    Returns:
        The rows of each first word, in order of appearance; and the comment lines (those that
        start with "#"). Blank lines are dropped.
    """
    words: dict[str, list[str]] = {}
    widths: dict[str, list[int]] = {}
    numbers: dict[str, list[int]] = {}
    comments = []
    for number, line in enumerate(lines, start=1):
        row = line.split()
        if not row:
            continue
        tag = row[0]
        if tag[0] == "#":
            comments.append(line)
            continue
        if tag not in words:
            if len(words) == MOST_TAGS:
                raise FileFormatError(
                    path, number, f"unknown tag {tag[:40]!r}, after {MOST_TAGS} other first words"
                )
            words[tag], widths[tag], numbers[tag] = [], [], []
        words[tag] += row
        widths[tag].append(len(row))
        numbers[tag].append(number)
    return {tag: _rows(path, numbers[tag], widths[tag], words[tag]) for tag in words}, comments


def _rows(path: str, numbers: list[int], widths: list[int], words: list[str]) -> Rows:
    return Rows(path, np.array(numbers, np.int64), np.array(widths, np.int64), words)


def table_rows(path: str, lines: Sequence[str]) -> Rows:
    """Splits lines at white space; blank lines and those that start with "#" are dropped."""
    return _split_rows(path, lines, str.split)


def delimiter_of(line: str) -> str | None:
    """The mark between a line's columns: a semicolon, tab or comma, else blanks; None for one."""
    found = next((mark for mark in ";\t," if mark in line), None)
    return " " if found is None and " " in line.strip() else found


def csv_rows(path: str, lines: Sequence[str]) -> Rows:
    """Splits lines at commas; blank lines and those that start with "#" are dropped.

    Semicolons, tabs or blanks will do for commas, where the first line has them. A first line that
    ends with one has no column there, and no line has.
    """
    first = next((line for line in lines if line.strip() and line.lstrip()[0] != "#"), "")
    mark = delimiter_of(first) or ","

    open_ended = mark != " " and first.rstrip().endswith(mark)

    def split(line: str) -> list[str]:
        text = " ".join(line.split()) if mark == " " else line
        cells = next(csv.reader([text], skipinitialspace=True, delimiter=mark))
        words = [word.strip() for word in cells]
        return words[:-1] if open_ended and words[-1:] == [""] else words

    return _split_rows(path, lines, split)


def _split_rows(path: str, lines: Sequence[str], split: Callable[[str], list[str]]) -> Rows:
    words: list[str] = []
    widths, numbers = [], []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            row = split(line)
        except csv.Error as error:
            raise FileFormatError(path, number, f"not comma-separated values: {error}") from None
        words += row
        widths.append(len(row))
        numbers.append(number)
    return _rows(path, numbers, widths, words)
