"""Explanations of closures whose information is singular."""

import dataclasses

import numpy as np
import pytest
from planar_worlds import planar_world

from pcm_jax import MultiRobotGraph, merge
from pcm_jax.integrity._loops import Loops
from pcm_jax.pipeline import weigh
from pcm_jax.simulation import simulate_sessions

SAID = np.diag([1.0, 1.0, 0.0, 0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def planar_and_in_space():
    return tuple(merge(graph) for graph in planar_world(3, closures=14, false=(2, 5, 9)))


@pytest.fixture(scope="module")
def partly_said():
    """Closures between maps in space that say a position in the plane and a heading."""
    world = simulate_sessions(seed=1, poses=60, inliers=10, aliased_groups=0, random=15)
    closures = world.graph.closures
    planar = dataclasses.replace(closures, information=SAID @ closures.information @ SAID)
    return MultiRobotGraph(world.graph.maps, planar)


def test_loops_of_chosen_pairs_are_those_of_q(partly_said):
    (pair,) = weigh(partly_said).pairs
    larger = np.maximum(pair.comparable, pair.comparable.T)
    loops, every = Loops(pair.covariances, pair.measured), np.arange(len(pair))
    np.testing.assert_allclose(loops.squared(every, every), larger, rtol=1e-7)
    u, v = np.nonzero(~np.eye(len(pair), dtype=bool))
    np.testing.assert_allclose(loops.misses(u, v).squared, larger[u, v], rtol=1e-7)


def test_closures_that_leave_directions_unsaid_are_explained(partly_said):
    result = merge(partly_said)
    assert result.accepted.sum() >= 8
    rows = result.report()["closures"]
    assert all(row["why"].startswith("Closure") for row in rows)
    assert result.explain(int(np.flatnonzero(result.accepted)[0])).standing == "accepted"
    conflict = result.explain(int(np.flatnonzero(~result.accepted)[0])).worst_conflict
    assert conflict is not None
    assert conflict.translation_sigma < 10.0


def test_planar_closures_in_space_are_explained_as_in_the_plane(planar_and_in_space):
    flat, deep = planar_and_in_space
    assert 0 < flat.accepted.sum() < len(flat.accepted)
    for index in range(len(flat.candidates)):
        expected, found = flat.explain(index), deep.explain(index)
        assert found.standing == expected.standing
        assert (found.agrees_with, found.agreeing) == (expected.agrees_with, expected.agreeing)
        assert found.enters_at == pytest.approx(expected.enters_at, abs=1e-6)
        one, other = found.worst_conflict, expected.worst_conflict
        assert one.index == other.index
        for name in ("translation", "translation_sigma", "rotation", "rotation_sigma", "shares"):
            assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-5, abs=1e-8)


def test_a_planar_closures_fit_has_three_degrees_of_freedom(planar_and_in_space):
    flat, deep = planar_and_in_space
    for index in np.flatnonzero(deep.accepted).tolist():
        expected, found = flat.explain(index).fit, deep.explain(index).fit
        assert (found.dof, expected.dof) == (3, 3)
        assert found.chi2 == pytest.approx(expected.chi2, rel=1e-5)
        assert found.p == pytest.approx(expected.p, rel=1e-5)
        x, y, z, roll, pitch, yaw = found.residual
        assert (x, y, yaw) == pytest.approx(expected.residual, rel=1e-4, abs=1e-7)
        assert (z, roll, pitch) == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
        assert "(3 expected)" in deep.explain(index).sentence
