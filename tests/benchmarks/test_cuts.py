"""`python -m benchmarks.cuts`, on a stand-in for the real files."""

import json
import shutil

import pytest

from benchmarks import cuts


@pytest.fixture
def outcomes():
    """Of three cuts: a right one that all merge, a wrong one that two rules do, an empty one."""
    every, some = dict.fromkeys(cuts.RULES, True), {"2": True, "chance": True}
    return {
        "a": {"kind": "x, odometry", "is_right": True, "rules": every},
        "b": {"kind": "x, odometry", "is_right": False, "rules": every | {"default": False} | some},
        "c": {"kind": "x, odometry", "rules": {}},
    }


def test_counts_by_rule(outcomes):
    (rules,) = cuts.counted(outcomes).values()
    assert rules["2"] == {"right": 1, "right_merged": 1, "wrong": 1, "wrong_merged": 1}
    assert rules["default"] == {"right": 1, "right_merged": 1, "wrong": 1, "wrong_merged": 0}


def test_cuts_of_a_walk(square_walk_files, tmp_path, capsys):
    folder = tmp_path / "data"
    shutil.copytree(square_walk_files / "kitti_robust", folder / "kitti_robust")
    options = ["--data", str(folder), "--maps", "odometry", "--every", "80"]
    assert cuts.main([*options, "--out", str(tmp_path / "out")]) == 0
    (rules,) = json.loads((tmp_path / "out/summary.json").read_text()).values()
    assert rules["default"]["right"] == 2 and rules["default"]["wrong"] == 0
    assert rules["2"]["right_merged"] == 2
    assert rules["default"]["right_merged"] == 0  # all say "the same pose", however shuffled
    found = json.loads((tmp_path / "out/cuts.json").read_text())
    assert [one["is_right"] for one in found.values()] == [True, True]
    assert "of them merged" in capsys.readouterr().out
