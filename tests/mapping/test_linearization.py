"""Closed-form Jacobians against automatic differentiation through the retraction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.mapping._linearization import linearize, retract, whitened_residual
from pcm_jax.mapping.least_squares import padded_edges
from pcm_jax.mapping.optimization import host_arrays


@pytest.mark.slow
def test_jacobians_are_the_derivatives_of_the_residual(group, make_map):
    graph = make_map(group, poses=7, loops=4, noise=0.3)
    edges = jax.tree.map(jnp.asarray, padded_edges(*host_arrays(graph), size=256))
    d, n, e = graph.tangent_dim, graph.num_poses, edges.tail.shape[0]

    def moved(step):
        return whitened_residual(retract(graph.poses, step), edges)

    expected = jax.jit(jax.jacfwd(moved))(jnp.zeros((n, d)))  # [d, e, n, d]
    residual, by_tail, by_head = jax.jit(linearize)(graph.poses, edges)
    found = np.zeros((d, e, n, d))
    for k in range(e):
        found[:, k, edges.tail[k]] += by_tail[:, :, k]
        found[:, k, edges.head[k]] += by_head[:, :, k]
    np.testing.assert_allclose(residual, moved(jnp.zeros((n, d))), atol=1e-12)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_cost_is_that_of_the_full_logarithm(group, make_map):
    graph = make_map(group, noise=0.2)
    edges = padded_edges(*host_arrays(graph), size=256)
    relative = lie.between(lie.take(graph.poses, graph.tail), lie.take(graph.poses, graph.head))
    r = np.asarray(lie.log(lie.between(graph.measurement, relative)))
    expected = 0.5 * np.einsum("ei,eij,ej->", r, np.asarray(graph.information), r)
    found = 0.5 * float(jnp.sum(whitened_residual(graph.poses, edges) ** 2))
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_padded_edges_weigh_nothing(group, make_map):
    graph = make_map(group, poses=9, loops=3)
    edges = padded_edges(*host_arrays(graph), size=256)
    assert edges.tail.shape[0] > graph.num_edges
    for part in jax.jit(linearize)(graph.poses, edges):
        assert not np.asarray(part)[..., graph.num_edges :].any()


def test_kernels_follow_their_inputs_dtype(group, make_map):
    graph = make_map(group)
    edges = padded_edges(*host_arrays(graph), size=256)
    single = jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float32) if x.dtype == np.float64 else jnp.asarray(x),
        (lie.as_numpy(graph.poses), edges),
    )
    assert {part.dtype for part in jax.jit(linearize)(*single)} == {np.dtype(np.float32)}


def test_retraction_stays_on_the_group(group, make_map):
    poses = make_map(group).poses
    step = 0.3 * jax.random.normal(jax.random.key(0), (30, lie.tangent_dim(group)))
    for _ in range(50):
        poses = retract(poses, step)
    rotation = np.asarray(lie.as_matrix(poses))[:, :-1, :-1]
    identity = np.broadcast_to(np.eye(rotation.shape[-1]), rotation.shape)
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), identity, atol=1e-13)
