"""The stand-ins for City10000 and for drives with a front end's candidates."""

import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.experiments import cities, drives


def test_without_the_file_a_simulated_city_stands_in(tmp_path):
    """With square roots as information where City10000 has them."""
    graph, truth = cities.city10000(tmp_path, poses=200)
    exact, _ = cities.city10000(tmp_path, poses=200, information="sqrt")
    assert [one.num_poses for one in graph.maps] == [100, 100]
    assert [len(lie.parameters(poses)) for poses in truth] == [100, 100]
    np.testing.assert_allclose(
        np.asarray(graph.closures.information) ** 2, exact.closures.information
    )


def test_city10000_itself_is_cut_in_two(shared_data):
    graph, truth = cities.city10000(shared_data / "city10000", poses=300)
    assert [one.num_poses for one in graph.maps] == [150, 150]
    assert float(np.asarray(graph.maps[0].information)[0, 0, 0]) == 50.0
    assert len(lie.parameters(truth[1])) == 150


@pytest.mark.parametrize("aliased", [False, True])
def test_a_simulated_drive_is_wrong_as_its_collection_is(aliased):
    one = drives.simulated(1, aliased=aliased, poses=600)
    steps = drives.steps(one.graph)
    wrong = ~one.is_true & ~steps
    said = np.abs(np.asarray(lie.log(lie.as_numpy(one.graph.measurement)))[wrong]).max(axis=1)
    error = drives.errors(one.graph, one.truth)
    assert steps.sum() == 599
    assert wrong.sum() > 30
    assert (said < 1e-9).all() != aliased
    assert np.abs(error[one.is_true]).max() < 0.5
    assert np.linalg.norm(error[wrong, :2], axis=1).max() > 10.0
    if aliased:  # they agree with each other: one street for another
        moved = [lie.take(one.truth, np.asarray(end)[wrong]) for end in (one.graph.tail,)]
        ends = lie.take(one.truth, np.asarray(one.graph.head)[wrong])
        measured = lie.take(lie.as_numpy(one.graph.measurement), np.flatnonzero(wrong))
        between = lie.compose(lie.compose(moved[0], measured), lie.inverse(ends))
        np.testing.assert_allclose(
            np.asarray(lie.log(between)), np.tile([30.0, 20.0, 0.5], (wrong.sum(), 1)), atol=1e-9
        )


def test_two_robots_of_one_drive_know_nothing_of_each_other():
    one = drives.simulated(2, aliased=False, poses=300)
    two = drives.sessions(one.graph, 120, "odometry")
    assert [each.num_poses for each in two.maps] == [120, 180]
    assert [each.num_edges for each in two.maps] == [119, 179]
    for each in two.maps:
        np.testing.assert_allclose(np.asarray(lie.log(lie.take(each.poses, 0))), 0.0, atol=1e-12)
    assert len(two.closures) == len(drives.across(one.graph, 120))
    first, second = drives.sessions_truth(one, 120)
    assert (len(lie.parameters(first)), len(lie.parameters(second))) == (120, 180)
