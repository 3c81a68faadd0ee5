"""The one-dimensional world: its laws, by p-values at fixed seeds."""

import numpy as np
import pytest
from scipy import stats

from pcm_jax.errors import InputError
from pcm_jax.simulation import simulate_one_dimensional


def test_every_world_has_the_measurements_asked_for_in_an_order_of_its_own():
    worlds = simulate_one_dimensional(seed=1, worlds=500, inliers=7, aliased=3, random=5)
    assert all(array.shape == (500, 15) for array in worlds)
    for label, count in ((0, 7), (1, 3), (-1, 5)):
        assert ((worlds.labels == label).sum(axis=1) == count).all()
    assert len(np.unique(worlds.labels, axis=0)) > 490


def test_inliers_and_aliased_outliers_are_normal_around_their_places():
    worlds = simulate_one_dimensional(
        seed=2, worlds=400, position=3.0, aliased_position=-5.0, sigma=0.7
    )
    for label, place in ((0, 3.0), (1, -5.0)):
        rows = worlds.labels == label
        assert np.all(worlds.variances[rows] == pytest.approx(0.49))
        white = (worlds.measurements[rows] - place) / 0.7
        assert stats.kstest(white, "norm").pvalue > 0.01


def test_random_outliers_have_means_and_variances_of_their_own():
    worlds = simulate_one_dimensional(
        seed=3, worlds=400, random_positions=(-9.0, 9.0), random_sigmas=(0.001, 0.002)
    )
    rows = worlds.labels == -1
    sigmas = np.sqrt(worlds.variances[rows])
    assert stats.kstest(sigmas, "uniform", (0.001, 0.001)).pvalue > 0.01
    # With so little noise the measurement is its mean, uniform over the range given.
    assert stats.kstest(worlds.measurements[rows], "uniform", (-9.0, 18.0)).pvalue > 0.01


def test_consistent_pairs_follow_chi_squared_and_others_do_not():
    worlds = simulate_one_dimensional(seed=4, worlds=3_000, inliers=2, aliased=2, random=1)
    squared = worlds.squared_mahalanobis()
    assert np.array_equal(squared, np.swapaxes(squared, 1, 2))
    for label in (0, 1):
        rows = [np.flatnonzero(row == label) for row in worlds.labels]
        pairs = squared[np.arange(3_000), [r[0] for r in rows], [r[1] for r in rows]]
        assert stats.kstest(pairs, "chi2", (1,)).pvalue > 0.01
    first = np.argmax(worlds.labels == 0, axis=1)
    other = np.argmax(worlds.labels == 1, axis=1)
    assert np.mean(squared[np.arange(3_000), first, other] > stats.chi2.ppf(0.99, 1)) > 0.99


def test_the_seed_decides_everything():
    first, again = (simulate_one_dimensional(seed=5, worlds=20) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    other = simulate_one_dimensional(seed=6, worlds=20)
    assert not np.array_equal(first.measurements, other.measurements)


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"inliers": -1}, "inliers"),
        ({"worlds": 0}, "worlds"),
        ({"inliers": 0, "aliased": 0, "random": 0}, "random"),
        ({"sigma": 0.0}, "sigma"),
        ({"random_sigmas": (-1.0, 2.0)}, "random_sigmas"),
    ],
)
def test_impossible_worlds_are_refused_by_name(wrong, name):
    with pytest.raises(InputError, match=name):
        simulate_one_dimensional(**wrong)
