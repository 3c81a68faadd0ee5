"""Pictures of pairwise consistency: the squared distances, the graph, and what gates do to it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pcm_jax.errors import InputError
from pcm_jax.evaluation import plot_style as style
from pcm_jax.evaluation.plot_style import axes_or_new, legend_below

# Orders of magnitude shown on either side of the gate; beyond them colours saturate.
_DECADES = 3.0
# Node numbers are readable up to about this many around the circle.
_NUMBERED_NODES = 48


def plot_squared_distances(
    squared: Float[Array, "m m"],
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

    values = np.array(squared, dtype=float)
    if values.ndim != 2 or values.shape[0] != values.shape[1]:
        raise InputError(f"squared: shape {values.shape} given, expected [m, m]")
    if not gate > 0:
        raise InputError(f"gate: {gate} given, expected a number above 0")
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
    inliers: Bool[np.ndarray, " m"] | None = None,
    ax: Any = None,
) -> Any:
    """Draws measurements on a circle and their consistent pairs as chords; a clique lights up.

    The clique's members stand on a circle of their own inside. Measurements keep their order,
    clockwise from the top.

    Args:
        graph: symmetric adjacency, as of `consistency_graph`.
        members: which measurements the clique contains.
        inliers: which measurements are true, where that is known.
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
    for argument, mask in {"members": members, "inliers": inliers}.items():
        if mask is not None and np.shape(mask) != (count,):
            raise InputError(f"{argument}: shape {np.shape(mask)} given, expected ({count},)")
    inside = np.zeros(count, bool) if members is None else np.asarray(members, dtype=bool)
    ax = axes_or_new(ax, (5.8, 5.8))
    places = np.empty((count, 2))
    places[~inside] = _circle(count - inside.sum())
    places[inside] = 0.5 * _circle(inside.sum())
    _draw_chords(ax, places, adjacency, inside)
    _draw_nodes(ax, places, inside, None if inliers is None else np.asarray(inliers, dtype=bool))
    ax.set_aspect("equal")
    ax.set_axis_off()
    legend_below(ax, columns=2, offset=-0.01)
    return ax


def plot_threshold_sweep(
    confidence: Float[np.ndarray, " t"],
    curves: Mapping[str, Any],
    *,
    ylabel: str,
    percent: bool = False,
    ax: Any = None,
) -> Any:
    """Draws how a figure of merit moves with the gate (the paper's Fig. 4), a line for each method.

    Args:
        confidence: probability mass inside the gate.
        curves: for each method its values `[t]`, or `[versions, t]`, drawn as the mean over
            versions with a band from the 10th to the 90th percentile.
        ylabel: what the values are, with their unit.
        percent: whether values are fractions to be written in percent.
        ax: matplotlib axes to draw into; None makes a figure.

    Returns:
        The axes.

    Raises:
        InputError: values of another number than the confidences.
    """
    ax = axes_or_new(ax, (5.8, 4.2))
    scale = 100.0 if percent else 1.0
    for k, (name, given) in enumerate(curves.items()):
        values = scale * np.atleast_2d(np.asarray(given, dtype=float))
        if values.shape[1] != len(confidence):
            raise InputError(
                f"curves[{name!r}]: shape {np.shape(given)} given, expected {len(confidence)} "
                "values, one per confidence"
            )
        color = style.SERIES[k % len(style.SERIES)]
        ax.plot(
            confidence,
            values.mean(axis=0),
            label=name,
            color=color,
            linestyle=style.DASHES[k % len(style.DASHES)],
            marker=style.MARKERS[k % len(style.MARKERS)],
            markersize=5,
        )
        if len(values) > 1:
            low, high = np.percentile(values, [10, 90], axis=0)
            ax.fill_between(confidence, low, high, color=color, alpha=0.15, linewidth=0)
    ax.set_xlabel("confidence: probability inside the gate")
    ax.set_ylabel(f"{ylabel} (%)" if percent else ylabel)
    ax.grid(alpha=0.3)
    legend_below(ax, offset=-0.2)
    return ax


def plot_set_size_histogram(
    sizes: Mapping[str, Int[np.ndarray, " w"]],
    *,
    reference: Int[np.ndarray, " w"] | None = None,
    ax: Any = None,
) -> Any:
    """Draws how large the sets are that methods find, in percent of the worlds (Figs 2 and 3).

    The scale is logarithmic: the worlds in which a heuristic falls short are few.

    Args:
        sizes: for each method the size of its set in each world.
        reference: the largest size in each world; the differences to it are drawn then.
        ax: matplotlib axes to draw into; None makes a figure.

    Returns:
        The axes.

    Raises:
        InputError: methods or reference with different numbers of worlds.
    """
    offset = 0 if reference is None else np.asarray(reference)
    counts = {name: np.asarray(values) - offset for name, values in _same_length(sizes, reference)}
    ax = axes_or_new(ax, (5.8, 4.2))
    low = min(int(values.min()) for values in counts.values())
    high = max(int(values.max()) for values in counts.values())
    bins = np.arange(low, high + 1)
    width = 0.8 / len(counts)
    for k, (name, values) in enumerate(counts.items()):
        share = 100.0 * np.bincount(values - low, minlength=len(bins)) / len(values)
        ax.bar(
            bins + (k - 0.5 * (len(counts) - 1)) * width,
            share,
            width,
            label=name,
            color=style.SERIES[k % len(style.SERIES)],
            hatch=style.HATCHES[k % len(style.HATCHES)],
            edgecolor="white",
        )
    shown = [patch.get_height() for patch in ax.patches if patch.get_height() > 0]
    ax.set_yscale("log")
    ax.set_ylim(bottom=0.5 * min(shown))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.xaxis.get_major_locator().set_params(integer=True)
    ax.set_xlabel("size of the set" if reference is None else "size of the set less the largest")
    ax.set_ylabel("worlds (%)")
    legend_below(ax, offset=-0.2)
    return ax


def _same_length(sizes: Mapping[str, Any], reference: Any) -> list[tuple[str, Any]]:
    lengths = {name: len(values) for name, values in sizes.items()}
    if reference is not None:
        lengths["reference"] = len(reference)
    if len(set(lengths.values())) != 1:
        raise InputError(f"sizes: {lengths} worlds given, expected the same number for all")
    return list(sizes.items())


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
