"""Colours, lines and figures that all plots share: told apart in print, in grey, and by everyone.

The colours are Okabe and Ito's (2008); no distinction is left to colour alone, but to width, dashes
or markers as well.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

BLACK = "#000000"
ORANGE = "#E69F00"
SKY = "#56B4E9"
GREEN = "#009E73"
BLUE = "#0072B2"
RED = "#D55E00"
PINK = "#CC79A7"
GREY = "#8C8C8C"

# Blue, red and pink are kept for closures.
ROBOTS = (ORANGE, BLACK, SKY, GREEN)
SERIES = (BLUE, ORANGE, GREEN, RED, PINK, BLACK)
MARKERS = ("o", "s", "^", "D", "v", "P")
DASHES = ("-", "--", "-.", ":")
HATCHES = ("", "//", "..", "xx", "\\\\", "++")
DPI = 150


class LineStyle(NamedTuple):
    """The line by which closures of one kind are drawn."""

    label: str
    color: str
    linestyle: str
    linewidth: float
    marker: str
    zorder: float  # maps are drawn at 2 to 3


# As in the paper's Fig. 5: bold blue, red, pink, dotted grey. Before any choice: thin and grey.
CANDIDATE = LineStyle("candidates", GREY, "-", 0.8, "", 1.0)
CANDIDATE_TRUE = LineStyle("true candidates", PINK, "-", 1.2, "^", 4.5)
CANDIDATE_FALSE = LineStyle("false candidates", GREY, ":", 0.8, "", 1.0)
ACCEPTED = LineStyle("accepted", BLUE, "-", 2.2, "o", 5.0)
ACCEPTED_TRUE = LineStyle("accepted, true", BLUE, "-", 2.2, "o", 5.0)
ACCEPTED_FALSE = LineStyle("accepted, false", RED, "--", 1.2, "X", 1.8)
LOST = LineStyle("rejected, true", PINK, "-", 1.8, "^", 4.5)
REJECTED = LineStyle("rejected", GREY, ":", 0.8, "", 1.0)
REJECTED_FALSE = LineStyle("rejected, false", GREY, ":", 0.8, "", 1.0)


def thinned(count: int, plain: int) -> float:
    """The width and opacity of one among many marks: 1 up to `plain`, with 1/√count beyond."""
    return min(1.0, (plain / max(count, 1)) ** 0.5)


def robot_style(index: int, count: int) -> dict[str, Any]:
    """Line of one robot's map: later ones are thinner, so that shared streets show them all."""
    widths = np.linspace(2.6, 1.0, max(count, 2))
    return {
        "color": ROBOTS[index % len(ROBOTS)],
        "linestyle": DASHES[(index // len(ROBOTS)) % len(DASHES)],
        "linewidth": widths[index],
        "zorder": 2.0 + index / count,
    }


def series_style(index: int, count: int) -> dict[str, Any]:
    """Line of one method: later ones are thinner, so that methods that agree all show."""
    return {
        "color": SERIES[index % len(SERIES)],
        "linestyle": DASHES[index % len(DASHES)],
        "marker": MARKERS[index % len(MARKERS)],
        "linewidth": np.linspace(2.6, 1.2, max(count, 2))[index],
        "markersize": np.linspace(8.0, 4.0, max(count, 2))[index],
    }


def axes_or_new(ax: Any, size: tuple[float, float] = (5.8, 5.4)) -> Any:
    """The axes given, or those of a new figure of `size` inches."""
    if ax is not None:
        return ax
    from matplotlib import pyplot

    return pyplot.subplots(figsize=size, dpi=DPI, layout="constrained")[1]


def legend_below(ax: Any, columns: int = 3, offset: float = -0.13) -> None:
    """A legend outside the axes, where it hides nothing; none where nothing has a label."""
    if not ax.get_legend_handles_labels()[0]:
        return
    legend = ax.legend(
        loc="upper center",
        bbox_to_anchor=(0.5, offset),
        ncols=columns,
        frameon=False,
        fontsize="medium",
        handlelength=2.6,
    )
    shown_plainly(legend)


def shown_plainly(legend: Any) -> None:
    """Draws a legend's lines at a width and opacity at which they are seen, however thin below."""
    from matplotlib.lines import Line2D

    for handle in legend.legend_handles:
        if isinstance(handle, Line2D):
            handle.set_alpha(1.0)
            handle.set_linewidth(max(handle.get_linewidth(), 0.8))
            handle.set_markersize(max(handle.get_markersize(), 4.0))
