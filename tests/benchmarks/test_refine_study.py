"""`benchmarks.refine`: its rows on a small world, its files, its resuming."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from benchmarks import refine as study
from pcm_jax.simulation import simulate_city

ROWS = ["PCM", "PCM + GNC", "PCM + GNC + recall", "PCM + recall", "GNC alone", "everything"]


def small_world():
    world = simulate_city(seed=3, poses=60, inliers=8, aliased_groups=1, aliased_size=3, random=10)
    return study.World(world.graph, world.is_true, world.truth, in_steps=True)


def small_tasks(options, seed):
    return {
        f"csail, low, unstated #{seed}-{number}": partial(study.judge, small_world)
        for number in range(options.worlds)
    }


def size_tasks(options, seed):
    rows = {"PCM": {"tpr": 90.0}, "PCM + recall": {"tpr": 99.0}}
    rest = dict.fromkeys(("false", "loops", "ate", "parts", "seconds"), 0.0)
    methods = {name: row | rest for name, row in rows.items()}
    return {f"size, {n} right, gate 0.99 #{seed}": partial(dict, methods=methods) for n in (5, 50)}


@pytest.mark.slow
def test_one_command_writes_all_and_resumes(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(study.TASKS, "csail", small_tasks)
    monkeypatch.setitem(study.TASKS, "size", size_tasks)
    command = ["--studies", "csail", "size", "--worlds", "2", "--out", str(tmp_path)]
    assert study.main(command) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    cell = summary["csail, low, unstated"]
    assert list(cell) == [*ROWS, "true closures"]
    assert all(row["worlds"] == 2 for row in cell.values())
    assert cell["true closures"]["tpr"] == 100.0
    assert cell["PCM + recall"]["tpr"] >= cell["PCM"]["tpr"]
    assert cell["everything"]["false"] == 13.0
    assert cell["everything"]["ate"] > 10 * cell["PCM"]["ate"]
    assert set(map(Path, ("recall.png", "run.json", "table.md", "worlds.csv"))) <= {
        path.relative_to(tmp_path) for path in tmp_path.iterdir()
    }
    monkeypatch.setattr(study, "judged", None)  # nothing is computed again
    assert study.main(command) == 0
    assert json.loads((tmp_path / "summary.json").read_text()) == summary
    assert "csail, low, unstated: PCM + recall" in capsys.readouterr().out


@pytest.mark.parametrize("stated", [True, False])
def test_csail_in_three_pieces(shared_data, stated):
    world = study.csail_world(shared_data, "low", stated, (0, 0))
    closures = world.graph.closures[world.is_true]
    counts = [len(closures.between(a, b)[1]) for a, b in ((0, 1), (0, 2), (1, 2))]
    assert counts == [12, 67, 18]
    assert len(world.is_true) == sum(counts) + 3 * 40
    edges = [one.num_edges - one.num_poses + 1 for one in world.graph.maps]
    assert edges == [13, 16, 2]
    again = study.csail_world(shared_data, "low", stated, (0, 0))
    np.testing.assert_array_equal(
        again.graph.maps[0].measurement.parameters(), world.graph.maps[0].measurement.parameters()
    )
