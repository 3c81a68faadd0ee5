"""The benchmark of labelled sets, on two that are generated and written as JRL."""

import csv
import dataclasses
import json

import numpy as np
import pytest

from benchmarks import cosmo
from pcm_jax import MultiRobotGraph
from pcm_jax.files import write_graph
from pcm_jax.simulation import simulate_city


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A labelled set with true poses, and the same without either in a folder below."""
    folder = tmp_path_factory.mktemp("sets")
    world = simulate_city(seed=3, poses=60, inliers=8, random=12)
    labelled = dataclasses.replace(world.graph.closures, is_true=np.asarray(world.is_true))
    truth = tuple(world.truth)
    write_graph(folder / "city.jrl", MultiRobotGraph(world.graph.maps, labelled, truth))
    (folder / "more").mkdir()
    write_graph(folder / "more" / "bare.jrl", world.graph)
    return folder


@pytest.fixture(scope="module")
def results(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    assert cosmo.main(["--data", str(folder), "--out", str(out)]) == 0
    return out


@pytest.mark.slow
def test_figures_of_a_labelled_set(results):
    """PCM accepts what is true alone; everything is all of both, and metres away."""
    summary = json.loads((results / "summary.json").read_text())["city.jrl"]
    assert set(summary) == set(cosmo.METHODS)
    pcm, everything = summary["pcm-exact-99"], summary["everything"]
    assert (pcm["closures"], everything["accepted"]) == (30, 30)
    assert pcm["tpr"] >= 0.75 and pcm["fpr"] == 0.0 and pcm["parts"] == 1
    assert (everything["tpr"], everything["fpr"]) == (1.0, 1.0)
    assert pcm["ate_rmse"] < 0.5 < everything["ate_rmse"]
    assert all(row["seconds"] > 0.0 for row in summary.values())


def test_what_is_not_known_is_no_number(results):
    """Without labels and true poses only counts are left."""
    bare = json.loads((results / "summary.json").read_text())["more-bare.jrl"]
    for row in bare.values():
        assert row["tpr"] is None and row["fpr"] is None and row["ate_rmse"] is None
    assert bare["everything"]["accepted"] == 30


def test_files_have_a_row_for_each_set_and_method(results):
    with (results / "sets.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["set"], row["method"]) for row in rows] == [
        (name, method) for name in ("city.jrl", "more-bare.jrl") for method in cosmo.METHODS
    ]
    table = (results / "table.md").read_text()
    assert "ATE (m)" in table and "city.jrl" in table


def test_a_second_run_computes_nothing(results, folder, monkeypatch):
    def refused(*_):
        raise AssertionError("computed again")

    before = (results / "summary.json").read_text()
    monkeypatch.setattr(cosmo, "judge", refused)
    assert cosmo.main(["--data", str(folder), "--out", str(results)]) == 0
    assert (results / "summary.json").read_text() == before


def test_a_folder_without_sets(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        cosmo.main(["--data", str(tmp_path), "--out", str(tmp_path / "out")])
    assert ended.value.code == 2
    assert "no .jrl file" in capsys.readouterr().err
