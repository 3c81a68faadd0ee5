"""The study of the false closures' laws: a row for each, beside the paper's."""

from __future__ import annotations

import json

import pytest

from benchmarks import city, city_laws
from pcm_jax.experiments.cities import Law


@pytest.fixture
def few(monkeypatch, tmp_path):
    monkeypatch.setattr(city, "CITY", tmp_path / "absent.g2o")
    laws = {"plain": (Law(), 1.0), "loose": (Law(), 6.0), "fewer": (Law(random=5), 1.0)}
    methods = {name: city.PAPER[name] for name in ("ransac-3.5", "pcm-exact-11")}
    monkeypatch.setattr(city_laws, "STUDIES", {"laws": city_laws.Study(laws, methods)})


@pytest.mark.usefixtures("few")
def test_a_row_for_each_law(tmp_path):
    options = ["--poses", "0:400", "--versions", "1", "--information", "sqrt"]
    assert city_laws.main([*options, "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert list(summary) == ["plain", "loose", "fewer"]
    tight, loose = (summary[law]["pcm-exact-11"] for law in ("plain", "loose"))
    assert tight["tpr"] < loose["tpr"]  # covariances six times as large widen the gate
    lines = (tmp_path / "table.md").read_text().splitlines()
    assert lines[2].startswith("| the paper | 0.974 / 0.0190 / 183 |")
    assert [line.split(" | ")[0] for line in lines[3:6]] == ["| plain", "| loose", "| fewer"]
