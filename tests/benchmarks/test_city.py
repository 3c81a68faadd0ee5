"""A small version of Table I on a simulated city, and the portion of the real one."""

from __future__ import annotations

import csv
import json
from functools import partial

import numpy as np
import pytest

from benchmarks import city
from benchmarks.experiments import city_report, table_one
from benchmarks.experiments.command import run_tasks
from pcm_jax import InputError, MultiRobotGraph, lie, merge, select
from pcm_jax.evaluation.metrics import ate_rmse
from pcm_jax.experiments.cities import (
    Law,
    city_of_file,
    simulated_city,
    start_errors,
    version_of,
    weakened,
)
from pcm_jax.store import Store, digest

pytestmark = pytest.mark.slow


CONTRACT = {"tpr", "fpr", "translation_mse", "rotation_mse", "chi2", "seconds"}


@pytest.fixture
def without_data(monkeypatch, tmp_path):
    monkeypatch.setattr(city, "CITY", tmp_path / "absent.g2o")
    monkeypatch.setattr(city, "sources", list)  # edits during a test are no reason to start anew


def run(folder, *options):
    assert city.main(["--poses", "0:400", "--out", str(folder), *options]) == 0
    return json.loads((folder / "summary.json").read_text())


@pytest.mark.usefixtures("without_data")
def test_table_maps_and_resuming(tmp_path, monkeypatch):
    options = ["--rows", "paper", "--no-sweep", "--versions", "2"]
    summary = run(tmp_path, *options)
    assert list(summary) == list(city.PAPER)
    assert all(set(row) >= CONTRACT for row in summary.values())
    truth = summary["no-outliers"]
    assert (truth["tpr"], truth["fpr"], truth["aliased"], truth["random"]) == (1.0, 0.0, 0.0, 0.0)
    assert truth["translation_mse_from_reference"] < 1e-12
    for name in ("pcm-exact-11", "pcm-heuristic-11"):
        assert summary[name]["tpr"] > 0.9
        assert summary[name]["fpr"] < 0.03
    assert summary["dcs"]["tpr"] == 0.0
    assert summary["dcs"]["translation_mse"] > 10.0 * truth["translation_mse"]
    with (tmp_path / "versions.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 2 * len(city.PAPER)
    with (tmp_path / "starts.csv").open() as file:
        starts = list(csv.DictReader(file))
    accepted = [float(row["dcs_aliased"]) + float(row["dcs_random"]) for row in starts]
    np.testing.assert_allclose(np.mean(accepted) / 100, summary["dcs"]["fpr"])
    assert min(float(row["aliased_start_error"]) for row in starts) > 1.0
    written = (tmp_path / "table.md").read_text().splitlines()
    assert len(written) == 2 + len(city.PAPER) + 2
    assert (tmp_path / "maps.png").stat().st_size > 10_000
    assert not (tmp_path / "sweep.json").exists()

    def never(*_):
        raise RuntimeError("a version that is kept is not run again")

    monkeypatch.setattr(city, "run_version", never)
    assert run(tmp_path, *options) == summary
    with pytest.raises(RuntimeError, match="is kept"):
        run(tmp_path, *options, "--seeds", "1")


@pytest.mark.usefixtures("without_data")
def test_the_sweep_of_gates(tmp_path, monkeypatch):
    gates = np.array([0.01, 0.35, 0.99])
    few = {k: v for k, v in city_report.SWEEP.items() if v.confidence in gates}
    monkeypatch.setattr(city_report, "GATES", gates)
    monkeypatch.setattr(city, "SWEEP", few)
    run(tmp_path, "--rows", "paper", "--versions", "1", "--information", "sqrt")
    sweep = json.loads((tmp_path / "sweep.json").read_text())
    assert sweep["confidence"] == gates.tolist()
    assert set(sweep["methods"]) == {"pcm-exact", "pcm-heuristic", "ransac"}
    exact = sweep["methods"]["pcm-exact"]
    assert exact["tpr"] == sorted(exact["tpr"])  # calibrated: wide enough only at the end
    assert exact["tpr"][0] < 0.5 < 0.9 < exact["tpr"][-1]
    assert exact["fpr"][-1] == 0.0
    assert 0.7 < exact["chi2"][-1] < 1.3
    with (tmp_path / "sweep.csv").open() as file:
        assert [float(row["tpr"]) for row in csv.DictReader(file)][:3] == exact["tpr"]
    assert (tmp_path / "sweep.png").stat().st_size > 5_000


def test_the_rows_beyond_the_paper():
    """A version of the contract's rows and more; everything accepted is the worst there is."""
    source = city.Source(None, None, 0, 400, "sqrt")
    rows = city.ROWS["all"]
    assert set(rows) >= set(city.PAPER) | {"pcm-exact-99", "dcs-true-start", "gnc", "everything"}
    few = {name: rows[name] for name in ("no-outliers", "pcm-exact-99", "everything")}
    figures = city.run_version(source, city.Comparison(few), 0, 0)["methods"]
    truth, calibrated, everything = figures.values()
    assert calibrated["tpr"] > 0.9
    assert calibrated["fpr"] < 0.01
    assert (everything["tpr"], everything["fpr"]) == (1.0, 1.0)
    assert (everything["aliased"], everything["random"]) == (10.0, 90.0)
    assert everything["translation_mse"] > 100 * truth["translation_mse"]
    assert everything["chi2"] > 100 * truth["chi2"]


def test_processes_give_what_one_does(tmp_path):
    source = city.Source(None, None, 0, 400, "sqrt")
    few = city.Comparison({name: city.ROWS["all"][name] for name in ("ransac-99", "pcm-exact-99")})
    tasks = {f"0-{k}": partial(city.run_version, source, few, 0, k) for k in range(2)}
    one, two = (
        run_tasks("versions", tasks, Store(tmp_path / str(jobs), digest(source, few)), jobs=jobs)
        for jobs in (1, 2)
    )
    for (name, row), (_, other) in zip(*map(rows_of, (one, two)), strict=True):
        assert row.keys() == other.keys()
        for figure in row.keys() - {"seconds"}:
            assert other[figure] == pytest.approx(row[figure], rel=1e-6, abs=1e-9), (name, figure)


def rows_of(results):
    return [
        ((run, name), row)
        for run in sorted(results)
        for name, row in results[run]["methods"].items()
    ]


def test_the_laws_of_false_closures():
    home = simulated_city(400, 0, "sqrt")
    plain = version_of(home, Law(), 0, 1)
    near = version_of(home, Law(random_range=2.0), 0, 1)
    loud = version_of(home, Law(random_sigma=10.0), 0, 1)
    random = plain.labels < 0
    assert random.sum() == 90
    reach = np.linalg.norm(lie.translation(lie.as_numpy(near.graph.closures.measurement)), axis=1)
    assert reach[near.labels < 0].max() <= 2.0
    claimed = np.asarray(loud.graph.closures.information)[:, 0, 0]
    known = np.asarray(plain.graph.closures.information)[:, 0, 0]
    np.testing.assert_array_equal(claimed[~random], known[~random])
    ratio = np.sqrt(known / claimed)[random]
    assert 1.0 <= ratio.min() < 2.0 < 5.0 < ratio.max() <= 10.0


def test_closures_hold_where_maps_start_if_the_maps_lie_there():
    """Where the maps start at the truth, true closures hold but for their noise."""
    home = simulated_city(400, 0, "sqrt")
    exact = tuple(
        one.with_poses(lie.as_device(poses))
        for one, poses in zip(home.graph.maps, home.truth, strict=True)
    )
    placed = version_of(
        home._replace(graph=MultiRobotGraph(exact, home.graph.closures)), Law(), 0, 0
    )
    errors = start_errors(placed)
    assert errors["true"] < 0.1
    assert errors["aliased"] > 5.0
    assert start_errors(version_of(home, Law(), 0, 0))["true"] > 5.0


def test_weaker_information_divides_the_squared_distances():
    home = simulated_city(400, 0, "sqrt")
    squared = [
        select(version_of(one, Law(), 0, 0).graph, method="ransac", optimized=True).pairs[0].squared
        for one in (home, weakened(home, 6.0))
    ]
    np.testing.assert_allclose(squared[1], squared[0] / 6.0, rtol=1e-6)


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


def test_the_simulated_city_has_the_files_statistics(shared_data):
    folder = shared_data / "city10000"
    files = folder / "city10000.g2o.xz", folder / "city10000_groundtruth.isam.txt.xz"
    real = statistics(city_of_file(*files, slice(0, 2_000), "as-written"))
    simulated = statistics(simulated_city(2_000, city.SEED, "as-written"))
    np.testing.assert_allclose(simulated["loops"], real["loops"], rtol=0.05)
    np.testing.assert_allclose(simulated["extent"], real["extent"], rtol=0.1)
    # Its standard deviation is a twenty-third: a chi-squared of 1056 degrees of freedom over them.
    np.testing.assert_allclose(simulated["chi2"], real["chi2"], rtol=0.15)


def statistics(home):
    maps, true = home.graph.maps, np.concatenate([lie.translation(one) for one in home.truth])
    world = version_of(home, Law(), 0, 0)
    merged = merge(world.graph, accepted=world.is_true, optimized=True)
    return {
        "loops": sum(one.num_edges - one.num_poses + 1 for one in maps),
        "extent": np.ptp(true, axis=0),
        "chi2": merged.solution.normalized_chi2,
    }


def test_a_portion_that_is_none(shared_data):
    folder = shared_data / "city10000"
    files = folder / "city10000.g2o.xz", folder / "city10000_groundtruth.isam.txt.xz"
    with pytest.raises(InputError, match="poses: 20:22 of 10000"):
        city_of_file(*files, slice(20, 22), "as-written")


def test_the_report_has_the_committed_table():
    text = table_one.REPORT.read_text()
    assert table_one.with_block(text, table_one.MARKERS, table_one.block()) == text
    assert "| PCM-Exact 99 %, calibrated |" in text
