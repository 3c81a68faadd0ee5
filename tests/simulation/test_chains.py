"""Worlds drawn inside compiled programs: their Q, their law, and noise that is as stated."""

import functools

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy import stats

from pcm_jax import lie
from pcm_jax.consistency import chi2_gate, consistency_problem, squared_mahalanobis
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures, PoseGraph
from pcm_jax.simulation import simulate_chains
from pcm_jax.simulation.measurements import diagonal_covariance

pytestmark = pytest.mark.slow


LAW = {"poses": 61, "inliers": 8, "aliased_groups": 2, "aliased_size": 4, "random": 10}
CLOSURES, WORLDS = 26, 300


@functools.cache
def drawn(group):
    """Many worlds, and Q of each."""

    @jax.jit
    def draw(key):
        world = simulate_chains(key, group=group, **LAW)
        return world, squared_mahalanobis(world.problem)

    keys = jax.random.split(jax.random.key(5), WORLDS)
    world, squared = jax.lax.map(draw, keys, batch_size=50)
    return jax.tree.map(np.asarray, world), np.asarray(squared)


def one_of(tree, index):
    return jax.tree.map(lambda leaf: leaf[index], tree)


def as_graphs(world):
    """The same maps and closures as the host's containers."""
    group = lie.group_of(world.maps)
    noise = diagonal_covariance(group, 0.02, 0.002)
    maps = []
    for robot in (0, 1):
        poses = lie.take(world.maps, robot)
        steps = lie.between(lie.take(poses, np.s_[:-1]), lie.take(poses, np.s_[1:]))
        count = LAW["poses"] - 1
        ends = {"tail": np.arange(count), "head": np.arange(1, count + 1)}
        covariance = np.tile(noise, (count, 1, 1))
        maps.append(
            PoseGraph.from_arrays(poses=poses, measurement=steps, covariance=covariance, **ends)
        )
    closures = LoopClosures.from_arrays(
        robot_a=np.zeros(CLOSURES, int),
        pose_a=world.touched[0],
        robot_b=np.ones(CLOSURES, int),
        pose_b=world.touched[1],
        measurement=world.problem.measurement,
        covariance=world.problem.measurement_covariance,
    )
    return *maps, closures


def test_squared_distances_are_those_of_the_same_maps(group):
    """Joint marginals by sparse Cholesky, of maps that are not simulated ones any more."""
    worlds, squared = drawn(group)
    problem = consistency_problem(*as_graphs(one_of(worlds, 3)))
    expected = np.asarray(squared_mahalanobis(problem))
    assert np.ptp(np.log10(expected[expected > 0])) > 2
    np.testing.assert_allclose(squared[3], expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("label", [0, 1])
def test_pairs_that_agree_follow_chi_squared(group, label):
    """True pairs, and aliased ones, which share an alignment that is as good as any. One a world:
    pairs of one world are not independent."""
    worlds, squared = drawn(group)
    pairs = np.stack([np.flatnonzero(one == label)[:2] for one in worlds.labels])
    values = squared[np.arange(WORLDS), pairs[:, 0], pairs[:, 1]]
    d = lie.tangent_dim(group)
    assert stats.kstest(values, stats.chi2(d).cdf).pvalue > 0.01
    inside = int((values <= chi2_gate(0.95, d)).sum())
    assert stats.binomtest(inside, WORLDS, 0.95).pvalue > 0.01


def test_false_pairs_do_not(group):
    worlds, squared = drawn(group)
    gate = float(chi2_gate(0.99, lie.tangent_dim(group)))
    true = worlds.labels == 0
    mixed = true[:, :, None] & ~true[:, None]
    assert (squared[mixed] <= gate).mean() < 0.02


def test_the_law(group):
    """Steps of a metre along an axis, all in one town; closures as many as asked for."""
    worlds, _ = drawn(group)
    space = lie.module_of(group).MATRIX_DIM - 1
    places = lie.translation(worlds.truth)
    moves = np.abs(np.diff(places, axis=2))
    np.testing.assert_allclose(np.sort(moves, axis=-1)[..., -1], 1.0, atol=1e-12)
    np.testing.assert_allclose(moves.sum(axis=-1), 1.0, atol=1e-12)
    blocks = max(2, round((2 * LAW["poses"] / 25) ** (1 / space)))
    assert places.min() == 0.0
    assert places.max() == 5.0 * blocks
    rotation = lie.as_matrix(worlds.truth)[..., :space, :space]
    ahead = np.diff(places, axis=2)
    straight = np.einsum("wrnij,wrnj->wrni", rotation[:, :, 1:].swapaxes(-1, -2), ahead)
    np.testing.assert_allclose(straight[..., 0], 1.0, atol=1e-12)  # x looks ahead
    labels, counts = np.unique(worlds.labels, return_counts=True)
    assert labels.tolist() == [-1, 0, 1, 2]
    assert (counts / WORLDS).tolist() == [10, 8, 4, 4]
    assert len(np.unique(worlds.labels, axis=0)) == WORLDS  # shuffled


def test_robots_that_measure_each_other_are_near(group):
    worlds, _ = drawn(group)
    ends = [
        np.take_along_axis(lie.translation(lie.take(worlds.truth, np.s_[:, robot])), rows, axis=1)
        for robot, rows in enumerate(np.moveaxis(worlds.touched, 1, 0)[..., None])
    ]
    apart = np.linalg.norm(ends[0] - ends[1], axis=-1)[worlds.labels == 0]
    assert (apart <= 3.0 + 1e-9).mean() > (0.9 if group is jaxlie.SE2 else 0.6)
    assert apart.max() > 1.0


def test_maps_start_at_the_identity_and_drift_from_the_truth():
    worlds, _ = drawn(jaxlie.SE2)
    first = lie.parameters(lie.take(worlds.maps, np.s_[:, :, 0]))
    np.testing.assert_array_equal(first, np.broadcast_to([1.0, 0.0, 0.0, 0.0], first.shape))
    driven = lie.between(
        lie.take(worlds.truth, np.s_[:, :, 0]), lie.take(worlds.truth, np.s_[:, :, -1])
    )
    error = lie.log(lie.between(driven, lie.take(worlds.maps, np.s_[:, :, -1])))
    steps = LAW["poses"] - 1
    spread = error[..., 2].ravel() / (0.002 * steps**0.5)
    assert stats.kstest(spread, stats.norm.cdf).pvalue > 0.01


def test_deviations_may_be_traced():
    """Twice the noise of everything moves everything twice as far, to first order."""

    @jax.jit
    def world(scale):
        small = {"sigma_translation": 1e-6, "sigma_rotation": 1e-7}
        closing = {"closure_sigma_translation": 1e-6, "closure_sigma_rotation": 1e-7}
        noise = {name: scale * value for name, value in (small | closing).items()}
        law = LAW | {"aliased_groups": 0, "random": 0}
        return squared_mahalanobis(simulate_chains(jax.random.key(0), **law, **noise).problem)

    np.testing.assert_allclose(world(jnp.asarray(2.0)), world(jnp.asarray(1.0)), rtol=1e-4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"poses": 1}, "poses: 1 given, expected at least 2"),
        ({"random": -1}, "random: -1 given"),
        ({"sigma_rotation": 0.0}, "sigma_rotation: 0.0 given, expected a number above 0"),
        ({"inliers": 0, "aliased_groups": 0, "random": 0}, "expected a closure at least"),
    ],
)
def test_bad_arguments_are_named(changes, message):
    with pytest.raises(InputError, match=message):
        simulate_chains(jax.random.key(0), **changes)
