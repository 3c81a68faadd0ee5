"""The scale of odometry's errors: the likelihood it is found by, and maps whose scale is known."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from pcm_jax import lie
from pcm_jax.consistency import OwnLoops, odometry_edges, own_loops, within_problem
from pcm_jax.graph import PoseGraph
from pcm_jax.integrity.odometry import LARGEST, odometry_scale
from pcm_jax.simulation import simulate_city

EXTENT = np.array([30.0, 20.0])


def drawn(count, factor, rng, d=3, wrong=0):
    """Loops of right closures whose odometry errs `factor` times as much as stated, and others."""
    shape = rng.normal(size=(count, d, d))
    odometry = 1e-4 * shape @ shape.swapaxes(1, 2) + 1e-4 * np.eye(d)
    measured = np.tile(1e-5 * np.eye(d), (count, 1, 1))
    total = factor**2 * odometry + measured
    error = (np.linalg.cholesky(total) @ rng.normal(size=(count, d, 1)))[..., 0]
    error[:wrong] = rng.uniform(-1.0, 1.0, (wrong, d)) * np.append(np.full(d - 1, 10.0), np.pi)
    return OwnLoops(error, odometry, measured)


def log_likelihood(loops, factor, share):
    wrong = 1.0 / (EXTENT.prod() * 2.0 * np.pi)
    right = [
        multivariate_normal(cov=factor**2 * odometry + measured).pdf(error)
        for error, odometry, measured in zip(*loops, strict=True)
    ]
    return np.log(share * np.array(right) + (1.0 - share) * wrong).sum()


def test_no_other_factor_or_share_is_likelier():
    loops = drawn(60, 4.0, np.random.default_rng(0), wrong=20)
    scale = odometry_scale(loops, EXTENT)
    best = log_likelihood(loops, scale.factor, scale.share)
    assert scale.gain == pytest.approx(best - log_likelihood(loops, 1.0, 0.0), rel=1e-9)
    for factor in (0.7, 0.84, 1.19, 1.4):
        for share in (0.9, 1.0, 1.1):
            assert log_likelihood(loops, factor * scale.factor, share * scale.share) < best


@pytest.mark.parametrize("d", [3, 6])
def test_known_scales_are_found(d):
    extent = EXTENT if d == 3 else np.append(EXTENT, 5.0)
    rng = np.random.default_rng(1)
    for factor in (1.0, 2.0, 6.0, 15.0):
        found = odometry_scale(drawn(100, factor, rng, d), extent)
        assert 0.8 < found.factor / factor < 1.25
        assert found.share > 0.99
        assert found.found


def test_odometry_better_than_stated_is_as_stated():
    found = odometry_scale(drawn(50, 0.2, np.random.default_rng(2)), EXTENT)
    assert found.factor == 1.0


def test_no_scale_explains_what_is_anywhere():
    loops = drawn(100, 1.0, np.random.default_rng(3), wrong=100)
    found = odometry_scale(loops, EXTENT)
    assert not found.found
    assert not odometry_scale(loops.take(slice(0)), EXTENT).found
    right = drawn(100, 1.5 * LARGEST, np.random.default_rng(4))
    assert odometry_scale(right, EXTENT).factor == LARGEST
    assert not odometry_scale(right, EXTENT).found


def test_own_loops_are_the_problems():
    """The same q² as the compiled kernel's, and of shuffled measurements as of a shuffled map."""
    from pcm_jax.consistency import reordered, squared_own_loops

    graph = simulate_city(seed=0, poses=60).graph.maps[0]
    problem = within_problem(graph)
    count = graph.num_edges - len(odometry_edges(graph))
    order = np.random.default_rng(0).permutation(count)
    for given, expected in ((None, problem), (order, reordered(problem, order))):
        loops = own_loops(problem, given)
        total = loops.odometry + loops.measured
        squared = np.einsum("ui,uij,uj->u", loops.error, np.linalg.inv(total), loops.error)
        np.testing.assert_allclose(squared, np.asarray(squared_own_loops(expected)), rtol=1e-8)
    closures = np.setdiff1d(np.arange(graph.num_edges), odometry_edges(graph))
    rows = np.arange(graph.num_edges)
    rows[closures] = closures[order]
    turned = np.asarray(graph.tail > graph.head)
    if turned[closures].any():
        pytest.skip("closures of this world run backwards")
    swapped = PoseGraph(
        poses=graph.poses,
        tail=graph.tail,
        head=graph.head,
        measurement=lie.take(lie.as_numpy(graph.measurement), rows),
        information=np.asarray(graph.information)[rows],
    )
    np.testing.assert_allclose(own_loops(within_problem(swapped)).error, loops.error, atol=1e-12)
