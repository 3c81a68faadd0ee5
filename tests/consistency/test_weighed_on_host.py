"""Q in NumPy against the compiled kernel."""

import numpy as np
import pytest

from pcm_jax import squared_mahalanobis, weigh
from pcm_jax.compiling import ALWAYS
from pcm_jax.consistency import weighed_on_host
from pcm_jax.simulation import simulate_city, simulate_sessions


@pytest.mark.slow
@pytest.mark.parametrize("simulate", [simulate_city, simulate_sessions])
def test_equals_the_compiled_kernel(simulate, monkeypatch):
    world = simulate(seed=3, poses=40, inliers=6, aliased_groups=0, random=90)
    problem = weigh(world.graph).pairs[0].problem()
    ours = weighed_on_host(problem).squared
    assert type(ours) is np.ndarray and ours.shape == (96, 96)
    expected = np.asarray(squared_mahalanobis(problem))
    np.testing.assert_allclose(ours, expected, rtol=1e-11, atol=1e-11)
    monkeypatch.setenv(ALWAYS, "always")
    np.testing.assert_array_equal(weighed_on_host(problem).squared, expected)


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_a_pair(count):
    world = simulate_city(seed=3, poses=40, inliers=6, aliased_groups=0, random=0)
    graph = type(world.graph)(world.graph.maps, world.graph.closures[:count])
    pairs = weigh(graph).pairs
    assert [pair.squared.tolist() for pair in pairs] == [[[0.0]]] * count
