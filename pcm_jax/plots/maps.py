"""Pictures of maps and of the closures between them, seen from above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from string import ascii_lowercase
from typing import Any

import numpy as np
from jaxtyping import Bool

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.evaluation.metrics import aligned, host_poses
from pcm_jax.graph.checked import as_mask
from pcm_jax.plots import style
from pcm_jax.plots.style import LineStyle, axes_or_new, legend_below

Mask = Bool[np.ndarray, " m"]


def plot_trajectories_with_closures(
    maps: Sequence[Any],
    closures: Any = None,
    *,
    accepted: Mask | None = None,
    is_true: Mask | None = None,
    names: Sequence[str] | None = None,
    projection: str = "xy",
    legend: bool = True,
    ax: Any = None,
) -> Any:
    """Draws maps that share one frame, and the closures between them.

    Accepted closures are bold blue and rejected ones dotted grey; where the truth is known, false
    ones that were accepted are dashed red, and true ones that were rejected are pink (the paper's
    Fig. 5). Closures are short in a good map, so their ends are marked.

    Args:
        maps: one `PoseGraph` or Lie `[n]` for each robot, in a common frame.
        closures: `LoopClosures` `[m]`; None draws the maps alone.
        accepted: which of them were accepted; None: all.
        is_true: which of them are true, where that is known.
        names: the robots' names; by default the maps'.
        projection: the two axes drawn, "xy" (from above), or "xz", "yz" for maps in space.
        legend: whether to add a legend.
        ax: matplotlib axes to draw into; None makes a figure.

    Returns:
        The axes.

    Raises:
        InputError: masks of another length than the closures, or an axis that maps do not have.
    """
    ax = axes_or_new(ax)
    places = [_projected(lie.translation(host_poses(poses)), projection) for poses in maps]
    for k, (path, name) in enumerate(zip(places, names or _names(maps), strict=True)):
        ax.plot(*path.T, label=f"robot {name}", **style.robot_style(k, len(places)))
    if closures is not None:
        for kind, rows in closure_kinds(len(closures), accepted, is_true).items():
            _draw_closures(ax, places, closures, kind, rows)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel(f"{projection[0]} (m)")
    ax.set_ylabel(f"{projection[1]} (m)")
    if legend:
        legend_below(ax)
    return ax


def plot_merge(result: Any, ax: Any = None, *, is_true: Mask | None = None) -> Any:
    """Draws the result of a merge: its maps in the common frame and what became of each closure.

    Args:
        result: a `MergeResult`: `.graph` (maps in a common frame), `.candidates` and `.accepted`.
        ax: matplotlib axes to draw into; None makes a figure.
        is_true: which closures are true, where that is known.
    """
    graph, accepted = result.graph, np.asarray(result.accepted, dtype=bool)
    ax = plot_trajectories_with_closures(
        graph.maps, result.candidates, accepted=accepted, is_true=is_true, ax=ax
    )
    ax.set_title(f"{accepted.sum()} of {len(accepted)} closures accepted")
    return ax


def plot_comparison(
    panels: Mapping[str, tuple[Sequence[Any], Mask | None]],
    closures: Any,
    *,
    is_true: Mask | None = None,
    names: Sequence[str] | None = None,
    axes: Sequence[Any] | None = None,
) -> list[Any]:
    """Draws several versions of the same maps side by side, to one scale and in one frame.

    Args:
        panels: for each title the maps (as for `plot_trajectories_with_closures`) and the mask of
            accepted closures, or None to draw no closures. All maps are laid over those of the
            first panel (`align="umeyama"`), best the truth, whose extent also sets the scale.
        closures: the `LoopClosures` that all panels share.
        is_true: which of them are true, where that is known; it is counted below the panels.
        names: the robots' names; by default the maps'.
        axes: one matplotlib axes for each panel; None makes a figure.

    Returns:
        The axes, one for each panel.
    """
    chosen = _new_panels(len(panels)) if axes is None else list(axes)
    reference = list(next(iter(panels.values()))[0])
    for ax, (title, (maps, accepted)) in zip(chosen, panels.items(), strict=True):
        plot_trajectories_with_closures(
            aligned(list(maps), reference, align="umeyama"),
            None if accepted is None else closures,
            accepted=accepted,
            is_true=is_true,
            names=names or _names(maps),
            legend=False,
            ax=ax,
        )
        ax.set_title(title, fontsize="x-large", fontweight="bold")
        ax.set_xlabel("\n".join([ax.get_xlabel(), *_counts(accepted, is_true)]), linespacing=1.4)
    _same_view(chosen, [lie.translation(host_poses(poses)) for poses in reference])
    _shared_legend(chosen)
    return chosen


def closure_kinds(count: int, accepted: Mask | None, is_true: Mask | None) -> dict[LineStyle, Mask]:
    """Sorts closures by the way in which they are drawn; kinds without any are left out."""
    kept = np.ones(count, bool) if accepted is None else as_mask(accepted, "accepted", count)
    if is_true is None:
        kinds = {style.REJECTED: ~kept, style.ACCEPTED: kept}
    else:
        true = as_mask(is_true, "is_true", count)
        kinds = {
            style.REJECTED_FALSE: ~kept & ~true,
            style.ACCEPTED_FALSE: kept & ~true,
            style.LOST: ~kept & true,
            style.ACCEPTED_TRUE: kept & true,
        }
    return {kind: rows for kind, rows in kinds.items() if rows.any()}


def _draw_closures(ax: Any, places: list[Any], closures: Any, kind: LineStyle, rows: Mask) -> None:
    """All closures of one kind as one broken line: ends apart by NaN."""
    ends = [
        np.stack(
            [
                places[robot][pose]
                for robot, pose in zip(
                    np.asarray(getattr(closures, f"robot_{end}"))[rows],
                    np.asarray(getattr(closures, f"pose_{end}"))[rows],
                    strict=True,
                )
            ]
        )
        for end in "ab"
    ]
    broken = np.stack([*ends, np.full_like(ends[0], np.nan)], axis=1).reshape(-1, 2)
    ax.plot(
        *broken.T,
        label=f"{kind.label} ({rows.sum()})",
        color=kind.color,
        linestyle=kind.linestyle,
        linewidth=kind.linewidth,
        marker=kind.marker,
        markersize=4.5,
        zorder=kind.zorder,
    )


def _names(maps: Sequence[Any]) -> list[str]:
    return [getattr(graph, "name", "") or ascii_lowercase[k % 26] for k, graph in enumerate(maps)]


def _projected(places: Any, projection: str) -> Any:
    columns = ["xyz"[: places.shape[-1]].find(axis) for axis in projection]
    if len(columns) != 2 or min(columns) < 0:
        raise InputError(
            f"projection: {projection!r} given, expected two of the axes "
            f"{'xyz'[: places.shape[-1]]}"
        )
    return places[:, columns]


def _new_panels(count: int) -> list[Any]:
    from matplotlib import pyplot

    figure = pyplot.figure(figsize=(3.2 * count, 5.0), dpi=style.DPI, layout="constrained")
    return list(figure.subplots(1, count, squeeze=False)[0])


def _counts(accepted: Mask | None, is_true: Mask | None) -> list[str]:
    """Says what was accepted, in one line or two."""
    if accepted is None:
        return []
    kept = np.asarray(accepted, dtype=bool)
    true = np.ones_like(kept) if is_true is None else np.asarray(is_true, dtype=bool)
    kinds = {"": true} if is_true is None else {"true ": true, "false ": ~true}
    return [f"{k}closures accepted: {(kept & r).sum()} of {r.sum()}" for k, r in kinds.items()]


def _same_view(axes: Sequence[Any], places: list[Any]) -> None:
    """One scale for all panels: what the reference takes, and a quarter of that around it."""
    points = np.concatenate(places)[:, :2]
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    half = 0.625 * np.ptp(points, axis=0).max()
    for ax in axes:
        ax.set_aspect("equal", adjustable="box")
        ax.set_xlim(center[0] - half, center[0] + half)
        ax.set_ylim(center[1] - half, center[1] + half)
    for ax in axes[1:]:
        ax.set_ylabel("")
        ax.tick_params(labelleft=False)


def _shared_legend(axes: Sequence[Any]) -> None:
    """One legend below all panels, with the numbers of closures left to the titles."""
    entries = {}
    for ax in axes:
        for line in ax.get_lines():
            entries.setdefault(str(line.get_label()).split(" (")[0], line)
    figure = axes[0].figure
    figure.legend(
        list(entries.values()), list(entries), loc="outside lower center", ncols=3, frameon=False
    )
