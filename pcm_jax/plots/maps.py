"""Pictures of maps and of the closures between them, projected on a plane that is named.

Maps in space are drawn on the two axes along which they extend furthest, unless another plane is
asked for. Closures by the hundred are drawn thinner, rejected ones fainter as well and below the
maps, so that thousands hide neither the maps nor those that were accepted.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
ABREAST = 3
"""Panels in a row; more are drawn two abreast, so that they can be read on a phone."""
PLAIN = 60
"""Closures of a kind that are drawn at full width."""
_THINNEST = 0.3
_SHORT = 18  # letters of a label, of which three fit a panel abreast
_MAPS = 2.0  # zorder of the first


def plot_trajectories_with_closures(
    maps: Sequence[Any],
    closures: Any = None,
    *,
    accepted: Mask | None = None,
    is_true: Mask | None = None,
    names: Sequence[str] | None = None,
    projection: str | None = None,
    legend: bool = True,
    ax: Any = None,
) -> Any:
    """Draws maps that share one frame, and the closures between them.

    Accepted closures are bold blue and rejected ones dotted grey; where the truth is known, false
    ones that were accepted are dashed red, and true ones that were rejected are pink (the paper's
    Fig. 5). Closures are short in a good map, so their ends are marked. Candidates of which none is
    chosen yet are thin grey lines, with the true ones pink where these are known.

    Args:
        maps: one `PoseGraph` or Lie `[n]` for each robot, in a common frame.
        closures: `LoopClosures` `[m]`; None draws the maps alone.
        accepted: which of them were accepted; None: candidates, before any choice.
        is_true: which of them are true, where that is known.
        names: the robots' names; by default the maps'.
        projection: the two axes drawn, "xy" (from above), "xz" or "yz"; None: of maps in space the
            two along which they extend furthest. The picture names them.
        legend: whether to add a legend.
        ax: matplotlib axes to draw into; None makes a figure.

    Returns:
        The axes.

    Raises:
        InputError: masks of another length than the closures, or an axis that maps do not have.
    """
    ax = axes_or_new(ax)
    kinds = {} if closures is None else closure_kinds(len(closures), accepted, is_true)
    _draw(ax, _Drawn.of(maps, names, projection), closures, kinds, legend=legend)
    return ax


@dataclass(frozen=True)
class _Drawn:
    """Maps as they are drawn: positions on the plane, names, and each robot's number of all."""

    places: list[Any]
    names: list[str]
    robots: list[int]
    total: int
    projection: str
    space: int

    @classmethod
    def of(cls, maps: Sequence[Any], names: Sequence[str] | None, projection: str | None) -> _Drawn:
        positions = [np.asarray(lie.translation(host_poses(poses))) for poses in maps]
        plane = projection or widest_plane(positions)
        places = [_projected(one, plane) for one in positions]
        space = positions[0].shape[-1] if positions else 2
        own = list(names or _names(maps))
        return cls(places, own, list(range(len(own))), len(own), plane, space)

    def among(self, robots: Sequence[int]) -> _Drawn:
        """Some of the robots, with the colours that they have among all."""
        places, names = ([each[k] for k in robots] for each in (self.places, self.names))
        return dataclasses.replace(self, places=places, names=names, robots=list(robots))


def widest_plane(positions: Sequence[Any]) -> str:
    """The plane in which maps extend furthest, such as "xy"; that from above among equal ones.

    Args:
        positions: `[n, s]` of each map, metres.
    """
    extents = np.max([np.ptp(one, axis=0) for one in positions], axis=0) if positions else []
    if len(extents) < 3:
        return "xy"
    least = 2 - int(np.argmin(extents[::-1]))
    return "xyz"[:least] + "xyz"[least + 1 :]


def _draw(
    ax: Any,
    drawn: _Drawn,
    closures: Any,
    kinds: Mapping[LineStyle, Mask],
    *,
    legend: bool = True,
) -> None:
    """Trajectories, closures by kind, the axes' labels, and of maps in space the plane."""
    for path, name, robot in zip(drawn.places, drawn.names, drawn.robots, strict=True):
        alone = {"marker": "o"} if len(path) == 1 else {}
        ax.plot(*path.T, label=f"robot {name}", **style.robot_style(robot, drawn.total), **alone)
    for kind, rows in kinds.items():
        _draw_closures(ax, drawn.places, closures, kind, rows)
    ax.set_aspect("equal", adjustable="datalim")
    across, up = drawn.projection
    ax.set_xlabel(f"{across} (m)")
    ax.set_ylabel(f"{up} (m)")
    if drawn.space == 3:
        (along,) = set("xyz") - {across, up}
        ax.set_title(f"plane {across}–{up}, seen along {along}", loc="right", fontsize="small")
    if legend:
        longest = max(map(len, ax.get_legend_handles_labels()[1]), default=0)
        legend_below(ax, columns=3 if longest <= _SHORT else 2)


def plot_merge(
    result: Any,
    ax: Any = None,
    *,
    is_true: Mask | None = None,
    projection: str | None = None,
) -> Any:
    """Draws the result of a merge: the maps of each group, and what became of each closure.

    Robots that no accepted closure connects share no frame, and so each group has a panel of its
    own, the largest first. A candidate between two groups is in none.

    Args:
        result: a `MergeResult`: `.graph`, `.candidates`, `.accepted` and `.groups`.
        ax: matplotlib axes to draw into, the largest group alone; None makes a figure.
        is_true: which closures are true, where that is known.
        projection: as for `plot_trajectories_with_closures`.

    Returns:
        The axes of the largest group; `.figure.axes` has all of them.
    """
    accepted = np.asarray(result.accepted, dtype=bool)
    title = f"{accepted.sum()} of {len(accepted)} closures accepted"
    groups = getattr(result, "groups", None) or (tuple(range(len(result.graph.maps))),)
    groups = sorted(groups, key=lambda group: (-len(group), group))
    panels = [axes_or_new(ax)] if ax is not None or len(groups) == 1 else _grid(len(groups))
    labels = None if is_true is None else as_mask(is_true, "is_true", len(accepted))
    drawn = _Drawn.of(result.graph.maps, None, projection)
    for panel, group in zip(panels, groups, strict=False):
        _draw_group(panel, drawn.among(group), result, group, accepted, labels)
    left_out = len(groups) - len(panels)
    if left_out:
        title += f"; {left_out} groups more, in frames of their own"
    if len(panels) > 1:
        panels[0].figure.suptitle(f"{title}: {len(groups)} groups, each in a frame of its own")
    else:
        panels[0].set_title(title, loc="left" if drawn.space == 3 else "center")
    return panels[0]


def _draw_group(
    ax: Any,
    drawn: _Drawn,
    result: Any,
    group: Sequence[int],
    accepted: Mask,
    is_true: Mask | None,
) -> None:
    """One group's maps and the closures among them."""
    closures = result.candidates
    place = np.full(drawn.total, -1)
    place[list(group)] = np.arange(len(group))
    ends = place[np.asarray(closures.robot_a)], place[np.asarray(closures.robot_b)]
    rows = np.flatnonzero((ends[0] >= 0) & (ends[1] >= 0))
    own = SimpleNamespace(
        robot_a=ends[0][rows],
        robot_b=ends[1][rows],
        pose_a=np.asarray(closures.pose_a)[rows],
        pose_b=np.asarray(closures.pose_b)[rows],
    )
    labels = None if is_true is None else is_true[rows]
    _draw(ax, drawn, own, closure_kinds(len(rows), accepted[rows], labels))
    ax.set_title(" + ".join(drawn.names), loc="left" if drawn.space == 3 else "center")


def _grid(count: int) -> list[Any]:
    """As many panels as groups, up to `MOST_PANELS`."""
    return _panels(min(count, MOST_PANELS), (5.2, 5.0), 0.4)


def _panels(count: int, size: tuple[float, float], more: float = 0.0) -> list[Any]:
    """Panels of a size in inches: up to `ABREAST` in one row, more of them two abreast."""
    from matplotlib import pyplot

    columns = count if count <= ABREAST else 2
    rows = -(-count // columns)
    inches = (size[0] * columns, size[1] * rows + more)
    figure = pyplot.figure(figsize=inches, dpi=style.DPI, layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for unused in panels[count:]:
        unused.remove()
    return panels[:count]


def plot_comparison(
    panels: Mapping[str, tuple[Sequence[Any], Mask | None]],
    closures: Any,
    *,
    is_true: Mask | None = None,
    names: Sequence[str] | None = None,
    projection: str | None = None,
    axes: Sequence[Any] | None = None,
) -> list[Any]:
    """Draws several versions of the same maps, to one scale and in one frame.

    Up to three stand side by side; more in rows of two, which a phone can show.

    Args:
        panels: for each title the maps (as for `plot_trajectories_with_closures`) and the mask of
            accepted closures, or None to draw no closures. All maps are laid over those of the
            first panel (`align="umeyama"`), best the truth, whose extent also sets the scale.
        closures: the `LoopClosures` that all panels share.
        is_true: which of them are true, where that is known; it is counted below the panels.
        names: the robots' names; by default the maps'.
        projection: as for `plot_trajectories_with_closures`, by default of the first panel's maps.
        axes: one matplotlib axes for each panel; None makes a figure.

    Returns:
        The axes, one for each panel.
    """
    chosen = _panels(len(panels), (3.2, 4.2), 1.0) if axes is None else list(axes)
    reference = list(next(iter(panels.values()))[0])
    places = [np.asarray(lie.translation(host_poses(poses))) for poses in reference]
    plane = projection or widest_plane(places)
    for ax, (title, (maps, accepted)) in zip(chosen, panels.items(), strict=True):
        plot_trajectories_with_closures(
            aligned(list(maps), reference, align="umeyama"),
            None if accepted is None else closures,
            accepted=accepted,
            is_true=is_true,
            names=names or _names(maps),
            projection=plane,
            legend=False,
            ax=ax,
        )
        ax.set_title(title, fontsize="x-large", fontweight="bold")
        ax.set_title("", loc="right")
        ax.set_xlabel("\n".join([ax.get_xlabel(), *_counts(accepted, is_true)]), linespacing=1.4)
    _same_view(chosen, [_projected(one, plane) for one in places])
    _shared_legend(chosen)
    return chosen


def closure_kinds(count: int, accepted: Mask | None, is_true: Mask | None) -> dict[LineStyle, Mask]:
    """Sorts closures by the way in which they are drawn; kinds without any are left out."""
    kinds: dict[LineStyle, Any]
    true = None if is_true is None else as_mask(is_true, "is_true", count)
    kept = None if accepted is None else as_mask(accepted, "accepted", count)
    if kept is None and true is None:
        kinds = {style.CANDIDATE: np.ones(count, bool)}
    elif kept is None:
        kinds = {style.CANDIDATE_FALSE: ~true, style.CANDIDATE_TRUE: true}  # type: ignore[operator]
    elif true is None:
        kinds = {style.REJECTED: ~kept, style.ACCEPTED: kept}
    else:
        kinds = {
            style.REJECTED_FALSE: ~kept & ~true,
            style.ACCEPTED_FALSE: kept & ~true,
            style.LOST: ~kept & true,
            style.ACCEPTED_TRUE: kept & true,
        }
    return {kind: rows for kind, rows in kinds.items() if rows.any()}


def _draw_closures(ax: Any, places: list[Any], closures: Any, kind: LineStyle, rows: Mask) -> None:
    """All closures of one kind as one broken line: ends apart by NaN."""
    sizes = np.array([len(path) for path in places], int)
    first: Any = np.cumsum(sizes) - sizes
    joined: Any = np.concatenate(places)
    ends = [
        joined[
            first[np.asarray(getattr(closures, f"robot_{end}"))[rows]]
            + np.asarray(getattr(closures, f"pose_{end}"))[rows]
        ]
        for end in "ab"
    ]
    broken = np.stack([*ends, np.full_like(ends[0], np.nan)], axis=1).reshape(-1, 2)
    size = max(style.thinned(int(rows.sum()), PLAIN), _THINNEST)
    ax.plot(
        *broken.T,
        label=f"{kind.label} ({rows.sum():,})",
        color=kind.color,
        linestyle=kind.linestyle,
        linewidth=kind.linewidth * size,
        marker=kind.marker,
        markersize=4.5 * size,
        alpha=size**0.5 if kind.zorder < _MAPS else 1.0,
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


def _counts(accepted: Mask | None, is_true: Mask | None) -> list[str]:
    """Says what was accepted, in one line or two."""
    if accepted is None:
        return []
    kept = np.asarray(accepted, dtype=bool)
    true = np.ones_like(kept) if is_true is None else np.asarray(is_true, dtype=bool)
    kinds = {"": true} if is_true is None else {"true ": true, "false ": ~true}
    return [f"{k}closures accepted: {(kept & r).sum():,} of {r.sum():,}" for k, r in kinds.items()]


def _same_view(axes: Sequence[Any], places: list[Any]) -> None:
    """One scale for all panels: what the reference takes, and a quarter of that around it."""
    points = np.concatenate(places)
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    half = 0.625 * np.ptp(points, axis=0).max()
    for ax in axes:
        ax.set_aspect("equal", adjustable="box")
        ax.set_xlim(center[0] - half, center[0] + half)
        ax.set_ylim(center[1] - half, center[1] + half)
    for ax in axes:
        place = ax.get_subplotspec()
        if place is None or not place.is_first_col():
            ax.set_ylabel("")
            ax.tick_params(labelleft=False)


def _shared_legend(axes: Sequence[Any]) -> None:
    """One legend below all panels, with the numbers of closures left to the panels."""
    entries = {}
    for ax in axes:
        for line in ax.get_lines():
            entries.setdefault(str(line.get_label()).split(" (")[0], line)
    figure = axes[0].figure
    legend = figure.legend(
        list(entries.values()), list(entries), loc="outside lower center", ncols=3, frameon=False
    )
    style.shown_plainly(legend)
