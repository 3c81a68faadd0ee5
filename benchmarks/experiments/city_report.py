"""The files that a run over City10000 leaves behind: Table I, Fig. 4 and Fig. 5."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.experiments.record import write_csv
from pcm_jax.evaluation import comparison_table
from pcm_jax.experiments import Compared, Method
from pcm_jax.experiments.comparison import REFERENCE
from pcm_jax.store import write_json

IN_THE_PAPER: dict[str, dict[str, float]] = {
    "dcs": {"tpr": 0.0, "fpr": 0.0, "translation_mse": 183_078.0},
    "scgp": {"tpr": 0.668, "fpr": 0.051, "translation_mse": 623.0},
    "ransac-1": {"tpr": 0.998, "fpr": 0.006, "translation_mse": 5.688},
    "ransac-3.5": {"tpr": 0.974, "fpr": 0.019, "translation_mse": 183.0},
    "pcm-exact-11": {"tpr": 0.997, "fpr": 0.001, "translation_mse": 0.276},
}
"""Of its Table I, as far as it is at hand; its PCM is named once."""

COLUMNS = {
    "tpr": "TPR",
    "paper tpr": "TPR, paper",
    "fpr": "FPR",
    "paper fpr": "FPR, paper",
    "translation_mse": "translation MSE, m²",
    "paper translation_mse": "translation MSE, paper",
    "ate_rmse": "ATE RMSE, m",
    "translation_mse_from_reference": "translation MSE from NO-OUT, m²",
    "ate_rmse_from_reference": "ATE RMSE from NO-OUT, m",
    "rotation_mse": "rotation MSE, rad",
    "rotation_mse_from_reference": "rotation MSE from NO-OUT, rad",
    "residual": "residual Σ rᵀΩr",
    "chi2": "normalised chi-squared",
    "converged": "converged",
    "seconds": "seconds",
}

PER_VERSION = (
    *("tpr", "fpr", "accepted", "aliased", "random", "translation_mse", "ate_rmse"),
    *("rotation_mse", "translation_mse_from_reference", "rotation_mse_from_reference"),
    *("residual", "chi2", "iterations", "converged", "seconds"),
)
"""Columns of versions.csv."""

GATES = np.array([0.01, *np.arange(1, 19) * 0.05, 0.99]).round(2)
"""The 20 confidences of Fig. 4."""
SWEPT = ("pcm-exact", "pcm-heuristic", "ransac")
SWEEP = {f"{name} {gate}": Method(name, float(gate)) for name in SWEPT for gate in GATES}
_PANELS = {"tpr": "TPR", "fpr": "FPR", "chi2": "normalised chi-squared"}

MAPS = {
    "NO-OUT": REFERENCE,
    "PCM 11 %": "pcm-exact-11",
    "RANSAC 3.5 %": "ransac-3.5",
    "SCGP": "scgp",
    "DCS": "dcs",
}
"""The panels of Fig. 5."""

_DPI, _COLORS = 110, 256

Run = Mapping[str, Any]


def table(summary: Mapping[str, Mapping[str, float]]) -> str:
    """Table I in Markdown, each of the paper's figures beside ours."""
    rows = {
        name: {**row, **{f"paper {k}": v for k, v in IN_THE_PAPER.get(name, {}).items()}}
        for name, row in summary.items()
    }
    known = {column for row in rows.values() for column in row}
    return comparison_table(rows, {k: v for k, v in COLUMNS.items() if k in known})


def version_rows(runs: Mapping[str, Run]) -> list[dict[str, Any]]:
    """For each version and method the columns of `PER_VERSION`, of six digits."""
    return [
        {"run": run, "method": method, **{name: f"{row[name]:.6g}" for name in PER_VERSION}}
        for run, result in runs.items()
        for method, row in result["methods"].items()
    ]


def start_rows(runs: Mapping[str, Run]) -> list[dict[str, Any]]:
    """For each version how far closures are from holding where DCS starts, and what it accepts."""
    return [
        {
            "run": name,
            **{f"{kind}_start_error": metres for kind, metres in run["start_errors"].items()},
            **{f"dcs_{kind}": run["methods"]["dcs"][kind] for kind in ("aliased", "random")},
        }
        for name, run in runs.items()
    ]


def sweep_of(results: Mapping[str, Compared]) -> dict[str, dict[str, list[float]]]:
    """For each method of Fig. 4 its figures at all gates."""
    return {
        name: {
            figure: [results[f"{name} {gate}"].figures[figure] for gate in GATES]
            for figure in _PANELS
        }
        for name in SWEPT
    }


def write_sweep(out: Path, runs: Sequence[Run]) -> None:
    """sweep.json (means), sweep.csv (means, 10th and 90th percentiles) and sweep.png: Fig. 4."""
    values = {
        name: {figure: np.array([run["sweep"][name][figure] for run in runs]) for figure in _PANELS}
        for name in SWEPT
    }
    means = {
        name: {figure: each.mean(axis=0).tolist() for figure, each in of_method.items()}
        for name, of_method in values.items()
    }
    write_json(out / "sweep.json", {"confidence": GATES.tolist(), "methods": means})
    rows = [
        {"method": name, "confidence": gate, **_spread(of_method, k)}
        for name, of_method in values.items()
        for k, gate in enumerate(GATES)
    ]
    write_csv(out / "sweep.csv", rows)
    _draw_sweep(out / "sweep.png", values)


def _spread(of_method: Mapping[str, np.ndarray], gate: int) -> dict[str, float]:
    return {
        f"{figure}{suffix}": float(value)
        for figure, each in of_method.items()
        for suffix, value in (
            ("", each[:, gate].mean()),
            ("_p10", np.percentile(each[:, gate], 10)),
            ("_p90", np.percentile(each[:, gate], 90)),
        )
    }


def _draw_sweep(path: Path, values: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    from pcm_jax.plots import plot_threshold_sweeps

    panels = {
        label: {name: of_method[figure] for name, of_method in values.items()}
        for figure, label in _PANELS.items()
    }
    axes = plot_threshold_sweeps(GATES, panels, percent=("TPR", "FPR"))
    axes[-1].set_yscale("log")
    _save(axes[0].figure, path)


def telling(runs: Mapping[str, Run]) -> str:
    """The run in which most of the methods of Fig. 5 accept different closures; the first such."""

    def differences(name: str) -> int:
        rows = runs[name]["methods"]
        return len({(rows[method]["tpr"], rows[method]["fpr"]) for method in MAPS.values()})

    return max(runs, key=differences)


def draw_maps(path: Path, closures: Any, is_true: Any, results: Mapping[str, Compared]) -> None:
    """Fig. 5: where each method leaves the two maps, and what it accepted."""
    from pcm_jax.plots import plot_comparison

    panels = {title: (results[name].maps, results[name].accepted) for title, name in MAPS.items()}
    _save(plot_comparison(panels, closures, is_true=is_true)[0].figure, path)


def _save(figure: Any, path: Path) -> None:
    """With a palette, since it is kept in the repository: one that has the rare colours too."""
    from matplotlib import pyplot
    from PIL import Image

    picture = io.BytesIO()
    figure.savefig(picture, dpi=_DPI)
    pyplot.close(figure)
    colors = {"colors": _COLORS, "method": Image.Quantize.MAXCOVERAGE}
    Image.open(picture).convert("RGB").quantize(**colors).save(path, optimize=True)
