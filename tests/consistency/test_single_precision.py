"""float32: how close squared distances stay, and the warning where they do not."""

import warnings

import consistency_worlds as worlds
import jax
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.consistency import consistency_problem, squared_mahalanobis
from pcm_jax.consistency._single_precision import TOLERANCE, single_precision_error
from pcm_jax.errors import InputError, InputWarning


def stretched(group, scale, seed=3, count=40):
    """A problem whose maps reach `scale` times as far, at the same noise."""
    map_a, map_b, closures = worlds.random_world(group, seed, count)
    space = 3 if lie.tangent_dim(group) == 6 else 2
    maps = []
    for pose_graph in (map_a, map_b):
        values = np.array(lie.parameters(lie.as_numpy(pose_graph.poses)))
        values[:, -space:] *= scale
        maps.append(pose_graph.with_poses(group(values)))
    return consistency_problem(*maps, closures)


def worst(problem, single):
    """The largest change of all pairs, as `single_precision_error` measures it of some."""
    exact, found = (np.asarray(squared_mahalanobis(each)) for each in (problem, single))
    d = problem.measurement_covariance.shape[-1]
    return (np.abs(found.astype(float) - exact) / np.maximum(exact, d)).max()


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 10.0])
def test_well_conditioned_distances_keep_three_digits(group, scale):
    problem = stretched(group, scale)
    single = problem.astype(np.float32)  # a warning would be an error
    assert worst(problem, single) < TOLERANCE
    assert squared_mahalanobis(single).dtype == np.float32


def test_a_sample_tells_what_all_pairs_lose(group):
    for scale in (1.0, 10.0, 100.0):
        problem = stretched(group, scale)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)
            single = problem.astype(np.float32)
        measured = worst(problem, single)
        assert measured / 4 < single_precision_error(problem) < 4 * measured


@pytest.mark.parametrize("scale", [100.0, 1e4])  # the second one leaves numbers that are none
def test_maps_too_large_for_the_closures_are_warned_of(group, scale):
    with pytest.warns(
        InputWarning, match="dtype: float32 moves these squared distances .* of their value"
    ):
        stretched(group, scale).astype(np.float32)


def test_precision_there_and_back(group):
    problem = stretched(group, 1.0)
    single = problem.astype(np.float32)
    again = single.astype(np.float64)
    for leaf, narrow, wide in zip(*map(jax.tree.leaves, (problem, single, again)), strict=True):
        if leaf.dtype == np.float64:
            assert (narrow.dtype, wide.dtype) == (np.float32, np.float64)
            np.testing.assert_allclose(leaf, wide, rtol=1e-6)
        else:
            np.testing.assert_array_equal(leaf, narrow)


def test_nothing_is_lost_without_pairs(group):
    map_a, map_b, closures = worlds.random_world(group, 0, 2)
    for count in (0, 1):
        problem = consistency_problem(map_a, map_b, closures[np.arange(count)])
        assert single_precision_error(problem) == 0.0


def test_other_types_are_refused(group):
    with pytest.raises(InputError, match="dtype: 'int32', expected float32 or float64"):
        stretched(group, 1.0).astype("int32")
