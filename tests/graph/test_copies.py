"""Measurements that are stated twice, from either end, with either reading of the information."""

import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.files import coordinates
from pcm_jax.graph import LoopClosures
from pcm_jax.graph.copies import first_copies
from pcm_jax.graph.validation import argument_fault


def stated(group, count=4, seed=0):
    """Closures between two robots, all of one pair of poses."""
    rng = np.random.default_rng(seed)
    d = lie.tangent_dim(group)
    root = rng.normal(size=(count, d, d))
    information = root @ np.swapaxes(root, 1, 2) + np.eye(d)
    ends = np.tile([0, 3, 1, 5], (count, 1))
    return ends, lie.exp(group, rng.normal(size=(count, d))), information


def joined(*parts):
    ends, measurement, information = zip(*parts, strict=True)
    return np.concatenate(ends), lie.concatenate(list(measurement)), np.concatenate(information)


def inverted(ends, measurement, information, carry=True):
    """The other way round, as `LoopClosures.between` carries information over."""
    closures = LoopClosures.from_checked(
        tuple(ends.T), measurement, information, np.full(len(ends), "", object)
    )
    back = closures.between(1, 0)[0]
    other = np.asarray(back.information) if carry else information
    return ends[:, [2, 3, 0, 1]], lie.as_numpy(back.measurement), other


def test_repeated_lines_are_one(group):
    some = stated(group)
    found = first_copies(*joined(some, some, stated(group, seed=1)))
    assert found.tolist() == [0, 1, 2, 3, 0, 1, 2, 3, 8, 9, 10, 11]


@pytest.mark.parametrize("carry", [True, False])
def test_the_inverse_is_the_same_measurement(group, carry):
    some = stated(group)
    found = first_copies(*joined(some, inverted(*some, carry=carry)))
    assert found.tolist() == [0, 1, 2, 3, 0, 1, 2, 3]


def test_printed_to_six_digits(group):
    """Both ends print what they hold, rounded; the information has no small numbers to lose."""
    ends, measurement, information = stated(group)
    other = inverted(ends, measurement, information)

    def printed(values):
        return np.array([float(f"{x:.6g}") for x in np.ravel(values)]).reshape(np.shape(values))

    rounded = [
        (some[0], type(some[1])(printed(lie.parameters(some[1]))), printed(some[2]))
        for some in ((ends, measurement, information), other)
    ]
    assert first_copies(*joined(*rounded)).tolist() == [0, 1, 2, 3, 0, 1, 2, 3]


def printed(transforms, form):
    """The transforms that a file's columns of that form would be read as."""
    columns = coordinates.columns(np.asarray(lie.parameters(transforms)))
    rounded = np.array([float(form % x) for x in columns.ravel()]).reshape(columns.shape)
    kind = "angle" if columns.shape[1] == 3 else "quaternion"
    group = type(transforms)
    return lie.as_numpy(group(coordinates.parameters(kind, rounded, argument_fault("z"))))


@pytest.mark.parametrize("form", ["%.3f", "%.4f", "%.5f", "%.6g", "%.9f"])
@pytest.mark.filterwarnings("ignore::pcm_jax.InputWarning")  # 3 digits of a quaternion
def test_rounded_numbers_are_copies(group, form):
    """Of one pair of poses each; one program prints all digits, the others a few."""
    ends, measurement, information = stated(group, 500)
    ends = ends + np.arange(500)[:, None] * [0, 1, 0, 0]
    back, other, carried = inverted(ends, measurement, information)
    few = (ends, printed(measurement, form), information)
    turned = (back, printed(other, form), carried)
    whole = (ends, measurement, information)
    for one, two in ((whole, few), (few, turned), (whole, turned)):
        assert (first_copies(*joined(one, two))[500:] == np.arange(500)).mean() > 0.99


@pytest.mark.parametrize("form", ["%.3f", "%.6g"])
@pytest.mark.filterwarnings("ignore::pcm_jax.InputWarning")
def test_measurements_made_twice_are_two_however_few_digits_they_have(group, form):
    ends, measurement, information = stated(group, 500)
    ends = ends + np.arange(500)[:, None] * [0, 1, 0, 0]
    noise = 0.02 * np.random.default_rng(1).normal(size=(500, lie.tangent_dim(group)))
    again = lie.compose(measurement, lie.exp(group, noise))
    back, other, carried = inverted(ends, again, information)
    few = (ends, printed(measurement, form), information)
    for two in ((ends, printed(again, form), information), (back, printed(other, form), carried)):
        assert (first_copies(*joined(few, two))[500:] == np.arange(500)).mean() < 0.01


def test_short_numbers_are_exact():
    """1 and 1.0004 are two measurements: 1 need not be rounded."""
    ends = np.tile([0, 3, 1, 5], (3, 1))
    poses = jaxlie.SE2(np.array([[1.0, 0.0, x, 2.0] for x in (1.0, 1.0004, 1.0005)]))
    found = first_copies(ends, lie.as_numpy(poses), np.tile(np.eye(3), (3, 1, 1)))
    assert found.tolist() == [0, 1, 2]


def test_assumed_information_agrees_with_any(group):
    """And the measurement whose information was stated is the one that stays."""
    ends, measurement, information = stated(group, 3)
    other = np.tile(7.0 * np.eye(information.shape[-1]), (3, 1, 1))
    both = joined((ends, measurement, other), (ends, measurement, information))
    assumed = np.array([True, True, False, False, False, False])
    assert first_copies(*both, assumed).tolist() == [3, 4, 2, 3, 4, 5]
    assert first_copies(*both).tolist() == [0, 1, 2, 3, 4, 5]


def test_other_poses_and_other_numbers_are_others(group):
    ends, measurement, information = stated(group, 1)
    elsewhere = ends + np.array([0, 0, 0, 1])
    moved = lie.compose(measurement, lie.exp(group, np.full((1, lie.tangent_dim(group)), 1e-3)))
    found = first_copies(
        *joined(
            (ends, measurement, information),
            (elsewhere, measurement, information),
            (ends, moved, information),
            (ends, measurement, 1.001 * information),
        )
    )
    assert found.tolist() == [0, 1, 2, 3]


def test_thousands_of_one_pair_of_poses(group):
    """Sorted, not compared each with each: 40,000 would be 10⁹ comparisons."""
    some = stated(group, 20_000)
    found = first_copies(*joined(some, some))
    np.testing.assert_array_equal(found, np.tile(np.arange(20_000), 2))
