"""A small version of the race with robust back ends."""

import csv
import json

import numpy as np
import pytest

from benchmarks import online_race
from pcm_jax.files import write_g2o
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.simulation import simulate_city


@pytest.fixture
def data(tmp_path, monkeypatch):
    one = simulate_city(seed=3, poses=150).graph.maps[0]
    write_g2o(tmp_path / "town.g2o", MultiRobotGraph((one,)))
    monkeypatch.setattr(online_race, "GRAPHS", {"town": "town.g2o"})
    online_race.load.cache_clear()
    return tmp_path


@pytest.mark.slow
def test_race(data, tmp_path, capsys):
    out = tmp_path / "out"
    given = ["--data", str(data), "--shares", "0.5", "--laws", "random", "grouped"]
    assert online_race.main([*given, "--out", str(out)]) == 0
    found = json.loads((out / "summary.json").read_text())
    assert set(found) == {"town, 50% false", "random", "grouped", "in the plane"}
    rows = list(csv.DictReader((out / "runs.csv").read_text().splitlines()))
    assert [row["law"] for row in rows] == ["random", "grouped"]
    whole = found["in the plane"]
    assert whole["runs"] == 2 and whole["recall"] > 90.0 and whole["precision"] > 90.0
    assert whole["success"] == 100.0 and whole["ate"] < 0.5 and whole["milliseconds"] > 0.0
    table = (out / "table.md").read_text()
    assert table in capsys.readouterr().out and "TACO, in space, as published" in table
    assert (out / "rates.png").stat().st_size > 5000


def test_means_weigh_closures_and_not_runs():
    run = {"success": 1.0, "milliseconds": 1.0, "high": 2.0, "answer": 0.1, "proven": 1.0}
    few = run | {"right": 10, "accepted": 5, "accepted_right": 5, "ate": 0.1}
    many = run | {"right": 90, "accepted": 95, "accepted_right": 85, "ate": 0.3, "success": 0.0}
    found = online_race._means([few, many])
    assert (found["precision"], found["recall"], found["success"]) == (90.0, 90.0, 50.0)
    np.testing.assert_allclose(found["ate"], 0.2)


def test_a_closure_stated_again_counts_where_it_came_first():
    np.testing.assert_array_equal(online_race._firsts(np.array([0, 1, 0, 2, 1, 3])), [0, 1, 3, 5])
