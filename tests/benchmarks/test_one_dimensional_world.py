"""Small versions of Figs 2 and 3 and of the sweep, and that a run goes on where it was killed."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from benchmarks import one_dimensional_world
from benchmarks.experiments import solver_timing
from benchmarks.experiments.one_dimensional import METHODS, PLAUSIBLE, Setting
from pcm_jax.selection import select_from
from pcm_jax.store import Store

SMALL = ("--inliers", "4", "--aliased", "3", "--random", "5")


def run(folder, *options):
    assert one_dimensional_world.main([*SMALL, "--out", str(folder), *options]) == 0
    return json.loads((folder / "summary.json").read_text())


@pytest.fixture
def chunks_of_100(monkeypatch):
    monkeypatch.setattr(one_dimensional_world, "CHUNK", 100)
    monkeypatch.setattr(one_dimensional_world, "SOURCES", ())


@pytest.mark.slow
@pytest.mark.usefixtures("chunks_of_100")
def test_shape_of_the_result_and_resuming(tmp_path, monkeypatch):
    summary = run(tmp_path, "--worlds", "250")
    assert set(summary) == set(METHODS)
    assert json.loads((tmp_path / "run.json").read_text())["options"]["worlds"] == 250
    for method in ("combinatorial", "pcm-exact", "pcm-heuristic"):
        assert summary[method]["inconsistent_worlds"] == 0.0
    assert summary["combinatorial"]["same_size"] == summary["pcm-exact"]["same_size"] == 1.0
    assert 0.95 < summary["pcm-heuristic"]["same_size"] <= 1.0
    for method in ("ransac", "scgp"):
        assert summary[method]["inconsistent_worlds"] > 0.5
        assert summary[method]["same_size"] < 0.5
    with (tmp_path / "histograms.csv").open() as file:
        rows = list(csv.DictReader(file))
    worlds = [int(row["worlds"]) for row in rows if row["method"] == "ransac"]
    assert sum(worlds) == 2 * 250
    assert (tmp_path / "histograms.png").stat().st_size > 10_000

    def never(*_):
        raise RuntimeError("a chunk that is kept is not run again")

    monkeypatch.setattr(one_dimensional_world, "compare_worlds", never)
    assert run(tmp_path, "--worlds", "250") == summary
    with pytest.raises(RuntimeError, match="is kept"):
        run(tmp_path, "--worlds", "250", "--seeds", "1")


@pytest.mark.usefixtures("chunks_of_100")
def test_counts_are_those_of_the_hosts_methods():
    setting = Setting(4, 3, 5)
    found = one_dimensional_world.compare_worlds(setting, 30, 7, 2)
    seed = int(np.random.SeedSequence([7, 2]).generate_state(1)[0])
    squared = setting.worlds(100, seed).squared_mahalanobis()[:30]
    largest = [select_from(one, setting.gate).sum() for one in squared]
    members = [select_from(one, setting.gate, method="ransac") for one in squared]
    pairs = [
        np.count_nonzero(np.triu(one[np.ix_(mask, mask)] > setting.gate))
        for one, mask in zip(squared, members, strict=True)
    ]
    difference = np.sum(members, axis=1) - largest
    expected = {str(value): int((difference == value).sum()) for value in np.unique(difference)}
    assert found["ransac"]["size_difference"] == expected
    expected = {str(value): pairs.count(value) for value in sorted(set(pairs))}
    assert found["ransac"]["inconsistent_pairs"] == expected


@pytest.mark.usefixtures("chunks_of_100")
def test_sweep_says_which_setting_is_nearest_the_paper(tmp_path, monkeypatch):
    counted = []

    def row(setting, worlds, seed):
        counted.append((setting, worlds, seed))
        percent = 90.0 + setting.confidence
        others = {f"{name}_same_size": 0.0 for name in ("ransac", "scgp")}
        return setting._asdict() | {"pcm_heuristic_same_size": percent} | others

    monkeypatch.setattr(one_dimensional_world, "sweep_setting", row)
    summary = run(tmp_path, "--sweep", "--worlds", "100")
    assert len(counted) == summary["settings"] == 55
    assert PLAUSIBLE in [setting for setting, *_ in counted]
    assert Setting() in [setting for setting, *_ in counted]
    assert summary["nearest"]["confidence"] == 0.99
    with (tmp_path / "sweep.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 55


@pytest.mark.usefixtures("chunks_of_100")
def test_a_row_of_the_sweep_is_what_the_histograms_say():
    row = one_dimensional_world.sweep_setting(Setting(4, 3, 5), 150, 3)
    chunks = [
        one_dimensional_world.compare_worlds(Setting(4, 3, 5), worlds, 3, number)
        for number, worlds in enumerate((100, 50))
    ]
    for method in ("pcm-heuristic", "ransac", "scgp"):
        same = sum(chunk[method]["size_difference"].get("0", 0) for chunk in chunks)
        assert row[f"{method.replace('-', '_')}_same_size"] == pytest.approx(100 * same / 150, 1e-3)


@pytest.mark.slow
def test_timing_ends_where_methods_give_up(tmp_path, monkeypatch):
    monkeypatch.setattr(solver_timing, "BATCHED_UP_TO", 12)
    options = ("--timing", "--worlds", "100", "--sizes", "12", "20", "28", "--time-limit", "60")
    summary = run(tmp_path, *options)
    assert summary["combinatorial"]["largest"] == 20
    assert summary["combinatorial"]["gave_up_at"] == 28
    for method in METHODS[1:]:
        assert summary[method]["largest"] == 28
        assert summary[method]["gave_up_at"] is None
    with (tmp_path / "timing.csv").open() as file:
        rows = list(csv.DictReader(file))
    enumeration = {int(r["measurements"]): r for r in rows if r["method"] == "combinatorial"}
    assert set(enumeration) == {12, 20}
    assert min(float(enumeration[size]["median"]) for size in (12, 20)) > 0.0
    assert float(enumeration[12]["batched"]) > 0.0
    assert enumeration[20]["batched"] == ""
    assert (tmp_path / "timing.png").stat().st_size > 10_000


def test_who_gave_up_is_not_tried_again(tmp_path):
    steps = Store(tmp_path, "options")
    results = solver_timing.time_solvers(Setting(), (64, 96, 128), 50, 0.0, 0, steps)
    assert all(timed["gave_up"] for timed in results[64].values())
    # Enumeration refuses 64, and the clique search is stopped; the others end late.
    assert [len(results[64][method]["seconds"]) for method in METHODS] == [0, 0, 1, 1, 1]
    assert results[96] == results[128] == {}
