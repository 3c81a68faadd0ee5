"""The comparison table as a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pcm_jax.plots.style import BLACK, axes_or_new
from pcm_jax.tables import Best, Columns, tabulate

# Inches: of a character at the size of _POINTS, of a row, and around everything.
_CHARACTER, _ROW, _MARGIN = 0.085, 0.29, 0.15
_POINTS = 10.0
_GAP = 2.5  # characters between columns
_STRIPE = "#F1EEE9"


def plot_comparison_table(
    rows: Mapping[str, Mapping[str, Any]],
    columns: Columns = None,
    *,
    best: Best | None = None,
    reference: str | None = None,
    ax: Any = None,
) -> Any:
    """Draws what `comparison_table` writes, with its arguments, as in the paper's Tables I and II.

    Args:
        rows: for each method its numbers by column.
        columns: which columns, in order, or from their names to the headings to write; None: all.
        best: `min` or `max` for the columns whose best value is to be bold.
        reference: a method that does not compete for it.
        ax: matplotlib axes to draw into, with letters as large as fit; None makes a figure.

    Returns:
        The axes.

    Raises:
        InputError: `columns` or `best` name a column that no row has.
    """
    table = tabulate(rows, columns, best=best, reference=reference)
    # A heading may be broken into lines.
    widths = [
        _GAP + max(len(line) for text in column for line in text.split("\n"))
        for column in zip(table.heads, *table.cells, strict=True)
    ]
    head = 0.65 * max(text.count("\n") for text in table.heads) + 1.1
    width, height = sum(widths), head + len(table.cells)
    ax = axes_or_new(ax, (width * _CHARACTER + 2 * _MARGIN, height * _ROW + 2 * _MARGIN))
    ax.set_xlim(0.0, width)
    ax.set_ylim(height, 0.0)
    ax.set_axis_off()
    places = _places(widths, table.numeric)
    looks = {"fontsize": _points(ax, width)}
    _write(ax, head - 0.2, places, table.heads, [True] * len(widths), va="bottom", **looks)
    for k, (cells, bold) in enumerate(zip(table.cells, table.bold, strict=True)):
        _write(ax, head + k + 0.5, places, cells, bold, va="center", **looks)
        if k % 2:
            ax.axhspan(head + k, head + k + 1, color=_STRIPE, linewidth=0, zorder=0.0)
    for y, thickness in ((0.0, 1.6), (head, 0.8), (height, 1.6)):
        ax.axhline(y, color=BLACK, linewidth=thickness, clip_on=False)
    return ax


def _places(widths: Sequence[float], numeric: Sequence[bool]) -> list[tuple[float, str]]:
    """Places where each column's texts end, numbers at its right, or begin, at its left."""
    right = np.cumsum(widths)
    return [
        (end - 0.5 * _GAP, "right") if number else (end - width + 0.5 * _GAP, "left")
        for end, width, number in zip(right, widths, numeric, strict=True)
    ]


def _write(
    ax: Any,
    y: float,
    places: Sequence[tuple[float, str]],
    texts: Sequence[str],
    bold: Sequence[bool],
    **looks: Any,
) -> None:
    for (x, side), text, strong in zip(places, texts, bold, strict=True):
        ax.text(x, y, text, ha=side, fontweight="bold" if strong else "normal", **looks)


def _points(ax: Any, width: float) -> float:
    """The size of letters at which so many characters fit the axes."""
    ax.figure.draw_without_rendering()
    inches = ax.get_window_extent().width / ax.figure.dpi
    return min(_POINTS, _POINTS * inches / (width * _CHARACTER))
