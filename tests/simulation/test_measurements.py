"""Noise, neighbours and drives: what simulated worlds are made of."""

import jaxlie
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.distance import cdist

from pcm_jax import lie
from pcm_jax.simulation._streets import block_poses, drive
from pcm_jax.simulation.measurements import diagonal_covariance, measure, near_pairs, revisits


@pytest.mark.parametrize("group", [jaxlie.SE2, jaxlie.SE3])
def test_measurement_noise_has_the_covariance_stated_on_the_right(group):
    generator = np.random.default_rng(0)
    d, count = lie.tangent_dim(group), 4_000
    truth = lie.exp(group, generator.standard_normal((count, d)))
    factor = np.tril(generator.standard_normal((d, d))) * 0.02
    covariance = factor @ factor.T
    noise = lie.log(lie.between(truth, measure(generator, truth, covariance)))
    squared = np.einsum("ni,ij,nj->n", noise, np.linalg.inv(covariance), noise)
    assert stats.kstest(squared, "chi2", (d,)).pvalue > 0.01
    assert stats.kstest(noise[:, 0] / np.sqrt(covariance[0, 0]), "norm").pvalue > 0.01


def test_each_measurement_may_have_a_covariance_of_its_own():
    covariance = np.stack([np.eye(3) * 1e-12, np.eye(3)])
    noise = lie.log(measure(np.random.default_rng(1), lie.identity(jaxlie.SE2, (2,)), covariance))
    assert np.abs(noise[0]).max() < 1e-5 < np.abs(noise[1]).max()


def test_diagonal_covariance_is_translation_first():
    assert np.diag(diagonal_covariance(jaxlie.SE2, 0.1, 0.2)) == pytest.approx([0.01, 0.01, 0.04])
    assert np.diag(diagonal_covariance(jaxlie.SE3, 0.1, 0.2)) == pytest.approx(
        [0.01] * 3 + [0.04] * 3
    )


def test_near_pairs_are_all_and_only_those_in_reach():
    generator = np.random.default_rng(2)
    # Integer places: many pairs at distance exactly 0 and exactly the reach.
    a, b = generator.integers(0, 8, (60, 2)), generator.integers(0, 8, (40, 2))
    expected = np.argwhere(cdist(a, b) <= 2.0)
    assert np.array_equal(near_pairs(a, b, 2.0), expected)


def test_revisits_tie_poses_that_return_to_a_spot_and_at_most_so_many():
    generator = np.random.default_rng(3)
    places = generator.integers(0, 12, (400, 2)).astype(float)
    loops = revisits(generator, places, spot=0.5, reach=2.0, most=2)
    earlier, later = loops.T
    distance = cdist(places, places)
    assert (later - earlier >= 10).all()
    assert (distance[earlier, later] <= 2.0).all()
    counts = np.bincount(later, minlength=len(places))
    for pose in range(len(places)):
        before = distance[pose, : max(pose - 9, 0)]
        expected = min(2, (before <= 2.0).sum()) if (before <= 0.5).any() else 0
        assert counts[pose] == expected


def test_revisits_of_a_path_that_never_returns_are_none():
    line = np.stack([np.arange(50.0), np.zeros(50)], axis=-1)
    assert revisits(np.random.default_rng(0), line, spot=0.5, reach=3.0, most=2).shape == (0, 2)


def test_a_drive_follows_streets_inside_the_city_and_never_turns_back():
    generator = np.random.default_rng(4)
    places, headings = drive(generator, crossings=3_000, blocks=6)
    assert places.min() == 0
    assert places.max() == 6
    assert (np.abs(np.diff(places, axis=0)).sum(axis=1) == 1).all()
    turns = np.diff(headings) % 4
    assert not (turns == 2).any()
    left, right = (turns == 1).mean(), (turns == 3).mean()
    assert abs(left - right) < 0.05
    assert len(np.unique(places, axis=0)) == 49


def test_block_poses_turn_as_they_leave_a_crossing():
    places, headings = np.array([[0, 0], [1, 0], [1, 1]]), np.array([0, 1])
    positions, looking = block_poses(places, headings, steps=2)
    assert positions.tolist() == [[0, 0], [0.5, 0], [1, 0], [1, 0.5], [1, 1]]
    assert looking.tolist() == [0, 0, 0, 1, 1]
