"""The chi-squared gate against SciPy, and where it may be used."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from pcm_jax.consistency import chi2_gate
from pcm_jax.errors import InputError

CONFIDENCES = np.array(
    [1e-3, 0.01, 0.035, 0.11, 0.3, 0.49999, 0.5, 0.7, 0.95, 0.99, 0.9999, 0.999999]
)
DOFS = np.arange(1, 7)


@pytest.mark.parametrize("gate", [chi2_gate, jax.jit(chi2_gate)], ids=["host", "traced"])
def test_quantiles(gate):
    found = gate(CONFIDENCES[:, None], DOFS)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, chi2.ppf(CONFIDENCES[:, None], DOFS), rtol=1e-12)


def test_many_degrees_of_freedom():
    found = jax.jit(chi2_gate)(CONFIDENCES[:, None], np.array([30.0, 100.0]))
    np.testing.assert_allclose(found, chi2.ppf(CONFIDENCES[:, None], [30, 100]), rtol=1e-12)


def test_gradient_is_the_inverse_of_the_density():
    slope = jax.jit(jax.vmap(jax.grad(lambda p: chi2_gate(p, 3))))(jnp.asarray(CONFIDENCES))
    expected = 1.0 / chi2.pdf(chi2.ppf(CONFIDENCES, 3), 3)
    np.testing.assert_allclose(slope, expected, rtol=1e-9)


def test_float32():
    found = jax.jit(chi2_gate)(jnp.asarray(CONFIDENCES[:-1], jnp.float32), 6)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, chi2.ppf(CONFIDENCES[:-1], 6), rtol=3e-4)


@pytest.mark.parametrize("confidence", [0.0, 1.0, -0.1, 99.0, np.nan])
def test_confidence_is_a_probability(confidence):
    with pytest.raises(InputError, match=r"confidence: .*; expected a probability"):
        chi2_gate(confidence, 3)
    assert np.isnan(jax.jit(chi2_gate)(confidence, 3))


def test_degrees_of_freedom():
    with pytest.raises(InputError, match="dof: 0"):
        chi2_gate(0.99, 0)


@pytest.mark.parametrize("dof", [float("inf"), float("nan"), 0, -1.0, 1j, None, "3"])
def test_degrees_of_freedom_that_are_none(dof):
    with pytest.raises(InputError, match=r"^dof: "):
        chi2_gate(0.99, dof)
