"""Where a chi-squared lies that noise as stated does not explain."""

from __future__ import annotations

import numpy as np
import pytest

from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph
from pcm_jax.merging._strain import TOO_BAD, strain


def shifts(*given: tuple[float, float]) -> np.ndarray:
    """Homogeneous matrices of translations in the plane."""
    found = np.tile(np.eye(3), (len(given), 1, 1))
    found[:, :2, 2] = given
    return found


@pytest.fixture
def graph() -> MultiRobotGraph:
    """Residuals of 0.5 m in map a and of 1 m in a closure, none in map b."""
    ends = {"tail": [0], "head": [1]}
    a = PoseGraph.from_arrays(
        **ends,
        poses=shifts((0, 0), (1, 0)),
        measurement=shifts((1.5, 0)),
        information=4 * np.eye(3)[None],
        name="a",
    )
    b = PoseGraph.from_arrays(
        **ends,
        poses=shifts((2, 2), (3, 2)),
        measurement=shifts((1, 0)),
        information=np.eye(3)[None],
        name="b",
    )
    closures = LoopClosures.from_arrays(
        robot_a=[0],
        pose_a=[0],
        robot_b=[1],
        pose_b=[0],
        measurement=shifts((2, 3)),
        information=3 * np.eye(3)[None],
    )
    return MultiRobotGraph((a, b), closures)


def test_the_worst_part_is_named_with_its_share(graph):
    told = strain(graph, 50.0)
    assert told is not None
    assert told.startswith("the normalised chi-squared is 50, where noise as stated gives 1: ")
    # 0.5² · 4 = 1 in map a, 1² · 3 = 3 in the closure.
    assert told.endswith("75 % of it lies in the 1 closures between 'a' and 'b'")
    alone = MultiRobotGraph(graph.maps, graph.closures[[]])
    assert str(strain(alone, 50.0)).endswith("100 % of it lies in the edges of map 'a'")


@pytest.mark.parametrize("fit", [None, 1.0, TOO_BAD])
def test_a_fit_that_noise_explains_is_not_spoken_of(graph, fit):
    assert strain(graph, fit) is None
