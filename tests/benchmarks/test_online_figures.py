"""A small version of the figures of the online form."""

import json

import pytest

from benchmarks import online


@pytest.fixture
def here(monkeypatch):
    """In this process, so that its programs are the tests' own."""
    monkeypatch.setattr(online, "_apart", online.measured)


@pytest.mark.slow
def test_online(here, tmp_path, capsys):
    size = ["--closures", "60", "--right", "12", "--poses", "60"]
    assert online.main([*size, "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "summary.json").read_text())["0"]
    assert found["answers that are equal"]["value"] == 1
    assert found["its cost, relative difference"]["value"] < 1e-6
    assert found["closures accepted"]["value"] > 5
    mean, high, longest = (
        found[f"addition, {name}, ms"]["value"] for name in ("mean", "99th percentile", "longest")
    )
    assert 0.0 < mean <= high <= longest
    table = (tmp_path / "table.md").read_text()
    assert table in capsys.readouterr().out
    assert "a pose of odometry, median, ms" in table
