"""`python -m benchmarks.integrity`, on few and small worlds."""

import json

import numpy as np
import pytest
from scipy import stats

from benchmarks import integrity
from pcm_jax import select

OPTIONS = ["--worlds", "3", "--groups", "SE2", "--closures", "12", "--laws", "uniform", "identity"]


def test_table_and_resuming(tmp_path, capsys, monkeypatch):
    arguments = [*OPTIONS, "--right", "0", "6", "--drifts", "1", "--loops", "odometry"]
    assert integrity.main([*arguments, "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert list(summary) == [
        f"SE2, {right} of 12 right, {law}, drift 1, odometry"
        for right in (0, 6)
        for law in ("uniform", "identity")
    ]
    met = summary["SE2, 6 of 12 right, uniform, drift 1, odometry"]
    assert list(met) == ["2", "3", "5", "chance", "places", "default"]
    assert met["default"]["right"] == met["3"]["right"] == 100.0
    assert summary["SE2, 0 of 12 right, uniform, drift 1, odometry"]["default"]["right"] == 0.0
    table = (tmp_path / "table.md").read_text()
    assert table.count("\n") == 2 + 4 * 6
    assert table.strip() in capsys.readouterr().out
    assert (tmp_path / "cells.csv").read_text().count("\n") == 1 + 4 * 6
    assert (tmp_path / "rates.png").read_bytes().startswith(b"\x89PNG")
    monkeypatch.setattr(integrity, "world_of", None)  # nothing is drawn again
    assert integrity.main([*arguments, "--out", str(tmp_path)]) == 0


def test_candidates_are_as_the_law_says():
    for law, right in (("uniform", 0), ("near", 3), ("identity", 3)):
        cell = integrity.Cell("SE3", 20, right, 4, "spread", law, 1.0, "odometry")
        graph, is_true = integrity.world_of(cell, (0, 1))
        assert len(graph.closures) == 20
        assert is_true.sum() == right
        assert all(one.num_edges == one.num_poses - 1 for one in graph.maps)
        far = np.linalg.norm(graph.closures.measurement.translation(), axis=1)
        if law == "identity":
            assert np.sum(far < 1.0) >= 20 - right - 4


def test_an_aliased_group_in_one_place_agrees_there():
    for group in ("SE2", "SE3"):
        cell = integrity.Cell(group, 30, 0, 5, "one place", "uniform", 1.0, "odometry")
        graph, _ = integrity.world_of(cell, (0, 2))
        accepted = select(graph, minimum_inliers=5).accepted
        assert accepted.sum() == 5
        for poses in (graph.closures.pose_a, graph.closures.pose_b):
            there = np.asarray(poses)[accepted]
            assert len(set(there)) == 5
            assert np.ptp(there) < integrity.STRETCH


def test_bounds_are_clopper_and_pearsons():
    outcomes = np.zeros((300, 3))
    outcomes[:3, 0] = 1.0
    found = integrity.rates(outcomes)
    assert found["wrong"] == pytest.approx(1.0)
    exact = stats.binomtest(3, 300).proportion_ci(0.98, method="exact").high
    assert found["wrong_bound"] == pytest.approx(100 * exact)
