"""Pictures that compare methods: against a threshold, against their size, and side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pcm_jax.errors import InputError
from pcm_jax.plots import style
from pcm_jax.plots.style import axes_or_new, legend_below

_CONFIDENCE = "confidence: probability inside the gate"
_SCORES = {"precision": (style.BLUE, "o", 0.12), "recall": (style.ORANGE, "s", -0.12)}
_GAVE_UP: dict[str, Any] = {
    "label": "gave up beyond",
    "color": style.BLACK,
    "linestyle": "",
    "marker": "x",
    "markersize": 13,
    "markeredgewidth": 1.6,
    "zorder": 4.0,
}


def plot_threshold_sweep(
    confidence: Float[np.ndarray, " t"],
    curves: Mapping[str, Any],
    *,
    ylabel: str,
    xlabel: str = _CONFIDENCE,
    percent: bool = False,
    legend: bool = True,
    ax: Any = None,
) -> Any:
    """Draws how a figure of merit moves with the gate (the paper's Fig. 4), a line for each method.

    Args:
        confidence: probability mass inside the gate; or any other quantity that grows, which
            `xlabel` names then.
        curves: for each method its values `[t]`, or `[versions, t]`, drawn as the mean over
            versions with a band from the 10th to the 90th percentile. A line breaks at NaN.
        ylabel: what the values are, with their unit.
        xlabel: what `confidence` is, with its unit.
        percent: whether values are fractions to be written in percent.
        legend: whether to add a legend.
        ax: matplotlib axes to draw into; None makes a figure.

    Returns:
        The axes.

    Raises:
        InputError: values of another number than the confidences.
    """
    ax = axes_or_new(ax, (5.8, 4.2))
    scale = 100.0 if percent else 1.0
    for k, (name, given) in enumerate(curves.items()):
        values = scale * _versions("curves", name, given, len(confidence))
        looks = style.series_style(k, len(curves))
        _draw_line(ax, confidence, values, values.mean(axis=0), label=name, **looks)
    ax.set_xlabel(xlabel)
    ax.set_ylabel(f"{ylabel} (%)" if percent else ylabel)
    ax.grid(alpha=0.3)
    if legend:
        legend_below(ax, offset=-0.2)
    return ax


def plot_threshold_sweeps(
    confidence: Float[np.ndarray, " t"],
    panels: Mapping[str, Mapping[str, Any]],
    *,
    xlabel: str = _CONFIDENCE,
    percent: Sequence[str] = (),
    axes: Sequence[Any] | None = None,
) -> list[Any]:
    """Draws several figures of merit above each other, over one axis and with one legend (Fig. 4).

    Args:
        confidence: as of `plot_threshold_sweep`.
        panels: for each figure of merit (with its unit) the curves of `plot_threshold_sweep`.
        xlabel: what `confidence` is, with its unit.
        percent: the panels whose values are fractions to be written in percent.
        axes: one matplotlib axes for each panel; None makes a figure.

    Returns:
        The axes, one for each panel.

    Raises:
        InputError: values of another number than the confidences.
    """
    chosen = _stacked(len(panels)) if axes is None else list(axes)
    for ax, (ylabel, curves) in zip(chosen, panels.items(), strict=True):
        plot_threshold_sweep(
            confidence,
            curves,
            ylabel=ylabel,
            xlabel=xlabel if ax is chosen[-1] else "",
            percent=ylabel in percent,
            legend=ax is chosen[-1],
            ax=ax,
        )
    return chosen


def plot_seconds(
    sizes: Int[np.ndarray, " t"],
    seconds: Mapping[str, Any],
    *,
    xlabel: str = "number of measurements",
    ax: Any = None,
) -> Any:
    """Draws how long methods take (the paper's Fig. 3), both axes logarithmic.

    Args:
        sizes: how much there was to do.
        seconds: for each method its times `[t]`, or `[repeats, t]`, drawn as the median with a band
            from the 10th to the 90th percentile. NaN where it gave up: the line stops before the
            first size at which any repeat did, in a cross.
        xlabel: what the sizes are.
        ax: matplotlib axes to draw into; None makes a figure.

    Returns:
        The axes.

    Raises:
        InputError: times of another number than the sizes.
    """
    ax, ends = axes_or_new(ax, (5.8, 4.6)), []
    for k, (name, given) in enumerate(seconds.items()):
        values = _versions("seconds", name, given, len(sizes))
        middle, looks = np.median(values, axis=0), style.series_style(k, len(seconds))
        _draw_line(ax, sizes, values, middle, label=name, **looks)
        unfinished = np.flatnonzero(np.isnan(middle))
        if len(unfinished) and unfinished[0] > 0:
            last = unfinished[0] - 1
            ends.append((sizes[last], middle[last]))
    if ends:
        ax.plot(*np.transpose(ends), **_GAVE_UP)
    ax.set_xscale("log")
    ax.set_yscale("log")
    _count_in_plain_numbers(ax)
    ax.set_xlabel(xlabel)
    ax.set_ylabel("time (s)")
    ax.grid(alpha=0.3)
    legend_below(ax, offset=-0.2)
    return ax


def _count_in_plain_numbers(ax: Any) -> None:
    """Ticks at 1, 2 and 5 of each decade, so that a short axis has some, without powers of ten."""
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    ax.xaxis.set_minor_locator(NullLocator())


def plot_precision_recall(scores: Mapping[str, Mapping[str, Any]], *, ax: Any = None) -> Any:
    """Draws the precision and the recall of each method, one row each, best at the right.

    Args:
        scores: for each method "precision" and "recall", fractions: a number, or one for each
            version `[versions]`, drawn as their mean with a line from the 10th to the 90th
            percentile. NaN, such as the precision where nothing was accepted, is not drawn.
        ax: matplotlib axes to draw into; None makes a figure.

    Returns:
        The axes; the first method is at the top.
    """
    ax = axes_or_new(ax, (5.8, 1.4 + 0.42 * len(scores)))
    rows = np.arange(len(scores))
    for kind, (color, marker, shift) in _SCORES.items():
        values = [100.0 * np.atleast_1d(np.asarray(row[kind], float)) for row in scores.values()]
        spread = np.array([np.percentile(each, [10, 90]) for each in values]).reshape(-1, 2)
        ax.hlines(rows - shift, *spread.T, color=color, linewidth=2.0, alpha=0.6)
        looks = {"facecolors": color if kind == "precision" else "white", "edgecolors": color}
        means = [each.mean() for each in values]
        ax.scatter(
            means,
            rows - shift,
            s=64,
            marker=marker,
            linewidths=2.0,
            zorder=3.0,
            label=kind,
            **looks,
        )
    ax.set_yticks(rows, list(scores))
    ax.set_ylim(len(scores) - 0.5, -0.5)
    ax.set_xlim(-3.0, 103.0)
    ax.set_xlabel("precision, recall (%)")
    ax.grid(alpha=0.3)
    # The rows' height does not depend on their number; the distance below must not either.
    legend_below(ax, offset=-0.55 / (0.3 + 0.42 * len(scores)))
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


def _versions(argument: str, name: str, given: Any, count: int) -> Float[np.ndarray, "v t"]:
    values = np.atleast_2d(np.asarray(given, dtype=float))
    if values.ndim != 2 or values.shape[1] != count:
        raise InputError(
            f"{argument}[{name!r}]: shape {np.shape(given)} given, expected {count} values, one "
            "for each place on the axis"
        )
    return values


def _draw_line(ax: Any, x: Any, values: Any, middle: Any, **looks: Any) -> None:
    """One method's line, and a band where there are several versions."""
    ax.plot(x, middle, **looks)
    if len(values) > 1:
        low, high = np.percentile(values, [10, 90], axis=0)
        ax.fill_between(x, low, high, color=looks["color"], alpha=0.15, linewidth=0)


def _stacked(count: int) -> list[Any]:
    from matplotlib import pyplot

    size = (5.8, 1.2 + 2.3 * count)
    figure = pyplot.figure(figsize=size, dpi=style.DPI, layout="constrained")
    return list(figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0])


def _same_length(sizes: Mapping[str, Any], reference: Any) -> list[tuple[str, Any]]:
    lengths = {name: len(values) for name, values in sizes.items()}
    if reference is not None:
        lengths["reference"] = len(reference)
    if len(set(lengths.values())) != 1:
        raise InputError(f"sizes: {lengths} worlds given, expected the same number for all")
    return list(sizes.items())
