"""A small version of Table I on a simulated city, and the portion of the real one."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from benchmarks import city
from benchmarks.experiments.cities import city_of_file
from pcm_jax import InputError, lie
from pcm_jax.evaluation.metrics import ate_rmse

CONTRACT = {"tpr", "fpr", "translation_mse", "rotation_mse", "chi2", "seconds"}


@pytest.fixture
def without_data(monkeypatch, tmp_path):
    monkeypatch.setattr(city, "CITY", tmp_path / "absent.g2o")
    monkeypatch.setattr(city, "_sources", list)  # edits during a test are no reason to start anew


def run(folder, *options):
    assert city.main(["--poses", "0:600", "--out", str(folder), *options]) == 0
    return json.loads((folder / "summary.json").read_text())


@pytest.mark.usefixtures("without_data")
def test_shape_of_the_table_and_resuming(tmp_path, monkeypatch):
    summary = run(tmp_path, "--versions", "2")
    assert set(summary) == set(city.METHODS)
    assert all(set(row) >= CONTRACT for row in summary.values())
    truth, everything = summary["no-outliers"], summary["everything"]
    assert (truth["tpr"], truth["fpr"]) == (1.0, 0.0)
    assert truth["translation_mse_from_reference"] < 1e-12
    assert (everything["tpr"], everything["fpr"]) == (1.0, 1.0)
    assert everything["translation_mse"] > 100 * truth["translation_mse"]
    assert everything["chi2"] > 100 * truth["chi2"]
    for name in ("pcm-exact-11", "pcm-heuristic-11"):
        assert summary[name]["tpr"] > 0.9
        assert summary[name]["fpr"] < 0.01
        assert summary[name]["translation_mse"] < 2.0 * truth["translation_mse"] + 0.1
    assert summary["dcs"]["tpr"] == 0.0
    with (tmp_path / "versions.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 2 * len(city.METHODS)

    def never(*_):
        raise RuntimeError("a version that is kept is not run again")

    monkeypatch.setattr(city, "run_version", never)
    assert run(tmp_path, "--versions", "2") == summary
    with pytest.raises(RuntimeError, match="is kept"):
        run(tmp_path, "--versions", "2", "--seeds", "1")


@pytest.mark.usefixtures("without_data")
def test_calibrated_information_wants_a_calibrated_gate(tmp_path):
    summary = run(tmp_path, "--versions", "1", "--information", "sqrt")
    assert summary["pcm-exact-99"]["tpr"] > 0.9
    assert summary["pcm-exact-99"]["fpr"] < 0.01
    assert summary["pcm-exact-11"]["tpr"] < 0.7
    assert 0.7 < summary["no-outliers"]["chi2"] < 1.3


def test_a_portion_of_the_real_city(shared_data):
    folder = shared_data / "city10000"
    files = folder / "city10000.g2o.xz", folder / "city10000_groundtruth.isam.txt.xz"
    portion = city_of_file(*files, slice(0, 2_000), "as-written")
    assert [one.num_poses for one in portion.graph.maps] == [1_000, 1_000]
    assert len(portion.graph.closures) == 353  # 354 edges cross the cut, one of them odometry
    for one, truth in zip(portion.graph.maps, portion.truth, strict=True):
        assert ate_rmse(one, truth, align="umeyama") < 1.0
        start = lie.parameters(lie.take(lie.as_numpy(one.poses), 0))
        np.testing.assert_allclose(start, [1.0, 0.0, 0.0, 0.0], atol=1e-12)
    closures = portion.graph.closures
    assert set(np.asarray(closures.robot_a)) | set(np.asarray(closures.robot_b)) == {0, 1}
    ends = [
        lie.take(lie.concatenate(portion.truth), 1_000 * np.asarray(robot) + np.asarray(pose))
        for robot, pose in (
            (closures.robot_a, closures.pose_a),
            (closures.robot_b, closures.pose_b),
        )
    ]
    error = lie.log(lie.between(lie.as_numpy(closures.measurement), lie.between(*ends)))
    np.testing.assert_allclose(error.std(axis=0), [0.02, 0.02, 0.01], rtol=0.1)


def test_a_portion_that_is_none(shared_data):
    folder = shared_data / "city10000"
    files = folder / "city10000.g2o.xz", folder / "city10000_groundtruth.isam.txt.xz"
    with pytest.raises(InputError, match="poses: 20:22 of 10000"):
        city_of_file(*files, slice(20, 22), "as-written")
