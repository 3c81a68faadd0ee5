"""A small version of the growth of time and memory."""

import json

import pytest

from benchmarks import growth
from benchmarks.suite import streaming


@pytest.fixture
def small(monkeypatch):
    """Sessions of 60 poses, in this process, so that it can see them."""
    for name, value in {"POSES": 60, "INLIERS": 10, "GROUP": 5}.items():
        monkeypatch.setattr(streaming, name, value)
    monkeypatch.setattr(growth, "_apart", growth.grown)


@pytest.mark.slow
def test_growth(small, tmp_path, capsys):
    arguments = ["--closures", "60", "40", "--out", str(tmp_path)]
    assert growth.main(arguments) == 0
    rows = json.loads((tmp_path / "summary.json").read_text())
    assert list(rows) == ["40", "60"]
    for count, row in rows.items():
        assert row["closures"] == int(count)
        assert row["optimal"]
        assert 9 <= row["clique"] <= 10
        assert row["edges"] >= row["clique"] * (row["clique"] - 1) // 2
        assert min(row["seconds"], row["memory"], row["clique_seconds"]) > 0
    assert "slope" not in rows["40"]
    assert set(rows["60"]) >= set(growth.COLUMNS)
    table = (tmp_path / "table.md").read_text()
    assert table in capsys.readouterr().out
    assert "| 60 |" in table
