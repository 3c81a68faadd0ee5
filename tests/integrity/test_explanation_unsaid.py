"""Explanations of closures whose information is singular."""

import dataclasses

import numpy as np

from pcm_jax import MultiRobotGraph, merge
from pcm_jax.simulation import simulate_sessions

SAID = np.diag([1.0, 1.0, 0.0, 0.0, 0.0, 1.0])


def test_closures_that_leave_directions_unsaid_are_explained():
    world = simulate_sessions(seed=1, poses=60, inliers=10, aliased_groups=0, random=15)
    closures = world.graph.closures
    planar = dataclasses.replace(closures, information=SAID @ closures.information @ SAID)
    result = merge(MultiRobotGraph(world.graph.maps, planar))
    assert result.accepted.sum() >= 8
    rows = result.report()["closures"]
    assert all(row["why"].startswith("Closure") for row in rows)
    assert result.explain(int(np.flatnonzero(result.accepted)[0])).standing == "accepted"
