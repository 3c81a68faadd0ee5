"""The gate: how large a squared distance two right closures may have."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.scipy.special import gammainc, gammaincc, gammaln, ndtri
from jaxtyping import Array, Float

from pcm_jax.arrays import as_real, standard_rules
from pcm_jax.errors import InputError

ITERATIONS = 12


@standard_rules()
def chi2_gate(confidence: Any, dof: Any) -> Float[Array, "*batch"]:
    """Computes γ²: a right pair's squared distance is below it with probability `confidence`.

        pcm_jax.chi2_gate(0.99, dof=3)  # 11.34…

    The quantile of the chi-squared distribution. `confidence` is the probability *inside* the gate:
    the paper's "11 % likelihood" is 0.11.

    Args:
        confidence: probability in (0, 1). Where it is traced, one outside gives NaN.
        dof: degrees of freedom, d: 3 in SE(2), 6 in SE(3).

    Returns:
        float64 by SciPy where the arguments are concrete. Where one is traced, computed in its own
        dtype, safe under jit, vmap and grad (with respect to `confidence`).

    Raises:
        InputError: for a concrete confidence outside (0, 1), or degrees of freedom below one.
    """
    if isinstance(confidence, Tracer) or isinstance(dof, Tracer):
        return _quantile(jnp.asarray(confidence), jnp.asarray(dof))
    confidence, dof = as_real(confidence, "confidence"), as_real(dof, "dof")
    if not ((confidence > 0.0) & (confidence < 1.0)).all():
        raise InputError(f"confidence: {confidence}; expected a probability between 0 and 1")
    if not ((dof >= 1.0) & np.isfinite(dof)).all():
        raise InputError(f"dof: {dof}; expected at least one degree of freedom, and finitely many")
    from scipy.special import gammaincinv

    return 2.0 * gammaincinv(0.5 * dof, confidence)


def _quantile(confidence: Any, dof: Any) -> Any:
    """Halley's iteration on the incomplete gamma function, on whichever tail is the smaller.

    x = γ²/2, a = dof/2; method and start as in Press et al., Numerical Recipes, 3rd ed., 6.2.1.
    """
    p, a = jnp.broadcast_arrays(confidence, 0.5 * dof)

    def step(_: int, x: Any) -> Any:
        low = p < 0.5
        excess = jnp.where(low, gammainc(a, x) - p, (1.0 - p) - gammaincc(a, x))
        newton = excess / _density(x, a)
        bend = jnp.minimum(1.0, newton * ((a - 1.0) / x - 1.0))
        moved = x - newton / (1.0 - 0.5 * bend)
        return jnp.where(moved > 0.0, moved, 0.5 * x)

    x = jax.lax.stop_gradient(jax.lax.fori_loop(0, ITERATIONS, step, _start(p, a)))
    # The inverse function's slope, for automatic differentiation: the correction itself is zero.
    x = x + (p - jax.lax.stop_gradient(p)) / _density(x, a)
    return jnp.where((p > 0.0) & (p < 1.0), 2.0 * x, jnp.nan)


def _density(x: Any, a: Any) -> Any:
    return jnp.exp((a - 1.0) * jnp.log(x) - x - gammaln(a))


def _start(p: Any, a: Any) -> Any:
    """Wilson and Hilferty's cube for a > 1; else the series near zero, or the exponential tail."""
    cube = a * (1.0 - 1.0 / (9.0 * a) + ndtri(p) / (3.0 * jnp.sqrt(a))) ** 3
    bend = 1.0 - a * (0.253 + a * 0.12)
    near_zero = (p / bend) ** (1.0 / a)
    tail = 1.0 - jnp.log(1.0 - (p - bend) / (1.0 - bend))
    return jnp.where(a > 1.0, jnp.maximum(1e-3, cube), jnp.where(p < bend, near_zero, tail))
