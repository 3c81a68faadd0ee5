"""Unrolled small matrices against NumPy's dense ones."""

import math
import random

import jax.numpy as jnp
import numpy as np
import pytest

from pcm_jax.lie import unrolled

SIZES = [1, 3, 6]
BATCH = 7


def random_matrices(size, seed=0):
    """A general and a positive definite matrix, and a vector, for each of a batch."""
    rng = np.random.default_rng(seed)
    general = rng.normal(size=(BATCH, size, size))
    root = rng.normal(size=(BATCH, size, 2 * size))
    return general, root @ root.swapaxes(-1, -2), rng.normal(size=(BATCH, size))


def entries(array):
    return unrolled.from_array(array)


def dense(matrix):
    return unrolled.to_array(matrix, like=np.zeros(BATCH))


@pytest.mark.parametrize("size", SIZES)
def test_products(size):
    a, s, v = random_matrices(size)
    b = random_matrices(size, seed=1)[0]
    transposed = a.swapaxes(-1, -2)
    np.testing.assert_allclose(dense(unrolled.multiply(entries(a), entries(b))), a @ b)
    np.testing.assert_allclose(dense(unrolled.transpose(entries(a))), transposed)
    np.testing.assert_allclose(dense(unrolled.add(entries(a), entries(b), entries(s))), a + b + s)
    found = np.stack(unrolled.apply(entries(a), tuple(v.T)), axis=-1)
    np.testing.assert_allclose(found, np.einsum("nij,nj->ni", a, v))
    np.testing.assert_allclose(
        dense(unrolled.sandwich(entries(a), entries(s))), a @ s @ transposed, rtol=1e-12
    )


@pytest.mark.parametrize("size", SIZES)
def test_factorisation(size):
    _, s, v = random_matrices(size)
    lower = unrolled.cholesky(entries(s))
    np.testing.assert_allclose(dense(lower), np.linalg.cholesky(s), rtol=1e-11, atol=1e-12)
    solved = np.stack(unrolled.solve_lower(lower, tuple(v.T)), axis=-1)
    expected = np.linalg.solve(np.linalg.cholesky(s), v[..., None])[..., 0]
    np.testing.assert_allclose(solved, expected, rtol=1e-10)
    squared = unrolled.inverse_quadratic_form(entries(s), tuple(v.T))
    np.testing.assert_allclose(squared, (expected**2).sum(-1), rtol=1e-11)


def test_structural_zeros_and_ones_cost_nothing():
    eye = unrolled.identity(3)
    a, s, _ = random_matrices(3)
    assert unrolled.multiply(eye, eye) == eye
    assert unrolled.multiply(eye, entries(a))[0][1] is not None
    np.testing.assert_array_equal(dense(unrolled.multiply(eye, entries(a))), a)
    np.testing.assert_array_equal(dense(unrolled.sandwich(eye, entries(s)))[:, 2, 1], s[:, 2, 1])
    lower = unrolled.cholesky(entries(s))
    assert lower[0][2] == 0.0
    assert isinstance(lower[0][2], float)


def test_a_dot_product_is_its_sums_and_products():
    """Bit for bit and type for type, whatever is structural: `dot` writes both out."""
    draw = random.Random(0)
    arrays = [np.array([0.1, -2.0, k]) for k in range(4)]
    entries = [0.0, 1.0, -1.0, 2.5, math.nan, 0, 1, np.float64(0.0), *arrays]
    for _ in range(2000):
        size = draw.randint(0, 6)
        left, right = (draw.choices(entries, k=size) for _ in range(2))
        expected = 0.0
        for a, b in zip(left, right, strict=True):
            expected = unrolled.total(expected, unrolled.product(a, b))
        found = unrolled.dot(left, right)
        assert type(found) is type(expected)
        np.testing.assert_array_equal(found, expected)


def test_vectors_of_different_lengths_have_no_dot_product():
    with pytest.raises(ValueError, match="shorter"):
        unrolled.dot((1.0, 2.0, 3.0), (1.0, 2.0))


@pytest.mark.parametrize("size", SIZES)
def test_packing(size):
    _, s, _ = random_matrices(size)
    packed = np.stack(unrolled.pack(entries(s)))
    assert packed.shape == (size * (size + 1) // 2, BATCH)
    np.testing.assert_array_equal(dense(unrolled.unpack(packed)), s)
    rows, columns = zip(*unrolled.packed_indices(size), strict=True)
    np.testing.assert_array_equal(packed, s[:, rows, columns].T)


def test_blocks_and_cross_products():
    v, w = np.random.default_rng(2).normal(size=(2, 3, BATCH))
    np.testing.assert_allclose(np.stack(unrolled.cross(v, w)), np.cross(v, w, axis=0))
    turned = unrolled.apply(unrolled.skew(v), w)
    np.testing.assert_allclose(np.stack(turned), np.cross(v, w, axis=0))
    a = random_matrices(3)[0]
    grid = unrolled.block([[entries(a), unrolled.identity(3)], [entries(-a), entries(2 * a)]])
    eye = np.broadcast_to(np.eye(3), a.shape)
    np.testing.assert_array_equal(dense(grid), np.block([[a, eye], [-a, 2 * a]]))


def test_the_same_code_serves_jax():
    _, s, v = random_matrices(6)
    on_device = unrolled.inverse_quadratic_form(entries(jnp.asarray(s)), tuple(jnp.asarray(v).T))
    on_host = unrolled.inverse_quadratic_form(entries(s), tuple(v.T))
    np.testing.assert_allclose(on_device, on_host, rtol=1e-12)
