"""Table I in `benchmarks/report.md`, between two markers, from the committed results.

python -m benchmarks.experiments.table_one
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from benchmarks.experiments.city_report import IN_THE_PAPER
from benchmarks.suite.harness import ROOT
from benchmarks.suite.report import with_block
from pcm_jax.evaluation import comparison_table

REPORT = ROOT / "benchmarks" / "report.md"
RESULTS = ROOT / "benchmarks" / "results"
MARKERS = "<!-- Table I: generated, do not edit -->", "<!-- end of Table I -->"

LITERAL = {
    "NO-OUT (true closures only)": "no-outliers",
    "DCS": "dcs",
    "SCGP": "scgp",
    "RANSAC 1 %": "ransac-1",
    "RANSAC 3.5 %": "ransac-3.5",
    "PCM-Exact 11 %": "pcm-exact-11",
    "PCM-HeuPatt 11 %": "pcm-heuristic-11",
}
CALIBRATED = {
    "PCM-Exact 11 %, calibrated": "pcm-exact-11",
    "PCM-Exact 99 %, calibrated": "pcm-exact-99",
}
FIGURES = {
    "tpr": "TPR",
    "fpr": "FPR",
    "translation_mse": "translation MSE, m²",
    "ate_rmse": "ATE RMSE, m",
    "chi2": "normalised χ²",
}
"""The first three stand beside the paper's."""


def block(results: Path = RESULTS) -> str:
    """The text between the markers."""
    literal, calibrated = (
        json.loads((results / name / "summary.json").read_text()) for name in ("city", "city-sqrt")
    )
    rows = {label: _row(literal[name], name) for label, name in LITERAL.items()}
    rows |= {label: _row(calibrated[name]) for label, name in CALIBRATED.items()}
    columns = {}
    for figure, heading in FIGURES.items():
        columns[figure] = heading
        if figure in IN_THE_PAPER["dcs"]:
            columns[f"paper {figure}"] = "paper"
    return comparison_table(rows, columns)


def _row(ours: Mapping[str, float], paper: str = "") -> dict[str, float]:
    theirs = IN_THE_PAPER.get(paper, {})
    return {name: ours[name] for name in FIGURES} | {f"paper {k}": v for k, v in theirs.items()}


if __name__ == "__main__":
    REPORT.write_text(with_block(REPORT.read_text(), MARKERS, block()))
