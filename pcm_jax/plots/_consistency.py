"""Pictures of pairwise consistency: the squared distances, and the graph of those inside."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pcm_jax.consistency import PairEvidence
from pcm_jax.errors import InputError
from pcm_jax.graph.checked import as_mask
from pcm_jax.plots import style
from pcm_jax.plots.style import axes_or_new, legend_below

# Orders of magnitude shown on either side of the gate; beyond them colours saturate.
_DECADES = 3.0
# Node numbers are readable up to about this many around the circle.
_NUMBERED_NODES = 48
# Chords of a kind that are drawn, and that still show as lines.
_MOST_CHORDS, _PLAIN_CHORDS = 1_500, 400


def plot_squared_distances(
    squared: Float[Array, "m m"] | PairEvidence,
    gate: float,
    *,
    order: Int[np.ndarray, " m"] | None = None,
    ax: Any = None,
) -> Any:
    """Draws the squared distances `q²_uv` as a picture, the gate as a break in its colours.

    Pairs inside the gate are dark blue, the darker the more consistent; pairs outside are light,
    the lighter the less. The scale is logarithmic and covers a factor of 1000 either way.

    Args:
        squared: squared Mahalanobis distances, row u against column v; the diagonal is left out.
        gate: γ², as of `chi2_gate`.
        order: measurements in the order to draw them, such as a clique's members first.
        ax: matplotlib axes to draw into; None makes a figure.

    Returns:
        The axes; the colour bar is their neighbour.

    Raises:
        InputError: `squared` is not square, or the gate is not above 0.
    """
    from matplotlib.colors import LogNorm

    values = checked_distances(squared, gate)
    np.fill_diagonal(values, np.nan)
    if order is not None:
        values = values[np.ix_(np.asarray(order), np.asarray(order))]
    ax = axes_or_new(ax, (5.8, 4.9))
    span = 10.0**_DECADES
    norm = LogNorm(vmin=gate / span, vmax=gate * span, clip=True)
    floor = np.finfo(float).tiny  # zeros are as consistent as can be, and have no logarithm
    shown = np.ma.masked_invalid(np.where(values <= 0, floor, values))
    image = ax.imshow(shown, cmap=_gate_colors(), norm=norm, interpolation="nearest")
    ax.set_xlabel("measurement v" if order is None else "measurement v, reordered")
    ax.set_ylabel("measurement u" if order is None else "measurement u, reordered")
    bar = ax.figure.colorbar(image, ax=ax, extend="both")
    bar.set_label(f"squared distance q² (line: gate γ² = {gate:.4g})")
    bar.ax.axhline(gate, color=style.RED, linewidth=2.5)
    return ax


def plot_consistency_graph(
    graph: Bool[Array, "m m"],
    members: Bool[np.ndarray, " m"] | None = None,
    *,
    is_true: Bool[np.ndarray, " m"] | None = None,
    ax: Any = None,
) -> Any:
    """Draws measurements on a circle and their consistent pairs as chords; a clique lights up.

    The clique's members stand on a circle of their own inside. Measurements keep their order,
    clockwise from the top. Of many thousands of pairs some are drawn, evenly spaced; the legend
    says one in how many.

    Args:
        graph: symmetric adjacency, as of `consistency_graph`.
        members: which measurements the clique contains.
        is_true: which measurements are true, where that is known.
        ax: matplotlib axes to draw into; None makes a figure.

    Returns:
        The axes.

    Raises:
        InputError: `graph` is not square, or a mask is of another length.
    """
    adjacency = np.asarray(graph, dtype=bool)
    count = len(adjacency)
    if adjacency.shape != (count, count):
        raise InputError(f"graph: shape {adjacency.shape} given, expected [m, m]")
    true = None if is_true is None else as_mask(is_true, "is_true", count)
    inside = np.zeros(count, bool)
    if members is not None:
        inside = as_mask(members, "members", count)
    ax = axes_or_new(ax, (5.8, 5.8))
    places = np.empty((count, 2))
    places[~inside] = _circle(count - inside.sum())
    places[inside] = 0.5 * _circle(inside.sum())
    _draw_chords(ax, places, adjacency, inside)
    _draw_nodes(ax, places, inside, true)
    ax.set_aspect("equal")
    ax.set_axis_off()
    legend_below(ax, columns=2, offset=-0.01)
    return ax


def checked_distances(squared: Any, gate: float) -> Float[np.ndarray, "m m"]:
    """The distances as a matrix of one's own to draw from; `InputError` unless they are one."""
    given = squared.comparable if isinstance(squared, PairEvidence) else squared
    values = np.array(given, dtype=float)
    if values.ndim != 2 or values.shape[0] != values.shape[1]:
        raise InputError(f"squared: shape {values.shape} given, expected [m, m]")
    if not gate > 0:
        raise InputError(f"gate: {gate} given, expected a number above 0")
    return values


def _gate_colors() -> Any:
    """Dark blues up to the middle of the scale, where the gate is, light greys above it."""
    from matplotlib.colors import LinearSegmentedColormap

    stops = [(0.0, "#03244d"), (0.5, "#2f7fc1"), (0.5, "#c9c2b8"), (1.0, "#faf8f5")]
    return LinearSegmentedColormap.from_list("gate", stops, N=512).with_extremes(bad="white")


def _circle(count: int) -> Float[np.ndarray, "c 2"]:
    """Places on the unit circle, clockwise from the top."""
    angle = 2.0 * np.pi * np.arange(count) / max(count, 1)
    return np.stack([np.sin(angle), np.cos(angle)], axis=-1)


def _draw_chords(ax: Any, places: Any, adjacency: Any, inside: Any) -> None:
    """Every chord, or of thousands some, evenly spaced: the more, the fainter."""
    from matplotlib.collections import LineCollection

    u, v = np.nonzero(np.triu(adjacency, 1))
    lit = inside[u] & inside[v]
    for rows, color, width, order in (
        (np.flatnonzero(~lit), style.GREY, 0.7, 1.0),
        (np.flatnonzero(lit), style.BLUE, 1.3, 2.0),
    ):
        every = -(-len(rows) // _MOST_CHORDS) or 1
        shown = rows[::every]
        faint = style.thinned(len(shown), _PLAIN_CHORDS)
        label = f"agree (one in {every} of {len(rows):,} drawn)" if every > 1 else None
        chords = LineCollection(
            list(places[np.stack([u[shown], v[shown]], axis=-1)]),
            colors=color,
            linewidths=width * faint,
            alpha=faint,
            zorder=order,
            label=label,
        )
        ax.add_collection(chords)


def _draw_nodes(ax: Any, places: Any, inside: Any, true: Any) -> None:
    if true is None:
        kinds = {"in the clique": (inside, style.BLUE, "o"), "other": (~inside, "white", "o")}
    else:
        kinds = {
            "in the clique, true": (inside & true, style.BLUE, "o"),
            "in the clique, false": (inside & ~true, style.RED, "X"),
            "other, true": (~inside & true, style.PINK, "^"),
            "other, false": (~inside & ~true, "white", "o"),
        }
    numbered, small = len(places) <= _NUMBERED_NODES, style.thinned(len(places), _PLAIN_CHORDS)
    for label, (rows, color, marker) in kinds.items():
        if rows.any():
            ax.scatter(
                *places[rows].T,
                s=70 if numbered else 28 * small**2,
                c=color,
                marker=marker,
                edgecolors="black",
                linewidths=0.7 * small,
                zorder=3.0,
                label=f"{label} ({rows.sum()})",
            )
    if numbered:
        for k, place in enumerate(places):
            beside = place * (1.0 + 0.09 / np.linalg.norm(place))
            ax.text(*beside, str(k), ha="center", va="center", fontsize="small", zorder=4.0)
