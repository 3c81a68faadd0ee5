"""Errors against the truth, by edges and by length, on drives whose law is known."""

import dataclasses

import numpy as np
import pytest

from benchmarks import real_noise
from benchmarks.experiments import real_candidates
from pcm_jax import lie
from pcm_jax.experiments import drives
from pcm_jax.integrity.calibration import scaled_graph
from pcm_jax.simulation import simulate_city


@pytest.fixture(scope="module")
def drive():
    return drives.simulated(3, aliased=False)


def test_independent_errors_are_as_stated_at_every_length(drive):
    for poses, slack in ((1, 0.1), (10, 0.2), (100, 0.5)):
        found = real_noise.along(drive, poses)
        assert found["both"] == pytest.approx(1.0, abs=slack)
        assert found["rotation"] == pytest.approx(1.0, abs=2.0 * slack)


def test_a_bias_grows_with_the_length(drive):
    """0.3 standard deviations a step: over 100 steps 0.09 · 100 = 9 variances more."""
    odometry, bias = drives.steps(drive.graph), np.zeros((drive.graph.num_edges, 3))
    sigma = np.asarray(drive.graph.information)[0, 2, 2] ** -0.5
    bias[odometry, 2] = 0.3 * sigma
    given = drive.graph.measurement
    moved = lie.compose(lie.as_numpy(given), lie.as_numpy(lie.exp(drive.graph.group, bias)))
    biased = drive._replace(graph=dataclasses.replace(drive.graph, measurement=moved))
    assert real_noise.along(biased, 1)["rotation"] < 1.3
    found = real_noise.along(biased, 100)
    assert 6.0 < found["rotation"] < 16.0
    assert abs(found["mean_heading_error_in_sigmas"]) == pytest.approx(3.0, abs=0.8)


def test_a_lever_arm_is_taken_out(drive):
    offset = lie.as_numpy(lie.exp(drive.graph.group, np.array([2.0, 0.5, 0.0])))
    count = drive.graph.num_poses
    beside = lie.compose(
        drive.truth, lie.group_of(offset)(np.tile(lie.parameters(offset), (count, 1)))
    )
    found = real_candidates.without_lever_arm(drive._replace(truth=beside))
    away = lie.translation(lie.as_numpy(found)) - lie.translation(drive.truth)
    assert np.abs(away).max() < 0.1


def test_realised_errors_are_those_of_the_noise():
    world = simulate_city(seed=2, poses=400)
    one = scaled_graph(world.graph, 1.0 / np.array([4.0, 4.0, 9.0, 9.0])).maps[0]
    found = real_noise.realised(one, lie.as_numpy(world.truth[0]))
    for kind, stated in (("odometry", 4.0), ("closures", 9.0)):
        for factor in found[kind].values():
            assert factor == pytest.approx(stated, rel=0.2)


def test_what_is_not_there_is_left_out(tmp_path):
    assert all(study(tmp_path) == {} for study in real_noise.STUDIES.values())
