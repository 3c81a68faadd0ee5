"""`squared_mahalanobis_of`: residuals of one's own."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.consistency import definition, squared_mahalanobis_of
from pcm_jax.errors import InputError


def between(u, v):
    return lie.log(lie.between(u, v))


def test_the_one_dimensional_world():
    rng = np.random.default_rng(0)
    x, variance = rng.normal(size=50), rng.uniform(0.5, 2.0, size=50)
    found = squared_mahalanobis_of(
        between, lie.R1(jnp.asarray(x[:, None])), variance[:, None, None]
    )
    expected = (x[:, None] - x) ** 2 / (variance[:, None] + variance)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)


def test_lie_leaves_are_perturbed_on_the_right():
    rng = np.random.default_rng(1)
    z = lie.exp(jaxlie.SE2, rng.normal(size=(6, 3)))
    root = rng.normal(size=(6, 3, 3))
    covariance = root @ root.swapaxes(-1, -2) + np.eye(3)
    found = np.asarray(squared_mahalanobis_of(between, lie.as_device(z), jnp.asarray(covariance)))
    for u, v in [(0, 1), (1, 0), (2, 5)]:
        error = lie.log(lie.between(lie.take(z, u), lie.take(z, v)))
        right = lie.right_jacobian_inverse(jaxlie.SE2, error)
        left = lie.right_jacobian_inverse(jaxlie.SE2, -error)
        total = right @ covariance[v] @ right.T + left @ covariance[u] @ left.T
        np.testing.assert_allclose(found[u, v], error @ np.linalg.solve(total, error), rtol=1e-11)


def test_several_leaves_and_a_residual_of_another_size():
    """Leaves in the pytree's order: here an array of two and a Lie element, five errors in all."""
    rng = np.random.default_rng(2)
    measurements = {
        "a": jnp.asarray(rng.normal(size=(5, 2))),
        "b": lie.as_device(lie.exp(jaxlie.SE2, rng.normal(size=(5, 3)))),
    }
    root = rng.normal(size=(5, 5, 5))
    covariance = jnp.asarray(root @ root.swapaxes(-1, -2))
    weights = rng.normal(size=(4, 5))

    def residual(u, v):
        both = jnp.concatenate([u["a"] - v["a"], between(v["b"], u["b"])])
        return jnp.asarray(weights) @ both

    found = squared_mahalanobis_of(residual, measurements, covariance)
    assert found.shape == (5, 5)
    np.testing.assert_array_equal(np.diagonal(found), 0.0)
    a, b = np.asarray(measurements["a"]), lie.as_numpy(measurements["b"])
    error = lie.log(lie.between(lie.take(b, 3), lie.take(b, 1)))
    right = lie.right_jacobian_inverse(jaxlie.SE2, error)
    left = lie.right_jacobian_inverse(jaxlie.SE2, -error)
    to_u, to_v = np.eye(5), -np.eye(5)
    to_u[2:, 2:], to_v[2:, 2:] = right, -left
    sides = [weights @ side for side in (to_u, to_v)]
    total = sum(
        side @ np.asarray(covariance[k]) @ side.T for side, k in zip(sides, (1, 3), strict=True)
    )
    r = weights @ np.concatenate([a[1] - a[3], error])
    np.testing.assert_allclose(found[1, 3], r @ np.linalg.solve(total, r), rtol=1e-10)


def test_more_pairs_than_one_batch_holds(monkeypatch):
    monkeypatch.setattr("pcm_jax.consistency.definition.PAIRS_AT_ONCE", 100)
    x = jnp.arange(17.0)[:, None]
    found = squared_mahalanobis_of(lambda u, v: v - u, x, jnp.full((17, 1, 1), 0.5))
    np.testing.assert_allclose(found, (x - x.T) ** 2, rtol=1e-12)


@pytest.mark.parametrize("transformation", [jax.jit, jax.grad])
def test_transformations(transformation):
    variance = jnp.ones((4, 1, 1))
    total = lambda x: squared_mahalanobis_of(lambda u, v: v - u, x, variance).sum()  # noqa: E731
    x = jnp.array([[0.0], [1.0], [3.0], [3.0]])
    found = transformation(total)(x)
    expected = {jax.jit: 27.0, jax.grad: 2.0 * (4 * x - x.sum())}[transformation]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_no_measurements():
    assert squared_mahalanobis_of(between, lie.R1(np.zeros((0, 1))), np.zeros((0, 1, 1))).size == 0


@pytest.mark.parametrize(
    ("measurements", "covariances", "message"),
    [
        (
            np.zeros((3, 2)),
            np.ones((3, 1, 1)),
            r"covariances: shape \(3, 1, 1\); expected \(3, 2, 2\)",
        ),
        (lie.R1(np.zeros((3, 1))), np.ones((4, 1, 1)), r"covariances: .*; expected \(3, 1, 1\)"),
        ([np.zeros(3), np.zeros(4)], np.ones((3, 2, 2)), r"measurements: shapes .* axis m"),
    ],
)
def test_sizes_must_fit(measurements, covariances, message):
    with pytest.raises(InputError, match=message):
        squared_mahalanobis_of(between, measurements, covariances)


def test_a_lambda_in_a_loop_compiles_once():
    x, variance = np.arange(4.0), np.ones((4, 1, 1))

    def of(scale):
        return squared_mahalanobis_of(lambda u, v: jnp.atleast_1d(scale * (u - v)), x, variance)

    of(1.0)
    before = definition._all_pairs_of._cache_size()
    for _ in range(3):
        of(1.0)
    assert definition._all_pairs_of._cache_size() == before
    np.testing.assert_allclose(of(2.0), of(1.0))  # q² does not depend on the scale
    assert definition._all_pairs_of._cache_size() == before + 1


def test_functions_that_close_over_other_arrays_are_not_mixed_up():
    x, variance = np.arange(3.0), np.ones((3, 1, 1))
    shifts = [np.zeros(1), np.ones(1)]
    found = [
        squared_mahalanobis_of(lambda u, v, s=s: jnp.atleast_1d(u - v) + s, x, variance)
        for s in shifts
    ]
    np.testing.assert_allclose(found[0][0], [0.0, 0.5, 2.0])
    np.testing.assert_allclose(found[1][0], [0.0, 0.0, 0.5])
