"""Every method on cases worked by hand, and the exact one against enumeration."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from pcm_jax.errors import InputError, InputWarning
from pcm_jax.selection import METHODS, select_from
from pcm_jax.simulation import simulate_one_dimensional

GATE = 2.0
OF_DISTANCES = [name for name, method in METHODS.items() if method.choose is not None]


def distances_of(*places: float) -> np.ndarray:
    """Q of direct measurements of one number, variance 1: within the gate up to 2 apart."""
    return np.subtract.outer(places, places) ** 2 / 2


def kept(squared: np.ndarray, gate: float = GATE, **options) -> list[int]:
    return np.flatnonzero(select_from(squared, gate, **options)).tolist()


@pytest.mark.parametrize("method", OF_DISTANCES)
def test_every_method_keeps_the_one_obvious_group(method):
    # {1, 3, 4} within 0.5 of one another; two others agree, the rest stands alone.
    squared = distances_of(20.0, 0.0, -30.0, 0.2, 0.5, 20.4, 60.0)
    assert kept(squared, method=method) == [1, 3, 4]


@pytest.mark.parametrize("method", OF_DISTANCES)
def test_no_measurement_and_one_measurement(method):
    assert select_from(np.zeros((0, 0)), GATE, method=method).shape == (0,)
    assert kept(np.zeros((1, 1)), method=method) == [0]


@pytest.mark.parametrize("method", OF_DISTANCES)
def test_the_diagonal_does_not_matter(method):
    squared = distances_of(20.0, 0.0, -30.0, 0.2, 0.5, 20.4, 60.0)
    np.fill_diagonal(squared, np.nan)
    assert kept(squared, method=method) == [1, 3, 4]


def test_a_chain_tells_the_methods_apart():
    # 0 - 2 - 4: the ends agree with the middle, not with each other.
    squared = distances_of(0.0, 2.0, 4.0)
    assert kept(squared, method="pcm-exact") == [0, 1]
    assert kept(squared, method="combinatorial") == [0, 1]
    assert kept(squared, method="ransac") == [0, 1, 2]
    # Averages of the binary affinity: the middle alone 1, all three 7/3.
    assert kept(squared, method="scgp", affinity="binary") == [0, 1, 2]


@pytest.mark.parametrize("method", ["pcm-exact", "pcm-heuristic", "combinatorial", "ransac"])
def test_both_directions_must_pass(method):
    squared = np.array([[0.0, 1.0, 9.0], [1.0, 0.0, 9.0], [1.0, 1.0, 0.0]])
    assert kept(squared, method=method) == [0, 1]


@pytest.mark.parametrize("method", OF_DISTANCES)
def test_what_is_not_a_number_agrees_with_nothing(method):
    squared = np.array([[0.0, np.nan, 1.0], [np.nan, 0.0, np.nan], [1.0, np.nan, 0.0]])
    assert kept(squared, method=method) == [0, 2]


def test_the_gate_is_inclusive_and_equal_sets_go_by_index():
    squared = distances_of(10.0, 0.0, 12.0, 2.0)
    for method in ("pcm-exact", "combinatorial", "ransac"):
        assert kept(squared, method=method) == [0, 2], method
        assert kept(squared, np.nextafter(GATE, 0), method=method) == [0], method


def test_ransac_prefers_the_smaller_total_among_equal_supports():
    squared = distances_of(0.0, 2.0, 10.0, 11.0)
    assert kept(squared, method="ransac") == [2, 3]


def test_pcm_prefers_the_smaller_total_when_asked():
    squared = distances_of(0.0, 2.0, 10.0, 11.0)
    assert kept(squared) == [0, 1]
    assert kept(squared, tie_break="distance") == [2, 3]


def test_scgp_affinities_by_hand():
    # A tight pair and a looser triple, apart. Gaussian affinities exp(-q²/2):
    # the pair's average is 1 + a, the triple's 1 + 2b.
    q2 = np.full((5, 5), 1e6)
    q2[:2, :2], q2[2:, 2:] = 0.02, 1.8
    assert 1 + np.exp(-0.01) > 1 + 2 * np.exp(-0.9)
    assert kept(q2, method="scgp") == [0, 1]
    # Binary: 2 against 3. Linear, with 1 - q/γ: 1 + 0.9 against 1 + 2 (1 - sqrt 0.9).
    assert kept(q2, method="scgp", affinity="binary") == [2, 3, 4]
    assert kept(q2, method="scgp", affinity="linear") == [0, 1]


@pytest.mark.parametrize("affinity", ["linear", "binary"])
def test_scgp_with_a_gate_of_nothing(affinity):
    """Only what is no distance apart agrees."""
    q2 = np.full((4, 4), 1e-6)
    q2[1, 3] = q2[3, 1] = 0.0
    assert select_from(q2, 0.0, method="scgp", affinity=affinity).tolist() == [0, 1, 0, 1]


def test_scgp_beats_every_other_threshold():
    rng = np.random.default_rng(3)
    for _ in range(50):
        squared = distances_of(*rng.normal(scale=3, size=9))
        affinity = np.exp(-squared / 2)
        leading = np.abs(np.linalg.eigh(affinity)[1][:, -1])
        averages = [
            affinity[np.ix_(leading >= t, leading >= t)].sum() / (leading >= t).sum()
            for t in leading
        ]
        members = select_from(squared, GATE, method="scgp")
        got = affinity[np.ix_(members, members)].sum() / members.sum()
        np.testing.assert_allclose(got, max(averages), rtol=1e-12)


def test_exact_equals_enumeration_on_one_dimensional_worlds():
    worlds = simulate_one_dimensional(seed=5, worlds=60, inliers=6, aliased=4, random=4)
    sizes = []
    for squared in worlds.squared_mahalanobis():
        expected = select_from(squared, 3.84, method="combinatorial", with_certificate=True)
        exact = select_from(squared, 3.84, with_certificate=True)
        heuristic = select_from(squared, 3.84, method="pcm-heuristic", with_certificate=True)
        np.testing.assert_array_equal(exact.members, expected.members)
        assert exact.optimal
        assert exact.upper_bound == expected.upper_bound == expected.members.sum()
        assert heuristic.members.sum() <= expected.members.sum() <= heuristic.upper_bound
        sizes.append(expected.members.sum())
    assert len(set(sizes)) > 1


def test_methods_without_a_proof_claim_none():
    for method in ("ransac", "scgp"):
        choice = select_from(distances_of(0.0, 1.0), GATE, method=method, with_certificate=True)
        assert choice.optimal is None
        assert choice.upper_bound is None


def test_any_kind_of_array():
    squared = distances_of(0.0, 1.0, 50.0)
    for values in (jnp.asarray(squared), squared.astype(np.float32), squared.astype(int)):
        assert kept(values) == [0, 1]
    before = squared.copy()
    for method in OF_DISTANCES:
        kept(squared, method=method)
    np.testing.assert_array_equal(squared, before)


@pytest.mark.parametrize("method", ["pcm-exact", "pcm-heuristic"])
def test_weights_outvote_a_larger_set(method):
    # 0 and 1 agree, 2, 3 and 4 agree; the front end believes in the first two.
    squared = np.full((5, 5), 9.0)
    squared[:2, :2] = squared[2:, 2:] = 0.0
    weights = np.array([2.0, 2.5, 1.0, 1.0, 1.0])
    plain = select_from(squared, 1.0, method=method)
    heavy = select_from(squared, 1.0, method=method, weights=weights, with_certificate=True)
    assert plain.tolist() == [False, False, True, True, True]
    assert heavy.members.tolist() == [True, True, False, False, False]
    assert heavy.optimal
    assert heavy.upper_bound >= 3  # the bound on the size holds
    with pytest.raises(InputError, match=r"weights: shape \(4,\)"):
        select_from(squared, 1.0, method=method, weights=weights[:4])


@pytest.mark.parametrize(
    ("squared", "gate", "options", "message"),
    [
        (np.zeros((2, 3)), 1.0, {}, r"squared: shape \(2, 3\), expected \[m, m\]"),
        (np.zeros((2, 2), bool), 1.0, {}, "squared: dtype bool, expected numbers"),
        (np.zeros((2, 2)), -1.0, {}, "gate: -1.0"),
        (np.zeros((2, 2)), np.nan, {}, "gate: nan"),
        (np.zeros((2, 2)), np.ones(2), {}, "gate: "),
        (
            np.zeros((2, 2)),
            1.0,
            {"method": "guess"},
            "method: 'guess', expected one of pcm-exact, ",
        ),
        (np.zeros((2, 2)), 1.0, {"affinity": "binary"}, "affinity: not an option of method"),
        (np.zeros((2, 2)), 1.0, {"method": "ransac", "time_limit": 1.0}, "it has none"),
        (np.zeros((2, 2)), 1.0, {"method": "scgp", "affinity": "x"}, "affinity: 'x'"),
        (np.zeros((2, 2)), 1.0, {"tie_break": "x"}, "tie_break: 'x'"),
        (np.zeros((25, 25)), 1.0, {"method": "combinatorial"}, "expected at most 24"),
    ],
)
def test_bad_arguments_are_named(squared, gate, options, message):
    with pytest.raises(InputError, match=message):
        select_from(squared, gate, **options)


def test_a_confidence_where_a_gate_belongs_is_told():
    with pytest.warns(InputWarning, match=r"gate: 0.99, expected a squared distance .*chi2_gate"):
        select_from(np.zeros((3, 3)), 0.99)
