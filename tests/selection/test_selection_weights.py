"""Weights of closures: when they decide, and what is said where a method cannot go by them."""

from __future__ import annotations

import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.consistency import PairEvidence
from pcm_jax.errors import InputWarning
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph
from pcm_jax.selection.weights import check_weights, weights_for

UNEQUAL, NOTHING, EQUAL = [0.5, 2.0], [0.0, 0.0], [0.5, 0.5]


def team(robots, weight):
    """Three robots of one pose each, and closures between some of them."""
    alone = PoseGraph.from_arrays(
        poses=np.eye(3)[None],
        tail=[],
        head=[],
        measurement=np.zeros((0, 3, 3)),
        information=np.zeros((0, 3, 3)),
    )
    count = len(robots)
    closures = LoopClosures.from_arrays(
        robot_a=[a for a, _ in robots],
        pose_a=[0] * count,
        robot_b=[b for _, b in robots],
        pose_b=[0] * count,
        measurement=lie.as_numpy(lie.identity(jaxlie.SE2, (count,))),
        information=np.tile(np.eye(3), (count, 1, 1)),
        weight=weight,
    )
    return MultiRobotGraph((alone, alone, alone), closures)


@pytest.mark.parametrize("weight", [UNEQUAL, NOTHING])
@pytest.mark.parametrize("robots", [[(0, 1), (0, 1)], [(0, 1), (1, 0)], [(1, 0), (1, 0)]])
def test_a_method_that_cannot_weigh_says_so(robots, weight):
    graph = team([*robots, (0, 2), (1, 2)], [*weight, 1.0, 1.0])
    names = f"between {graph.names[0]} and {graph.names[1]} differ in it, which method 'ransac'"
    with pytest.warns(InputWarning, match=names):
        check_weights("ransac", graph)


def test_nothing_is_said_where_weights_decide_nothing_or_are_gone_by():
    """Neither of weights that differ from pair to pair alone."""
    check_weights("ransac", team([(0, 1), (0, 1), (2, 0), (1, 2)], [1.0, 1.0, 3.0, 0.5]))
    unequal = team([(0, 1), (0, 1)], UNEQUAL)
    check_weights("pcm-exact", unequal)
    check_weights(lambda evidence, gate: np.ones(2, bool), unequal)


@pytest.mark.parametrize(("weight", "decide"), [(UNEQUAL, True), (NOTHING, True), (EQUAL, False)])
def test_a_method_gets_weights_that_decide(weight, decide):
    measured = team([(0, 1), (0, 1)], weight).closures
    evidence = PairEvidence(0, 1, np.arange(2), measured, None, np.zeros((2, 2)))
    options = weights_for("pcm-exact", evidence)
    assert {name: given.tolist() for name, given in options.items()} == (
        {"weights": weight} if decide else {}
    )
    assert weights_for("ransac", evidence) == {}
