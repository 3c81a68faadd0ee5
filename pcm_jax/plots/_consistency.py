"""Pictures of pairwise consistency: the squared distances, the gate, and the graph."""

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
# Width of a histogram's bins, in decades: four to a factor of ten.
_BIN = 0.25
# Right pairs, and pairs of unknown truth, are dark; others are an outline that hides nothing.
_HISTOGRAMS: tuple[dict[str, Any], ...] = (
    {"fill": True, "color": style.BLUE, "alpha": 0.85, "zorder": 2.0},
    {"fill": False, "color": style.GREY, "hatch": "////", "linewidth": 1.5, "zorder": 2.5},
)


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

    values = _checked_distances(squared, gate)
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
    clockwise from the top.

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


def plot_gate(
    squared: Float[Array, "m m"] | PairEvidence,
    gate: float,
    *,
    dof: int,
    is_true: Bool[np.ndarray, " m"] | None = None,
    ax: Any = None,
) -> Any:
    """Draws how the squared distances are spread beside what two right closures should have.

    Where truth is known, pairs of two true closures are drawn apart from the rest, each kind in
    percent of its own number, and the curve is what the chi-squared distribution expects: the
    covariances are right where the bars follow it. Without truth the curve is scaled to the share
    of all pairs inside the gate. The axis is logarithmic: an outlier's distance can be anything.

    Args:
        squared: squared Mahalanobis distances, or a `PairEvidence` that has them; the two
            directions of a pair count as their maximum.
        gate: γ², as of `chi2_gate`.
        dof: degrees of freedom, d: 3 in SE(2), 6 in SE(3).
        is_true: which measurements are true, where that is known.
        ax: matplotlib axes to draw into; None makes a figure.

    Returns:
        The axes.

    Raises:
        InputError: `squared` is not square, the gate is not above 0, or a mask of another length.
    """
    values = _checked_distances(squared, gate)
    true = None if is_true is None else as_mask(is_true, "is_true", len(values))
    u, v = np.triu_indices(len(values), 1)
    pairs = np.maximum(np.maximum(values[u, v], values[v, u]), np.finfo(float).tiny)
    if true is None:
        kinds, share = {"pairs": np.ones(len(pairs), bool)}, 100.0 * float(np.mean(pairs <= gate))
    else:
        right = true[u] & true[v]
        kinds, share = {"two true": right, "one or both false": ~right}, 100.0
    ax = axes_or_new(ax, (5.8, 4.2))
    low = min(-2.0, np.log10(gate) - 2.0)
    edges = np.arange(low, max(np.log10(pairs.max(initial=gate)), low + 4.0) + _BIN, _BIN)
    for (name, rows), looks in zip(kinds.items(), _HISTOGRAMS, strict=False):
        counts, _ = np.histogram(np.clip(np.log10(pairs[rows]), edges[0], edges[-1]), edges)
        percent = 100.0 * counts / max(rows.sum(), 1)
        ax.stairs(percent, 10.0**edges, label=f"{name} ({rows.sum()})", **looks)
    _draw_chi2(ax, edges, dof, share)
    ax.axvline(gate, color=style.RED, linewidth=2.0, label=f"gate γ² = {gate:.4g}")
    ax.set_xscale("log")
    ax.set_xlabel("squared distance q², larger direction")
    ax.set_ylabel("pairs of closures (%)")
    legend_below(ax, columns=2, offset=-0.2)
    return ax


def _checked_distances(squared: Any, gate: float) -> Float[np.ndarray, "m m"]:
    given = squared.comparable if isinstance(squared, PairEvidence) else squared
    values = np.array(given, dtype=float)
    if values.ndim != 2 or values.shape[0] != values.shape[1]:
        raise InputError(f"squared: shape {values.shape} given, expected [m, m]")
    if not gate > 0:
        raise InputError(f"gate: {gate} given, expected a number above 0")
    return values


def _draw_chi2(ax: Any, edges: Float[np.ndarray, " e"], dof: int, percent: float) -> None:
    """Draws what chi-squared expects in a bin centred at each place, of so many percent in all."""
    from scipy.special import gammainc

    at = np.linspace(edges[0], edges[-1], 400)
    above, below = (gammainc(0.5 * dof, 0.5 * 10.0 ** (at + h * _BIN)) for h in (0.5, -0.5))
    curve = percent * (above - below)
    ax.plot(10.0**at, curve, color=style.BLACK, zorder=3.0, label=f"chi-squared, d = {dof}")


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
    from matplotlib.collections import LineCollection

    u, v = np.nonzero(np.triu(adjacency, 1))
    lit = inside[u] & inside[v]
    chords = places[np.stack([u, v], axis=-1)]
    ax.add_collection(LineCollection(list(chords[~lit]), colors=style.GREY, linewidths=0.7))
    ax.add_collection(
        LineCollection(list(chords[lit]), colors=style.BLUE, linewidths=1.3, zorder=2.0)
    )


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
    numbered = len(places) <= _NUMBERED_NODES
    for label, (rows, color, marker) in kinds.items():
        if rows.any():
            ax.scatter(
                *places[rows].T,
                s=70 if numbered else 28,
                c=color,
                marker=marker,
                edgecolors="black",
                linewidths=0.7,
                zorder=3.0,
                label=f"{label} ({rows.sum()})",
            )
    if numbered:
        for k, place in enumerate(places):
            beside = place * (1.0 + 0.09 / np.linalg.norm(place))
            ax.text(*beside, str(k), ha="center", va="center", fontsize="small", zorder=4.0)
