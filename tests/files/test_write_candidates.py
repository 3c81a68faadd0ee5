"""Closures written as CSV are read back as they were."""

import numpy as np
import pytest

from pcm_jax.files import read_graph, write_candidates, write_g2o
from pcm_jax.graph import MultiRobotGraph, symbols


@pytest.mark.parametrize("ids", [None, [np.arange(8) * 3 + 5, np.arange(8)[::-1].copy()]])
def test_round_trip(make_robots, assert_same, tmp_path, group, ids):
    robots = make_robots(group, names=("car", "b"), ids=ids)
    write_g2o(tmp_path / "maps.g2o", MultiRobotGraph(robots.maps))
    write_candidates(tmp_path / "closures.csv.gz", robots)
    again = read_graph(tmp_path / "maps.g2o", closures=tmp_path / "closures.csv.gz")
    assert_same(robots, again)


def test_symbol_keys(make_robots, assert_same, tmp_path, group):
    robots = make_robots(group, ids=[symbols.keys(name, np.arange(8)) for name in "ab"])
    write_g2o(tmp_path / "maps.g2o", MultiRobotGraph(robots.maps))
    write_candidates(tmp_path / "closures.csv", robots)
    assert_same(robots, read_graph(tmp_path / "maps.g2o", closures=tmp_path / "closures.csv"))


def test_no_closures(make_robots, tmp_path, group):
    robots = make_robots(group, m=0)
    write_candidates(tmp_path / "closures.csv", robots)
    (head,) = (tmp_path / "closures.csv").read_text().splitlines()
    assert head.startswith("robot_a,id_a,robot_b,id_b,x,y,")
