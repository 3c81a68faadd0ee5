"""Pictures of maps and of the closures between them, seen from above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from string import ascii_lowercase
from types import SimpleNamespace
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
MOST_PANELS = 12
"""Groups drawn; those with the most robots."""


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
    kinds = {} if closures is None else closure_kinds(len(closures), accepted, is_true)
    _draw(ax, maps, closures, kinds, names or _names(maps), projection, legend)
    return ax


def _draw(
    ax: Any,
    maps: Sequence[Any],
    closures: Any,
    kinds: Mapping[LineStyle, Mask],
    names: Sequence[str],
    projection: str = "xy",
    legend: bool = True,
) -> None:
    """Trajectories, closures by kind, and the axes' labels."""
    places = [_projected(lie.translation(host_poses(poses)), projection) for poses in maps]
    for k, (path, name) in enumerate(zip(places, names, strict=True)):
        alone = {"marker": "o"} if len(path) == 1 else {}
        ax.plot(*path.T, label=f"robot {name}", **style.robot_style(k, len(places)), **alone)
    for kind, rows in kinds.items():
        _draw_closures(ax, places, closures, kind, rows)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel(f"{projection[0]} (m)")
    ax.set_ylabel(f"{projection[1]} (m)")
    if legend:
        legend_below(ax)


def plot_merge(result: Any, ax: Any = None, *, is_true: Mask | None = None) -> Any:
    """Draws the result of a merge: the maps of each group, and what became of each closure.

    Robots that no accepted closure connects share no frame, and so each group has a panel of its
    own, the largest first. A candidate between two groups is in none.

    Args:
        result: a `MergeResult`: `.graph`, `.candidates`, `.accepted` and `.groups`.
        ax: matplotlib axes to draw into, the largest group alone; None makes a figure.
        is_true: which closures are true, where that is known.

    Returns:
        The axes of the largest group; `.figure.axes` has all of them.
    """
    accepted = np.asarray(result.accepted, dtype=bool)
    title = f"{accepted.sum()} of {len(accepted)} closures accepted"
    groups = getattr(result, "groups", None) or (tuple(range(len(result.graph.maps))),)
    groups = sorted(groups, key=lambda group: (-len(group), group))
    panels = [axes_or_new(ax)] if ax is not None or len(groups) == 1 else _grid(len(groups))
    labels = None if is_true is None else as_mask(is_true, "is_true", len(accepted))
    for panel, group in zip(panels, groups, strict=False):
        _draw_group(panel, result, group, accepted, labels)
    left_out = len(groups) - len(panels)
    if left_out:
        title += f"; {left_out} groups more, in frames of their own"
    if len(panels) > 1:
        panels[0].figure.suptitle(f"{title}: {len(groups)} groups, each in a frame of its own")
    else:
        panels[0].set_title(title)
    return panels[0]


def _draw_group(
    ax: Any, result: Any, group: Sequence[int], accepted: Mask, is_true: Mask | None
) -> None:
    """One group's maps and the closures among them."""
    maps, closures = result.graph.maps, result.candidates
    place = np.full(len(maps), -1)
    place[list(group)] = np.arange(len(group))
    ends = place[np.asarray(closures.robot_a)], place[np.asarray(closures.robot_b)]
    rows = np.flatnonzero((ends[0] >= 0) & (ends[1] >= 0))
    own = SimpleNamespace(
        robot_a=ends[0][rows],
        robot_b=ends[1][rows],
        pose_a=np.asarray(closures.pose_a)[rows],
        pose_b=np.asarray(closures.pose_b)[rows],
    )
    names = _names(maps)
    _draw(
        ax,
        [maps[robot] for robot in group],
        own,
        closure_kinds(len(rows), accepted[rows], None if is_true is None else is_true[rows]),
        [names[robot] for robot in group],
    )
    ax.set_title(" + ".join(names[robot] for robot in group))


def _grid(count: int) -> list[Any]:
    """As many panels as groups, up to `MOST_PANELS`, in rows of three."""
    from matplotlib import pyplot

    shown = min(count, MOST_PANELS)
    columns = min(shown, 3)
    rows = -(-shown // columns)
    size = (5.2 * columns, 5.0 * rows + 0.4)
    figure = pyplot.figure(figsize=size, dpi=style.DPI, layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for unused in panels[shown:]:
        unused.remove()
    return panels[:shown]


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
