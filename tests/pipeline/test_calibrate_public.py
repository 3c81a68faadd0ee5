"""Calibrations of public files, by what is known of them: square roots, drift that is no noise."""

import numpy as np
import pytest

import pcm_jax
from pcm_jax.experiments import cities, drives

pytestmark = pytest.mark.slow


def test_city10000_states_square_roots(shared_data):
    """50 and 100, of 2,000 poses cut in halves: within a tenth, and in the intervals."""
    graph, _ = cities.city10000(shared_data / "city10000")
    found = pcm_jax.calibrate(graph)
    assert found.accepted.all()
    for factor, stated in zip(found.factors, (50.0, 100.0, 50.0, 100.0), strict=True):
        assert factor == pytest.approx(stated, rel=0.1)
        assert factor.interval[0] < stated < factor.interval[1]
    assert "--information sqrt" in str(found)
    assert not found.growth.uneven


def test_two_robots_whose_closures_contradict_each_other_as_stated(shared_data):
    folder = shared_data / "multirobot_rdm/argos_simulation/clean/example_2robots"
    graph = pcm_jax.read_graph(*sorted(folder.glob("*.g2o.xz")))
    assert pcm_jax.select(graph).accepted.sum() < 5
    found = pcm_jax.calibrate(graph)
    assert found.accepted.all()
    assert found.odometry.translation.interval[1] < 0.5
    assert found.closures.rotation.interval[1] < 0.1
    assert "few of 34 closures between robots agree, under these factors 34 do" in str(found)
    assert pcm_jax.merge(found.apply(graph)).accepted.sum() >= 30


def test_kittis_drift_is_no_noise(shared_data):
    """Loops of 1,000 poses and more say 0.43 of odometry's information, shorter ones several."""
    drive = drives.load(shared_data, "kitti_00_alpha_1.00")
    found = pcm_jax.calibrate(drive.graph)
    assert found.left_out >= 10
    assert found.growth.uneven
    assert "odometry's errors grow faster with the way" in str(found)
    for factor in found.odometry:
        assert factor.interval[0] < 0.43 < factor.interval[1]
    times = np.array([one.times for one in found.growth.lengths])
    assert times[-1] > 2.0 * times[:-1].max()
