"""Pooled figures, tables and pictures, as `benchmarks.place_recognition` writes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from benchmarks.experiments.record import write_csv
from pcm_jax import LoopClosures, lie
from pcm_jax.evaluation import aligned, comparison_table
from pcm_jax.experiments.comparison import REFERENCE
from pcm_jax.store import write_json

FIGURES = ("precision", "recall", "fpr", "merged", "ate_rmse", "chi2", "accepted", "seconds")
SHOWN = ("scgp", "ransac-3.5", "ransac-99", "pcm-exact-11", "pcm-exact-99", "clipper", "gnc")

Runs = Mapping[str, Mapping[str, Any]]


class Picture(NamedTuple):
    """Maps of one data set to draw.

    Attributes:
        trajectories: Lie `[n]` by title, the truth first.
        ends: the poses that candidates join.
        accepted, right: which candidates inside the one map are accepted by the last title; true.
        sessions: two robots' maps and the closures that made them, by title, the truth first.
        closures: between the two robots.
        right_across: which of those are true.
        cut: the pose at which the second session starts.
    """

    trajectories: Mapping[str, Any]
    ends: Int[np.ndarray, "2 m"]
    accepted: Bool[np.ndarray, " m"]
    right: Bool[np.ndarray, " m"]
    sessions: Mapping[str, tuple[Sequence[Any], Any]]
    closures: LoopClosures
    right_across: Bool[np.ndarray, " c"]
    cut: int


def write_results(out: Path, trajectories: Runs, versions: Runs) -> None:
    """All files but pictures and run.json.

    Args:
        out: the folder.
        trajectories: results of one robot by data set.
        versions: results of two robots by version.
    """
    summary = summarised(trajectories, versions)
    noise = {name: run["noise"] | {"labels": run["labels"]} for name, run in trajectories.items()}
    rows = [
        {"run": run, "arm": arm, "method": row, **figures}
        for run, result in versions.items()
        for arm, methods in result["arms"].items()
        for row, figures in methods.items()
    ]
    write_json(out / "summary.json", summary)
    write_json(out / "noise.json", noise)
    write_csv(out / "sets.csv", [_set_row(run, each) for run, each in versions.items()])
    if rows:
        write_csv(out / "versions.csv", rows)
        write_csv(out / "sweep.csv", sweep_rows(versions))
    (out / "table.md").write_text(_tables(summary))


def summarised(trajectories: Runs, versions: Runs) -> dict[str, dict[str, Any]]:
    """{data set/arm: {method: figures}}; data sets without any version have one robot's only."""
    summary = {}
    for name, trajectory in trajectories.items():
        methods = trajectory["methods"]
        summary[f"{name}/one-robot"] = {row: pooled([each]) for row, each in methods.items()}
        runs = _of_data(versions, name)
        for arm in runs[0]["arms"] if runs else ():
            summary[f"{name}/{arm}"] = {
                row: pooled([run["arms"][arm][row] for run in runs]) for row in runs[0]["arms"][arm]
            }
    return summary


def is_version(run: Mapping[str, Any], name: str) -> bool:
    """Says whether a run is one of this data set, with right candidates across the cut."""
    return run["data"] == name and bool(run["arms"])


def pooled(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Rates over all versions together, means of the rest over those that have it."""
    total = {
        name: sum(run[name] for run in runs)
        for name in ("candidates", "right", "accepted", "accepted_right")
    }
    false = total["candidates"] - total["right"]
    wrong = total["accepted"] - total["accepted_right"]
    return {
        "precision": _share(total["accepted_right"], total["accepted"]),
        "recall": _share(total["accepted_right"], total["right"]),
        "fpr": _share(wrong, false),
        "merged": float(np.mean([run["accepted"] > 0 for run in runs])),
        **{name: _mean(runs, name) for name in ("ate_rmse", "chi2", "converged", "seconds")},
        **total,
        "versions": len(runs),
    }


def sweep_rows(versions: Runs) -> list[dict[str, Any]]:
    """Pooled rates of each data set and method by the factor on all covariances."""
    rows = []
    for name in dict.fromkeys(run["data"] for run in versions.values()):
        runs = _of_data(versions, name)
        for method in runs[0]["sweep"] if runs else ():
            counts = np.array([run["sweep"][method] for run in runs])
            right = sum(run["right"] for run in runs)
            for factor, accepted, true in zip(
                counts[0, :, 0], *counts[..., 1:].sum(axis=0).T, strict=True
            ):
                rates = {"precision": _share(true, accepted), "recall": _share(true, right)}
                rows.append({"data": name, "method": method, "factor": float(factor), **rates})
    return rows


def write_figures(out: Path, versions: Runs, pictures: Mapping[str, Picture]) -> None:
    """Maps, precision and recall, and the sweep of each data set in `pictures`."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    for name, drawn in pictures.items():
        figures = {
            "one-robot": _draw_one_robot(drawn),
            "two-robots": _draw_two_robots(drawn),
            "precision-recall": _draw_rates(_of_data(versions, name)),
            "sweep": _draw_sweep([row for row in sweep_rows(versions) if row["data"] == name]),
        }
        for kind, figure in figures.items():
            figure.savefig(out / f"{name}-{kind}.png", dpi=100)
            pyplot.close(figure)


def _draw_one_robot(drawn: Picture) -> Any:
    """The trajectory in four versions, each laid over the truth; candidates in the last."""
    from matplotlib import pyplot

    from pcm_jax.plots import style

    figure = pyplot.figure(figsize=(12.0, 3.7), layout="constrained")
    axes = figure.subplots(1, len(drawn.trajectories))
    true = drawn.trajectories["truth"]
    place = lie.translation(true)
    center, half = 0.5 * (place.min(axis=0) + place.max(axis=0)), 0.6 * np.ptp(place, axis=0).max()
    for ax, (title, poses) in zip(axes, drawn.trajectories.items(), strict=True):
        (moved,) = aligned(poses, true, align="umeyama")
        ax.plot(*place.T, color=style.GREY, linewidth=2.4, label="truth")
        if title != "truth":
            ax.plot(*lie.translation(moved).T, color=style.BLACK, linewidth=1.0, label="estimate")
        if title == "select_within":
            _draw_candidates(ax, lie.translation(moved), drawn)
        ax.set(title=title, xlabel="x (m)", aspect="equal")
        ax.set_xlim(center[0] - half, center[0] + half)
        ax.set_ylim(center[1] - half, center[1] + half)
    axes[0].set_ylabel("y (m)")
    entries = dict(
        zip(*(side[::-1] for side in axes[-1].get_legend_handles_labels()[::-1]), strict=True)
    )
    figure.legend(
        list(entries.values())[::-1],
        list(entries)[::-1],
        loc="outside lower center",
        ncols=6,
        frameon=False,
    )
    return figure


def _draw_candidates(ax: Any, place: np.ndarray, drawn: Picture) -> None:
    from pcm_jax.plots.maps import closure_kinds

    for kind, rows in closure_kinds(len(drawn.right), drawn.accepted, drawn.right).items():
        ends = place[drawn.ends[:, rows]]
        broken = np.concatenate([ends, np.full_like(ends[:1], np.nan)]).swapaxes(0, 1)
        looks = {"color": kind.color, "linestyle": kind.linestyle, "linewidth": kind.linewidth}
        looks |= {"marker": kind.marker, "markersize": 3.5, "zorder": kind.zorder}
        ax.plot(*broken.reshape(-1, 2).T, label=f"{kind.label} ({rows.sum()})", **looks)


def _draw_two_robots(drawn: Picture) -> Any:
    from pcm_jax.plots import plot_comparison

    axes = plot_comparison(drawn.sessions, drawn.closures, is_true=drawn.right_across)
    return axes[0].figure


def _draw_rates(runs: Sequence[Mapping[str, Any]]) -> Any:
    from pcm_jax.plots import plot_precision_recall

    rows = {"two-robots": SHOWN, "two-robots-cleaned": ("pcm-exact-99", "ransac-99")}
    scores = {}
    for arm, methods in rows.items():
        for method in [each for each in methods if each in runs[0]["arms"][arm]]:
            label = method if arm == "two-robots" else f"{method}, maps cleaned"
            each = [run["arms"][arm][method] for run in runs]
            scores[label] = {
                "precision": _rates(each, "accepted_right", "accepted"),
                "recall": _rates(each, "accepted_right", "right"),
            }
    return plot_precision_recall(scores).figure


def _draw_sweep(rows: Sequence[Mapping[str, Any]]) -> Any:
    from pcm_jax.plots import plot_threshold_sweeps

    methods = dict.fromkeys(row["method"] for row in rows)
    factors = np.unique([row["factor"] for row in rows])
    panels = {
        rate: {
            method: [_number(row[rate]) for row in rows if row["method"] == method]
            for method in methods
        }
        for rate in ("precision", "recall")
    }
    xlabel = "factor on all covariances, confidence 99 %"
    axes = plot_threshold_sweeps(factors, panels, xlabel=xlabel, percent=("precision", "recall"))
    for ax in axes:
        ax.set_xscale("log")
        ax.set_ylim(-3.0, 103.0)
        ax.axvline(1.0, color="black", linewidth=0.8, linestyle=":")
    return axes[0].figure


def _tables(summary: Mapping[str, Mapping[str, Any]]) -> str:
    parts = []
    best = {"precision": max, "recall": max, "ate_rmse": min}
    for name, rows in summary.items():
        table = comparison_table(rows, FIGURES, best=best, reference=REFERENCE)
        one = next(iter(rows.values()))
        head = f"{one['candidates']} candidates, {one['right']} right, {one['versions']} versions"
        parts.append(f"## {name}\n\n{head}\n\n{table}\n")
    return "\n".join(parts)


def _of_data(versions: Runs, name: str) -> list[Mapping[str, Any]]:
    return [run for run in versions.values() if is_version(run, name)]


def _set_row(run: str, result: Mapping[str, Any]) -> dict[str, Any]:
    names = ("data", "cut", "candidates", "right", "largest_right_set", "largest_false_set")
    return {"run": run, **{name: result.get(name) for name in names}}


def _rates(runs: Sequence[Mapping[str, Any]], part: str, whole: str) -> list[float]:
    return [_number(_share(run[part], run[whole])) for run in runs if run[whole]] or [np.nan]


def _share(part: float, whole: float) -> float | None:
    return float(part) / float(whole) if whole else None


def _number(value: float | None) -> float:
    return np.nan if value is None else value


def _mean(runs: Sequence[Mapping[str, Any]], name: str) -> float | None:
    values = [run[name] for run in runs if run[name] is not None]
    return float(np.mean(values)) if values else None
