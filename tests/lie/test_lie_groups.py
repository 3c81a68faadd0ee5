"""What makes these groups: axioms, adjoint identities, Jacobians, and JAX's transformations."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.lie import unrolled

GROUPS = [jaxlie.SE2, jaxlie.SE3, lie.R1]
groups = pytest.mark.parametrize("group", GROUPS, ids=lambda group: group.__name__)


def draw(group, count, seed, scale=1.0):
    return scale * np.random.default_rng(seed).normal(size=(count, lie.tangent_dim(group)))


def elements(group, count, seed):
    return lie.exp(group, draw(group, count, seed))


def assert_same(a, b, tolerance=1e-12):
    np.testing.assert_allclose(lie.as_matrix(a), lie.as_matrix(b), atol=tolerance, rtol=tolerance)


@groups
def test_group_axioms(group):
    a, b, c = (elements(group, 20, seed) for seed in range(3))
    assert_same(lie.compose(lie.compose(a, b), c), lie.compose(a, lie.compose(b, c)))
    assert_same(lie.compose(a, lie.inverse(a)), lie.identity(group, (20,)))
    assert_same(lie.compose(lie.identity(group, (20,)), a), a)
    assert_same(lie.between(a, b), lie.compose(lie.inverse(a), b))


@groups
def test_composition_is_multiplication_of_matrices(group):
    a, b = elements(group, 20, 3), elements(group, 20, 4)
    expected = lie.as_matrix(a) @ lie.as_matrix(b)
    np.testing.assert_allclose(lie.as_matrix(lie.compose(a, b)), expected, atol=1e-12)


@groups
def test_agrees_with_jaxlie_away_from_small_angles(group):
    a, b = (lie.as_device(elements(group, 20, seed)) for seed in (5, 6))
    assert_same(lie.compose(a, b), a @ b)
    assert_same(lie.inverse(a), a.inverse())
    np.testing.assert_allclose(lie.log(a), a.log(), atol=1e-10)
    np.testing.assert_allclose(lie.adjoint(a), a.adjoint(), atol=1e-12)
    np.testing.assert_allclose(lie.as_matrix(a), a.as_matrix(), atol=1e-12)


@groups
@pytest.mark.parametrize("size", [1e-9, 1e-3, 1.0])
def test_adjoint_identity(group, size):
    """T exp(δ) T⁻¹ = exp(Ad δ), exactly and for any δ."""
    transform, delta = elements(group, 20, 7), draw(group, 20, 8, size)
    left = lie.compose(lie.compose(transform, lie.exp(group, delta)), lie.inverse(transform))
    moved = np.einsum("nij,nj->ni", lie.adjoint(transform), delta)
    assert_same(left, lie.exp(group, moved))


@groups
@pytest.mark.parametrize("size", [0.0, 1e-7, 1e-2, 1.0])
def test_right_jacobian_is_the_derivative_of_exp(group, size):
    """Jr = d/dδ Log(exp(τ)⁻¹ exp(τ + δ)); its inverse is the derivative of Log at τ."""
    tau = jnp.asarray(draw(group, 1, 9, size)[0])
    base = lie.exp(group, tau)
    forward = jax.jacfwd(lambda x: lie.log(lie.between(base, lie.exp(group, x))))(tau)
    np.testing.assert_allclose(lie.right_jacobian(group, tau), forward, atol=1e-12)
    retract = jax.jacfwd(lambda x: lie.log(lie.compose(base, lie.exp(group, x))))
    backward = retract(jnp.zeros_like(tau))
    np.testing.assert_allclose(lie.right_jacobian_inverse(group, tau), backward, atol=1e-12)


@groups
def test_left_perturbations(group):
    """What turns right perturbations into left ones, and derivatives of parameters into either."""
    module, transform = lie.module_of(group), elements(group, 5, 16)
    a = lie.components(transform)
    tau, other = draw(group, 5, 17).T, draw(group, 5, 18).T
    adjoint = lie.adjoint(transform)
    covariance = np.einsum("in,jn->nij", tau, tau) + np.eye(len(tau))
    found = module.adjoint_sandwich(a, unrolled.from_array(covariance))
    expected = adjoint @ covariance @ adjoint.swapaxes(-1, -2)
    np.testing.assert_allclose(unrolled.to_array(found, like=a[0]), expected, atol=1e-11)

    def moved(step):
        return module.compose(module.exp(tuple(step * tau)), a)

    _, velocity = jax.jvp(moved, (0.0,), (1.0,))
    np.testing.assert_allclose(np.stack(module.left_tangent(a, velocity)), tau, atol=1e-13)

    def carried(step):
        return unrolled.apply(module.adjoint(module.exp(tuple(step * tau))), tuple(other))

    _, turned = jax.jvp(carried, (0.0,), (1.0,))
    for found, expected in zip(module.bracket(tuple(tau), tuple(other)), turned, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-13)


@groups
def test_matrices_round_trip(group):
    transform = elements(group, 50, 10)
    assert_same(lie.from_matrix(lie.as_matrix(transform)), transform, 1e-14)


def test_quaternions_of_every_kind_of_rotation():
    """Half turns and permutations, where one of the four ways to a quaternion divides by zero."""
    rotations = np.concatenate(
        [
            Rotation.create_group("O").as_matrix(),
            Rotation.random(200, rng=np.random.default_rng(11)).as_matrix(),
        ]
    )
    matrices = np.tile(np.eye(4), (len(rotations), 1, 1))
    matrices[:, :3, :3] = rotations
    for found in (lie.from_matrix(matrices), lie.from_matrix(jnp.asarray(matrices))):
        np.testing.assert_allclose(lie.as_matrix(found), matrices, atol=1e-15)


@groups
def test_numpy_and_jax_give_the_same_numbers(group):
    tangent = draw(group, 20, 12)
    host, device = lie.exp(group, tangent), lie.exp(group, jnp.asarray(tangent))
    assert isinstance(lie.parameters(host), np.ndarray)
    assert isinstance(lie.parameters(device), jax.Array)
    np.testing.assert_allclose(lie.parameters(host), lie.parameters(device), rtol=1e-13, atol=1e-15)
    for function in (lie.log, lie.adjoint, lie.as_matrix):
        assert isinstance(function(host), np.ndarray)
        np.testing.assert_allclose(function(host), function(device), rtol=1e-12, atol=1e-14)


@pytest.mark.slow
@groups
def test_jit_vmap_and_batch_axes(group):
    tangent = jnp.asarray(draw(group, 12, 13))

    def chain(x):
        transform = lie.exp(group, x)
        return lie.log(lie.compose(transform, lie.between(transform, lie.inverse(transform))))

    expected = np.stack([chain(row) for row in np.asarray(tangent)])
    np.testing.assert_allclose(jax.jit(jax.vmap(chain))(tangent), expected, atol=1e-13)
    batched = chain(tangent.reshape(3, 4, -1))
    np.testing.assert_allclose(batched.reshape(12, -1), expected, atol=1e-13)
    slope = jax.jit(jax.grad(lambda x: chain(x).sum()))(tangent)
    h = 1e-6 * np.eye(tangent.shape[1])
    steps = [
        chain(np.asarray(tangent) + e).sum(-1) - chain(np.asarray(tangent) - e).sum(-1) for e in h
    ]
    np.testing.assert_allclose(slope, np.stack(steps, -1) / 2e-6, rtol=1e-6, atol=1e-7)


@groups
def test_batches(group):
    transform = elements(group, 5, 14)
    doubled = lie.concatenate([transform, transform])
    assert_same(lie.take(doubled, np.array([1, 6])), lie.take(transform, np.array([1, 1])), 0.0)
    assert doubled.get_batch_axes() == (10,)
    assert lie.stack([transform] * 3).get_batch_axes() == (3, 5)
    padded = lie.pad_leading(transform, 8)
    assert_same(lie.take(padded, slice(4, None)), lie.take(transform, np.array([4] * 4)), 0.0)
    empty = lie.pad_leading(lie.take(transform, slice(0)), 2)
    assert_same(empty, lie.identity(group, (2,)), 0.0)
    assert_same(lie.from_components(group, lie.components(transform)), transform, 0.0)


@groups
def test_normalize(group):
    transform = elements(group, 5, 15)
    turning = lie.parameters(lie.identity(group)) * 0.0
    turning[: {jaxlie.SE2: 2, jaxlie.SE3: 4, lie.R1: 0}[group]] = 0.3
    stretched = group(lie.parameters(transform) * (1.0 + turning))
    assert_same(lie.normalize(stretched), transform)


@groups
def test_sizes_are_those_of_the_group(group):
    module = lie.module_of(group)
    assert group.parameters_dim == module.PARAMETERS_DIM
    assert group.tangent_dim == module.TANGENT_DIM
    assert group.matrix_dim == module.MATRIX_DIM


def test_unsupported_groups_are_refused():
    with pytest.raises(InputError, match="group: 'SO3' is not supported"):
        lie.tangent_dim(jaxlie.SO3)
    with pytest.raises(InputError, match=r"matrix: shape \(5, 3, 4\)"):
        lie.from_matrix(np.zeros((5, 3, 4)))


def test_real_line_serves_as_a_jaxlie_group():
    a, b = lie.R1(jnp.array([1.5])), lie.R1(jnp.array([-4.0]))
    np.testing.assert_array_equal((a @ b).log(), [-2.5])
    np.testing.assert_array_equal((a @ a.inverse()).as_matrix(), np.eye(2))
    np.testing.assert_array_equal(lie.R1.from_matrix(a.as_matrix()).x, a.x)
    np.testing.assert_array_equal(a.apply(jnp.array([1.0])), [2.5])
    np.testing.assert_array_equal(jaxlie.manifold.rplus(a, jnp.array([0.5])).x, [2.0])
    assert lie.R1.sample_uniform(jax.random.key(0), (3,)).get_batch_axes() == (3,)
    drawn = lie.R1.sample_uniform(jax.random.key(0), (1000,)).x
    assert -1.0 <= drawn.min() < -0.98 and 0.98 < drawn.max() <= 1.0
