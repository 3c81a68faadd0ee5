"""A small version of Fig. 2, and that a run goes on where it was killed."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from benchmarks import one_dimensional_world
from pcm_jax.selection import select_from

SMALL = ("--inliers", "4", "--aliased", "3", "--random", "5")


def run(folder, *options):
    assert one_dimensional_world.main([*SMALL, "--out", str(folder), *options]) == 0
    return json.loads((folder / "summary.json").read_text())


@pytest.fixture
def chunks_of_100(monkeypatch):
    monkeypatch.setattr(one_dimensional_world, "CHUNK", 100)
    monkeypatch.setattr(one_dimensional_world, "SOURCES", ())


@pytest.mark.usefixtures("chunks_of_100")
def test_shape_of_the_result_and_resuming(tmp_path, monkeypatch):
    summary = run(tmp_path, "--worlds", "250")
    assert set(summary) == {"combinatorial", "pcm-exact", "pcm-heuristic", "ransac", "scgp"}
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

    monkeypatch.setattr(one_dimensional_world, "_chunk", never)
    assert run(tmp_path, "--worlds", "250") == summary
    with pytest.raises(RuntimeError, match="is kept"):
        run(tmp_path, "--worlds", "250", "--seed", "1")


@pytest.mark.usefixtures("chunks_of_100")
def test_counts_are_those_of_the_hosts_methods():
    setting = one_dimensional_world.Setting(4, 3, 5)
    programs = one_dimensional_world._Programs(one_dimensional_world.METHODS)
    found = one_dimensional_world._chunk(programs, setting, 30, 7, 2)
    seed = int(np.random.SeedSequence([7, 2]).generate_state(1)[0])
    squared = setting.squared(100, seed)[:30]
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
