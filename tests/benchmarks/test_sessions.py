"""A small version of Table II on simulated sessions, and one on NCLT's."""

from __future__ import annotations

import csv
import json

import pytest

from benchmarks import sessions

pytestmark = pytest.mark.slow


CONTRACT = {"tpr", "fpr", "translation_mse", "rotation_mse", "chi2", "seconds"}
TABLE_II = {
    f"{kind}_{error}"
    for kind in ("map", "step")
    for error in ("translation_mse", "translation_rmse", "rotation_mse")
}
METHODS = ["no-outliers", "dcs", "ransac-1", "pcm-exact-11", "pcm-exact-99"]


@pytest.fixture(autouse=True)
def _stamp_of_options_alone(monkeypatch):
    monkeypatch.setattr(
        sessions, "_sources", list
    )  # edits during a test are no reason to start anew


def run(folder, *options):
    assert sessions.main(["--out", str(folder), *options]) == 0
    return json.loads((folder / "summary.json").read_text())


def test_shape_of_the_table_and_resuming(tmp_path, monkeypatch):
    monkeypatch.setattr(sessions, "NCLT", tmp_path / "absent")
    options = ["--poses", "750", "--versions", "2", "--methods", *METHODS]
    summary = run(tmp_path, *options)
    assert list(summary) == METHODS
    assert all(set(row) >= CONTRACT | TABLE_II for row in summary.values())
    truth, pcm = summary["no-outliers"], summary["pcm-exact-99"]
    assert (truth["tpr"], truth["fpr"], truth["accepted_true"]) == (1.0, 0.0, 10.0)
    assert 0.7 < truth["chi2"] < 1.3
    assert pcm["tpr"] > 0.8
    assert pcm["accepted_false"] <= 1.0
    assert pcm["map_translation_mse"] < 2.0 * truth["map_translation_mse"] + 1.0
    assert truth["map_translation_rmse"] == pytest.approx(truth["map_translation_mse"] ** 0.5)
    assert summary["pcm-exact-11"]["tpr"] < pcm["tpr"]
    assert summary["dcs"]["tpr"] == 0.0
    assert summary["dcs"]["map_translation_mse"] > 100 * truth["map_translation_mse"]
    about = json.loads((tmp_path / "sessions.json").read_text())
    assert "absent" in about["stand_in"]
    inside = about["pairs of right closures inside the gate"]
    assert inside["0.99"] > 0.9
    assert list(inside.values()) == sorted(inside.values())
    assert "simulated sessions" in (tmp_path / "table.md").read_text()
    assert all((tmp_path / name).stat().st_size > 20_000 for name in ("fig6.png", "fig7.png"))
    with (tmp_path / "versions.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 2 * len(METHODS)

    def never(*_):
        raise RuntimeError("a version that is kept is not run again")

    monkeypatch.setattr(sessions, "run_version", never)
    monkeypatch.setattr(sessions, "draw_figures", lambda *_: None)
    assert run(tmp_path, *options) == summary
    with pytest.raises(RuntimeError, match="is kept"):
        run(tmp_path, *options, "--seeds", "1")


def test_files_that_are_missing(tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        run(tmp_path, "--data", str(tmp_path))
    assert "2012-08-04_gt_trajectory.txt: there is no such file" in capsys.readouterr().err


def test_two_real_sessions(shared_data, tmp_path, monkeypatch):
    monkeypatch.setattr(sessions, "draw_figures", lambda *_: None)
    data = ["--data", str(shared_data / "nclt"), "--sessions", *sessions.SESSIONS]
    methods = ["no-outliers", "dcs", "pcm-exact-99"]
    summary = run(tmp_path, *data, "--versions", "1", "--methods", *methods)
    pcm, truth = summary["pcm-exact-99"], summary["no-outliers"]
    assert pcm["tpr"] > 0.8
    assert pcm["accepted_false"] <= 1.0
    assert pcm["ate_rmse"] < 2.0 * truth["ate_rmse"]
    assert summary["dcs"]["tpr"] == 0.0
    assert summary["dcs"]["ate_rmse"] > 100.0
    about = json.loads((tmp_path / "sessions.json").read_text())
    assert about["stand_in"] is None
    assert about["candidates"] == 420
    assert 250 < about["candidates near the other session"] < 300
    assert about["maps"]["b"]["optimised_ate"] < about["maps"]["b"]["odometry_ate"]
    assert "**substitute**" in (tmp_path / "table.md").read_text()
