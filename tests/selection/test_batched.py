"""The batched kernels against the host's methods, world by world."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from pcm_jax.errors import InputError
from pcm_jax.selection import METHODS, select_from
from pcm_jax.selection.batched import KERNELS, select_batched
from pcm_jax.simulation import simulate_one_dimensional

GATE = 3.84


def kept(squared, gate, **options):
    return np.asarray(jax.jit(lambda q2: select_batched(q2, gate, **options))(squared))


def same_as_host(squared, gate, **options):
    expected = np.stack([select_from(one, gate, **options) for one in squared])
    np.testing.assert_array_equal(kept(squared, gate, **options), expected)
    return expected


def test_kernels_are_named_as_the_hosts_methods():
    assert set(KERNELS) <= set(METHODS)


@pytest.mark.parametrize("method", KERNELS)
def test_same_sets_as_the_host_on_one_dimensional_worlds(method):
    worlds = simulate_one_dimensional(
        seed=1, worlds=400, inliers=5, aliased=4, random=4, aliased_position=3.0
    )
    members = same_as_host(worlds.squared_mahalanobis(), GATE, method=method)
    assert len(np.unique(members.sum(axis=1))) > 3


@pytest.mark.parametrize("method", ["pcm-exact", "pcm-heuristic", "combinatorial"])
def test_same_sets_as_the_host_on_graphs_full_of_ties(method):
    """Random graphs of all densities: several largest sets each, unlike distances on a line."""
    rng = np.random.default_rng(2)
    squared = np.where(rng.random((300, 12, 12)) < rng.uniform(0.3, 1.0, (300, 1, 1)), 1.0, 9.0)
    same_as_host(squared, GATE, method=method)


@pytest.mark.slow
def test_heuristic_falls_short_where_the_hosts_does():
    rng = np.random.default_rng(3)
    squared = np.where(rng.random((300, 14, 14)) < 0.75, 1.0, 9.0)
    exact = kept(squared, GATE, method="pcm-exact").sum(axis=1)
    heuristic = kept(squared, GATE, method="pcm-heuristic").sum(axis=1)
    assert (heuristic <= exact).all()
    assert 0 < (heuristic < exact).sum() < 150


def test_scgp_where_the_largest_eigenvalues_nearly_tie_or_none_agrees():
    """Power iteration does not converge on the first world, and says nothing on the second."""
    squared = np.full((3, 9, 9), 1e4)
    squared[0, :4, :4], squared[0, 4:8, 4:8] = 1.0, 1.0 - 1e-6
    squared[2, 2:7, 2:7] = 0.5
    expected = same_as_host(squared, GATE, method="scgp")
    assert np.flatnonzero(expected[0]).tolist() == [4, 5, 6, 7]


def test_scgp_with_linear_affinities():
    worlds = simulate_one_dimensional(seed=4, worlds=200, inliers=6, aliased=0, random=3)
    same_as_host(worlds.squared_mahalanobis(), GATE, method="scgp", affinity="linear")


def test_scgp_with_binary_affinities():
    """Measurements with the same neighbours tie in the eigenvector: only averages must agree."""
    worlds = simulate_one_dimensional(seed=4, worlds=200, inliers=6, aliased=0, random=3)
    squared = worlds.squared_mahalanobis()
    options = {"method": "scgp", "affinity": "binary"}
    averages = []
    host = np.stack([select_from(one, GATE, **options) for one in squared])
    for members in (host, kept(squared, GATE, **options)):
        mask = members.astype(float)
        within = np.einsum("wu,wuv,wv->w", mask, squared <= GATE, mask)
        averages.append(within / mask.sum(axis=1))
    np.testing.assert_allclose(averages[0], averages[1], rtol=1e-12)


@pytest.mark.parametrize("method", KERNELS)
def test_what_is_not_a_number_agrees_with_nothing(method):
    squared = np.array([[0.0, np.nan, 1.0], [np.nan, 0.0, np.nan], [1.0, np.nan, 0.0]])
    assert kept(squared, GATE, method=method).tolist() == [True, False, True]


@pytest.mark.slow
@pytest.mark.parametrize("method", KERNELS)
def test_leading_axes_and_no_measurements(method):
    squared = simulate_one_dimensional(seed=5, worlds=6, inliers=3, aliased=1, random=1)
    flat = squared.squared_mahalanobis()
    members = kept(flat.reshape(2, 3, 5, 5), GATE, method=method)
    np.testing.assert_array_equal(members.reshape(6, 5), kept(flat, GATE, method=method))
    assert kept(np.zeros((4, 0, 0)), GATE, method=method).shape == (4, 0)
    assert kept(np.zeros((1, 1)), GATE, method=method).tolist() == [True]


@pytest.mark.parametrize(
    ("method", "bits"), [("pcm-exact", 64), ("pcm-exact", 128), ("combinatorial", 32)]
)
def test_a_whole_word(method, bits):
    """As many measurements as are accepted, the highest bit included."""
    squared = np.full((2, bits, bits), 9.0)
    group = np.array([0, 7, 15, 16, 30, bits - 1])
    squared[0][np.ix_(group, group)] = 1.0
    squared[1] = 1.0
    few, everything = kept(squared, GATE, method=method)
    assert np.flatnonzero(few).tolist() == group.tolist()
    assert everything.all()


@pytest.mark.parametrize(
    ("size", "options", "message"),
    [
        (33, {"method": "combinatorial"}, "33 measurements, expected at most 32"),
        (129, {"method": "pcm-exact"}, "129 measurements, expected at most 128"),
        (3, {"method": "guess"}, "method: 'guess', expected one of pcm-exact, "),
        (3, {"method": "scgp", "affinity": "x"}, "affinity: 'x', expected one of gaussian, "),
    ],
)
def test_bad_arguments_are_named(size, options, message):
    with pytest.raises(InputError, match=message):
        select_batched(np.zeros((size, size)), GATE, **options)
