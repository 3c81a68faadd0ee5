"""The experiment on a stand-in in the formats of the real files, and on the smallest real ones."""

from __future__ import annotations

import csv
import dataclasses
import json
from typing import Any

import numpy as np
import pytest
from square_walk import FALSE, KITTI, RIGHT, RRR, STEPS, square_walk

from benchmarks import place_recognition
from benchmarks.experiments import real_candidates as real
from benchmarks.experiments.real_candidate_report import pooled
from benchmarks.place_recognition import ALL_METHODS, Arm
from pcm_jax import InputError, lie, select_within
from pcm_jax.evaluation import ate_rmse
from pcm_jax.experiments import drives

FEW = {name: ALL_METHODS[name] for name in ("no-outliers", "pcm-exact-99", "everything")}


def test_truth_and_labels_of_both_collections(square_walk_files):
    assert drives.found(square_walk_files) == [RRR, KITTI]
    right = [False] * len(STEPS) + [True] * len(RIGHT) + [False] * len(FALSE)
    for name in (RRR, KITTI):
        candidates = drives.load(square_walk_files, name)
        np.testing.assert_allclose(
            lie.translation(candidates.truth), square_walk()[:, :2], atol=1e-6
        )
        assert candidates.is_true.tolist() == right
        assert candidates.listed == (name == KITTI)
    nearer = drives.within_tolerance(candidates.graph, candidates.truth, (0.03, 10.0))
    assert 0 < nearer.sum() < len(RIGHT)


def test_the_noise_of_honest_information(square_walk_files):
    candidates = drives.load(square_walk_files, KITTI)
    noise: Any = real.noise(candidates, select_within(candidates.graph))
    assert noise["steps_against_truth_mean"] == pytest.approx(1.0, abs=0.15)
    assert noise["right_against_truth_mean"] == pytest.approx(1.0, abs=0.4)
    assert 0.3 < noise["factor_odometry"] < 3.0
    assert 0.3 < noise["factor_closures"] < 3.0
    assert noise["lever_arm_m"] < 0.05
    assert noise["false_stored_as_identity"] == len(FALSE)
    assert noise["smallest_error_of_false_m"] > 1.0


def test_factors_find_a_factor(square_walk_files):
    candidates = drives.load(square_walk_files, KITTI)
    found = []
    for factor in (1.0, 0.5):
        graph = real.rescaled(candidates.graph, real.Factors(factor, factor))
        selection = select_within(graph)
        right = candidates.is_true[selection.closures]
        found.append(real.factors_of_data(dataclasses.replace(selection, accepted=right), graph))
    np.testing.assert_allclose(found[1], 2.0 * np.array(found[0]), rtol=1e-9)


def test_lever_arm_of_a_truth_that_is_of_another_point(square_walk_files):
    candidates = drives.load(square_walk_files, KITTI)
    shift: Any = np.array([-2.0, 0.5, 0.0])
    offset = lie.exp(lie.group_of(candidates.truth), shift)
    moved = candidates._replace(truth=lie.compose(candidates.truth, offset))
    assert real.lever_arm(moved) == pytest.approx(np.hypot(2.0, 0.5), abs=0.05)


@pytest.mark.slow
def test_results_of_one_and_of_two_robots(square_walk_files, tmp_path, monkeypatch):
    arms = {
        "two-robots": Arm("odometry", "as-written", FEW),
        "two-robots-cleaned": Arm("cleaned", "data", FEW),
    }
    monkeypatch.setattr(place_recognition, "ARMS", arms)
    monkeypatch.setattr(place_recognition, "LIBRARY", [])  # edits during a test start nothing anew
    options = [
        "--data",
        str(square_walk_files),
        "--cuts",
        "1",
        "--datasets",
        KITTI,
        "--out",
        str(tmp_path),
    ]
    assert place_recognition.main(options) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert set(summary) == {f"{KITTI}/{arm}" for arm in ("one-robot", *arms)}
    one = summary[f"{KITTI}/one-robot"]
    assert one["within-pcm-99"]["precision"] == 1.0
    assert one["within-pcm-99"]["recall"] > 0.9
    assert one["within-pcm-99"]["ate_rmse"] < 0.5 * one["odometry"]["ate_rmse"]
    assert one["everything"]["ate_rmse"] > 5.0 * one["no-outliers"]["ate_rmse"]
    assert (one["odometry"]["precision"], one["odometry"]["merged"]) == (None, 0.0)
    for arm in arms:
        two = summary[f"{KITTI}/{arm}"]
        assert set(two) == set(FEW)
        assert two["pcm-exact-99"]["precision"] > 0.95
        assert two["pcm-exact-99"]["recall"] > 0.9
        assert two["pcm-exact-99"]["ate_rmse"] < 0.5 * two["everything"]["ate_rmse"]
        assert two["everything"]["precision"] < 0.9
    noise = json.loads((tmp_path / "noise.json").read_text())[KITTI]
    assert noise["labels"]["1 m, 10 degrees"]["labels_that_differ"] == 0
    with (tmp_path / "sets.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert int(row["largest_right_set"]) > int(row["largest_false_set"])
    pictures = {path.name for path in tmp_path.glob("*.png")}
    kinds = ("one-robot", "two-robots", "precision-recall", "sweep")
    assert pictures == {f"{KITTI}-{kind}.png" for kind in kinds}

    def never(*_):
        raise RuntimeError("a version that is kept is not run again")

    monkeypatch.setattr(place_recognition, "run_two_robots", never)
    assert place_recognition.main(options) == 0


def test_rates_are_pooled_and_errors_are_of_what_was_merged():
    common = {"candidates": 10, "chi2": 1.0, "converged": 1.0, "seconds": 0.1}
    runs = [
        {"right": 8, "accepted": 4, "accepted_right": 3, "ate_rmse": 2.0, **common},
        {"right": 2, "accepted": 0, "accepted_right": 0, "ate_rmse": None, **common},
    ]
    figures = pooled(runs)
    assert (figures["precision"], figures["recall"]) == (0.75, 0.3)
    assert (figures["fpr"], figures["merged"], figures["ate_rmse"]) == (0.1, 0.5, 2.0)


def test_sessions_start_at_their_own_origin(square_walk_files):
    candidates = drives.load(square_walk_files, KITTI)
    graph = place_recognition.sessions(candidates.graph, 90, "cleaned")
    for one in graph.maps:
        assert lie.parameters(lie.as_numpy(one.poses))[0].tolist() == [1.0, 0.0, 0.0, 0.0]
    rows = place_recognition.across(candidates.graph, 90)
    assert candidates.graph.source[rows].tolist() == graph.closures.source.tolist()


def test_what_is_not_there(square_walk_files, tmp_path, capsys):
    with pytest.raises(InputError, match=r"name: 'none', expected one of Walk_0.300, kitti_99"):
        drives.load(square_walk_files, "none")
    with pytest.raises(SystemExit, match="2"):
        place_recognition.main(["--data", str(tmp_path), "--out", str(tmp_path / "out")])
    assert "has no kitti_robust or rrr" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        place_recognition.main(
            ["--data", str(square_walk_files), "--datasets", "x", "--out", str(tmp_path)]
        )
    assert "'x' given, expected some of" in capsys.readouterr().err


@pytest.mark.slow
def test_the_strictest_real_candidates(shared_data):
    candidates = drives.load(shared_data, "kitti_00_alpha_1.00")
    selection = select_within(candidates.graph)
    noise: Any = real.noise(candidates, selection)
    assert (noise["candidates"], noise["right"], noise["false_stored_as_identity"]) == (
        141,
        131,
        10,
    )
    assert noise["steps_against_truth_mean"] == pytest.approx(1.0, abs=0.01)
    assert noise["right_against_truth_mean"] > 100.0
    assert noise["largest_error_of_right_m"] < 2.0 < 50.0 < noise["smallest_error_of_false_m"]
    right = candidates.is_true[selection.closures]
    assert selection.accepted.tolist() == right.tolist()
    figures = place_recognition._trajectory(candidates, selection.kept, 0.0)
    assert figures["ate_rmse"] < 2.5
    odometry = drives.chained(candidates.graph)
    assert ate_rmse(odometry, candidates.truth, align="umeyama") > 20.0


def test_the_strictest_real_registrations(shared_data):
    candidates = drives.load(shared_data, "B25b_1.000")
    assert candidates.graph.num_poses == 8_358
    assert candidates.is_true.sum() == (~drives.steps(candidates.graph)).sum() == 23
    assert select_within(candidates.graph).accepted.all()
