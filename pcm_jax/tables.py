"""Tables as text: in Markdown, in columns, in HTML, and of methods against figures of merit.

print(markdown(["robots", "closures"], [["a - b", 115]]))
print(comparison_table({"pcm": {"tpr": 0.997}, "dcs": {"tpr": 0.0}}, best={"tpr": max}))
"""

from __future__ import annotations

import html
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from pcm_jax.errors import InputError

Columns = Sequence[str] | Mapping[str, str] | None
Best = Mapping[str, Callable[[Iterable[float]], float]]

NOTHING = "–"
_DIGITS = 3
_SMALLEST_PLAIN = 1e-3


class Table(NamedTuple):
    """The texts of a comparison table, row by row.

    Attributes:
        heads: heading of each column; that of the methods is empty.
        cells: the methods' names and their numbers, as text.
        bold: which cells are the best of their column.
        numeric: which columns hold numbers only.
    """

    heads: list[str]
    cells: list[list[str]]
    bold: list[list[bool]]
    numeric: list[bool]


class ShownAsTable:
    """Shows a result as a table where a page is at hand, as in a notebook.

    What its `repr` says stands above the table, which a class describes by `_table`.
    """

    def _table(self) -> tuple[Sequence[str], Iterable[Sequence[object]]]:
        """The heads of the columns, and the rows, of which each cell counts by its `str`."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        heads, rows = self._table()
        return f"<pre>{html.escape(repr(self), quote=False)}</pre>{html_table(heads, rows)}"


def html_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Writes a table in HTML, all text in it escaped; numbers stand to the right by themselves.

    Args:
        head: heading of each column.
        rows: cells, of which each counts by its `str`.
    """
    heads = "".join(f'<th scope="col">{html.escape(str(cell))}</th>' for cell in head)
    body = "".join(f"<tr>{''.join(map(_html_cell, row))}</tr>" for row in rows)
    return f"<table><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table>"


def _html_cell(cell: object) -> str:
    text = str(cell)
    side = "right" if is_number(text) else "left"
    return f'<td style="text-align: {side}">{html.escape(text)}</td>'


def markdown(
    head: Sequence[str],
    rows: Iterable[Sequence[object]],
    *,
    numeric: Sequence[bool] | None = None,
    aligned: bool = False,
) -> str:
    """Writes a table in Markdown.

    Args:
        head: heading of each column.
        rows: cells, of which each counts by its `str`.
        numeric: for each column whether it is set to the right; None: none is.
        aligned: whether cells are padded, so that the text itself stands in columns.
    """
    right = [False] * len(head) if numeric is None else list(numeric)
    lines = [[str(cell) for cell in row] for row in (head, *rows)]
    widths = [max(map(len, column)) if aligned else 0 for column in zip(*lines, strict=True)]
    rule = [("---:" if r else "---").rjust(w, "-") for r, w in zip(right, widths, strict=True)]
    lines.insert(1, rule)
    padded = ([cell.ljust(w) for cell, w in zip(line, widths, strict=True)] for line in lines)
    return "\n".join(f"| {' | '.join(line)} |" for line in padded)


def columns_of_text(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Writes rows in aligned columns under a head: numbers to the right, all else to the left."""
    lines = [[str(cell) for cell in row] for row in (head, *rows)]
    columns = list(zip(*lines, strict=True))
    widths = [max(map(len, column)) for column in columns]
    right = [all(is_number(cell) for cell in column[1:]) for column in columns]
    padded = (
        (
            cell.rjust(width) if to_right else cell.ljust(width)
            for cell, width, to_right in zip(line, widths, right, strict=True)
        )
        for line in lines
    )
    return "\n".join("  ".join(line).rstrip() for line in padded)


def is_number(text: str) -> bool:
    """Says whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def comparison_table(
    rows: Mapping[str, Mapping[str, Any]],
    columns: Columns = None,
    *,
    best: Best | None = None,
    reference: str | None = None,
) -> str:
    """A table in Markdown: a row for each method, a column for each figure of merit.

    Numbers have three significant digits; whole ones are written in full, so that 1 is exactly 1,
    and 1.00 is not.

    Args:
        rows: for each method its numbers by column; None, NaN and missing ones become a dash.
        columns: which columns, in order, or from their names to the headings to write; None: all.
        best: `min` or `max` for the columns whose best value is to be bold.
        reference: a method that does not compete for it, such as the merge by the true closures.

    Raises:
        InputError: `columns` or `best` name a column that no row has.
    """
    table = tabulate(rows, columns, best=best, reference=reference)
    lines = (
        [f"**{text}**" if strong else text for text, strong in zip(cells, bold, strict=True)]
        for cells, bold in zip(table.cells, table.bold, strict=True)
    )
    return markdown([head or " " for head in table.heads], lines, numeric=table.numeric)


def tabulate(
    rows: Mapping[str, Mapping[str, Any]],
    columns: Columns = None,
    *,
    best: Best | None = None,
    reference: str | None = None,
) -> Table:
    """Lays out the texts of `comparison_table`, whose arguments these are."""
    names = list(dict.fromkeys(name for row in rows.values() for name in row))
    chosen = names if columns is None else list(columns)
    for argument, given in {"columns": chosen, "best": best or ()}.items():
        for name in given:
            if name not in names:
                raise InputError(f"{argument}: {name!r} given, expected one of {names}")
    values = [[row.get(name) for name in chosen] for row in rows.values()]
    winners = np.zeros((len(values), len(chosen)), bool)
    competes = np.array([method != reference for method in rows], bool)
    for name, pick in (best or {}).items():
        if name in chosen:
            k = chosen.index(name)
            winners[:, k] = _winners([row[k] for row in values], competes, pick)
    return Table(
        ["", *(columns[name] if isinstance(columns, Mapping) else name for name in chosen)],
        [[method, *map(_text, row)] for method, row in zip(rows, values, strict=True)],
        [[False, *row] for row in winners.tolist()],
        [False, *(all(not isinstance(row[k], str) for row in values) for k in range(len(chosen)))],
    )


def _winners(values: Sequence[Any], competes: np.ndarray, pick: Any) -> np.ndarray:
    """Marks the best of those that compete; ties win together."""
    numbers = np.array([np.nan if _missing(value) else value for value in values], dtype=float)
    candidates = numbers[competes & np.isfinite(numbers)]
    return competes & (numbers == pick(candidates)) if len(candidates) else np.zeros(len(values))


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    if _missing(value):
        return NOTHING
    number = float(value)
    if number.is_integer():
        return f"{number:,.0f}"
    if abs(number) < _SMALLEST_PLAIN or not np.isfinite(number):
        return f"{number:.{_DIGITS - 1}e}"
    # A number that rounding carries to the next power of ten has one digit less behind the point.
    power = int(f"{number:.{_DIGITS - 1}e}".partition("e")[2])
    return f"{number:,.{max(0, _DIGITS - 1 - power)}f}"


def _missing(value: Any) -> bool:
    return value is None or (not isinstance(value, str) and bool(np.isnan(value)))
