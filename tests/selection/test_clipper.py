"""CLIPPER's relaxation against enumeration of what it relaxes."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from pcm_jax.errors import InputError
from pcm_jax.selection import select_from
from pcm_jax.selection.methods import clipper as module
from pcm_jax.selection.methods.clipper import SUPPORT, _relaxed, clipper

GATE = 6.63


def distances_of(places: np.ndarray) -> np.ndarray:
    """Q of direct measurements of one number, variance 1."""
    return np.subtract.outer(places, places) ** 2 / 2


def clutter(seed: int, count: int, inliers: int) -> np.ndarray:
    generator = np.random.default_rng(seed)
    places = np.append(
        generator.normal(0.0, 1.0, inliers), generator.uniform(-8.0, 8.0, count - inliers)
    )
    return distances_of(generator.permutation(places))


def spectral_value(squared: np.ndarray, members: np.ndarray) -> float:
    """The largest uᵀMu of unit vectors on a clique."""
    affinity = np.exp(-0.5 * squared[np.ix_(members, members)])
    return float(np.linalg.eigvalsh(affinity)[-1])


def best_value(squared: np.ndarray) -> float:
    """The largest over all cliques, by enumeration."""
    count, consistent = len(squared), squared <= GATE
    subsets = itertools.product([False, True], repeat=count)
    masks = (np.array(mask) for mask in subsets if any(mask))
    return max(spectral_value(squared, m) for m in masks if consistent[np.ix_(m, m)].all())


def test_the_tighter_of_two_equal_cliques():
    squared = distances_of(np.array([0.0, 30.0, 1.5, 30.1, 3.0, 30.2]))
    assert np.flatnonzero(clipper(squared, GATE).members).tolist() == [1, 3, 5]


@pytest.mark.parametrize(("apart", "expected"), [(0.6, [0, 1, 2, 3]), (1.0, [4, 5, 6])])
def test_a_loose_large_clique_against_a_tight_small_one(apart, expected):
    """Four with affinity exp(−q²/2) have 1 + 3 exp(−q²/2), three that coincide 3: q² = 0.81."""
    squared = np.full((7, 7), 100.0)
    squared[:4, :4] = apart
    squared[4:, 4:] = 0.0
    np.fill_diagonal(squared, 0.0)
    assert np.flatnonzero(clipper(squared, GATE).members).tolist() == expected
    assert select_from(squared, GATE).tolist() == [True] * 4 + [False] * 3


@pytest.mark.parametrize("seed", range(20))
def test_it_is_a_maximal_clique(seed):
    squared = clutter(seed, 40, 8)
    members = clipper(squared, GATE).members
    consistent = squared <= GATE
    assert consistent[np.ix_(members, members)].all()
    assert not consistent[:, members].all(axis=1)[~members].any()


@pytest.mark.parametrize("seed", range(5))
def test_the_penalty_leaves_a_clique_for_the_check_to_find(seed):
    consistent = (squared := clutter(seed, 40, 8)) <= GATE
    affinity = np.where(consistent, np.exp(-0.5 * squared), 0.0)
    support = (u := _relaxed(affinity, (~consistent).astype(float))) > SUPPORT * u.max()
    assert consistent[np.ix_(support, support)].all()


@pytest.mark.parametrize("seed", range(5))
def test_the_first_ascent_is_without_a_penalty_and_the_check_leaves_a_clique(seed, monkeypatch):
    """One ascent stays at the eigenvector of the largest eigenvalue, whose support is none."""
    monkeypatch.setattr(module, "MOST_PENALTIES", 1)
    consistent = (squared := clutter(seed, 40, 8)) <= GATE
    affinity = np.where(consistent, np.exp(-0.5 * squared), 0.0)
    u = _relaxed(affinity, (~consistent).astype(float))
    assert u.min() > -1e-12
    np.testing.assert_allclose(affinity @ u, np.linalg.norm(affinity, 2) * u, atol=1e-8)
    support = u > SUPPORT * u.max()
    assert not consistent[np.ix_(support, support)].all()
    members = clipper(squared, GATE).members
    assert consistent[np.ix_(members, members)].all()
    assert members[np.argmax(u)]


def test_it_finds_what_it_relaxes_nearly_always():
    """A local ascent of the problem max over cliques of max uᵀMu, which is enumerated here."""
    worlds = [clutter(seed, 9, 4) for seed in range(30)]
    values = [spectral_value(squared, clipper(squared, GATE).members) for squared in worlds]
    ratio = np.array(values) / [best_value(squared) for squared in worlds]
    assert ratio.max() <= 1.0 + 1e-9
    assert np.mean(ratio > 1.0 - 1e-9) >= 0.9
    assert ratio.min() > 0.7


def test_the_order_of_measurements_does_not_matter():
    squared = clutter(3, 30, 8)
    shuffle = np.random.default_rng(1).permutation(30)
    members = clipper(squared, GATE).members
    np.testing.assert_array_equal(
        clipper(squared[np.ix_(shuffle, shuffle)], GATE).members, members[shuffle]
    )


def test_by_name():
    squared = distances_of(np.array([20.0, 0.0, -30.0, 0.2, 0.5, 20.4, 60.0]))
    np.fill_diagonal(squared, np.nan)
    assert np.flatnonzero(select_from(squared, GATE, method="clipper")).tolist() == [1, 3, 4]
    with pytest.raises(InputError, match="affinity: not an option of method 'clipper'"):
        select_from(squared, GATE, method="clipper", affinity="binary")


def test_no_measurement_and_one_measurement():
    assert clipper(np.zeros((0, 0)), GATE).members.shape == (0,)
    assert clipper(np.zeros((1, 1)), GATE).members.tolist() == [True]


def test_both_directions_must_pass_and_nan_agrees_with_nothing():
    squared = np.array([[0.0, 1.0, 9.0], [1.0, 0.0, 9.0], [1.0, 1.0, 0.0]])
    assert clipper(squared, GATE).members.tolist() == [True, True, False]
    squared = np.array([[0.0, np.nan, 1.0], [np.nan, 0.0, np.nan], [1.0, np.nan, 0.0]])
    assert clipper(squared, GATE).members.tolist() == [True, False, True]


def test_nothing_consistent_keeps_one():
    squared = np.full((5, 5), 100.0)
    assert clipper(squared, GATE).members.sum() == 1


def test_a_chain_ends_in_a_pair():
    squared = distances_of(np.array([0.0, 3.0, 6.2]))
    assert clipper(squared, GATE).members.tolist() == [True, True, False]
