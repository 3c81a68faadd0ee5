"""Measurements that are stated twice, from either end, with either reading of the information."""

import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.graph import LoopClosures
from pcm_jax.graph.copies import first_copies


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
