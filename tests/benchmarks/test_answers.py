"""`python -m benchmarks.answers`, on few worlds."""

import json

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks import answers

OPTIONS = ["--worlds", "4", "--groups", "SE2", "--drifts", "1", "64"]


@pytest.mark.slow
def test_table_and_resuming(tmp_path, capsys, monkeypatch):
    assert answers.main([*OPTIONS, "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert list(summary) == ["SE2, drift 1", "SE2, drift 64"]
    still, wild = summary.values()
    assert still["low"] == pytest.approx(chi2.ppf(0.005, 12) / 12)
    assert still["low"] < still["anchor"] < still["high"]
    assert still["anchor"] == pytest.approx(still["middle"])  # the same error, elsewhere
    assert (still["warned"], wild["warned"]) == (0.0, 100.0)
    assert wild["heading"] > 10.0 * still["heading"]
    assert (tmp_path / "table.md").read_text().strip() in capsys.readouterr().out
    monkeypatch.setattr(answers, "world_of", None)  # nothing is drawn again
    assert answers.main([*OPTIONS, "--out", str(tmp_path)]) == 0


def test_an_error_of_one_deviation():
    assert answers._squared(np.array([2.0, 0.0]), np.diag([4.0, 1.0])) == pytest.approx(1.0)
