"""Single-cluster graph partitioning: the densest cluster, by the leading eigenvector.

E. Olson, M. Walter, J. Leonard and S. Teller, "Single-cluster graph partitioning for robotics
applications", RSS 2005. With affinities A and a cluster's indicator u, the average affinity
uᵀAu / uᵀu is largest over real vectors at A's leading eigenvector; u is that vector thresholded at
whichever of its m values gives the largest average.

The diagonal of A is 1 (a measurement agrees with itself). Any other constant would shift every
average alike and change nothing.

The host takes the eigenvector from a factorisation. The kernel takes it by power iteration
wherever that converges: the residual |A v − λ v| is then what rounding leaves of it, as it is after
a factorisation, which takes twenty times as long and is left for matrices whose largest eigenvalues
nearly tie.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pcm_jax.arrays import namespace
from pcm_jax.errors import InputError
from pcm_jax.selection._distances import symmetrised
from pcm_jax.selection.method import Choice, SelectionMethod

# Of power iteration: 99 % of the worlds of 115 closures converge within 120 steps.
_STEPS, _STEPS_AT_ONCE = 256, 8
_RESIDUAL = 512  # units of rounding of the eigenvalue: 1e-13 in float64


def _gaussian(squared: Any, gate: Any) -> Any:
    return namespace(squared).exp(-0.5 * squared)


def _binary(squared: Any, gate: Any) -> Any:
    return (squared <= gate).astype(squared.dtype)


def _linear(squared: Any, gate: Any) -> Any:
    xp = namespace(squared, gate)
    within = xp.clip(1.0 - xp.sqrt(squared / xp.where(gate > 0.0, gate, 1.0)), 0.0, 1.0)
    return xp.where(gate > 0.0, within, _binary(squared, gate))


AFFINITIES: dict[str, Callable[[Any, Any], Any]] = {
    "gaussian": _gaussian,
    "binary": _binary,
    "linear": _linear,
}


def scgp(squared: Float[np.ndarray, "m m"], gate: float, *, affinity: str = "gaussian") -> Choice:
    """Keeps the cluster of largest average affinity among the eigenvector's thresholds.

    Args:
        squared: squared distances q²; the larger of a pair's two counts.
        gate: γ², not used by the Gaussian affinity.
        affinity: `"gaussian"`: exp(−q²/2); `"binary"`: 1 within the gate, else 0; `"linear"`:
            1 − q/γ, and 0 beyond the gate.

    Raises:
        InputError: for another affinity.
    """
    if len(squared) == 0:
        return Choice(np.zeros(0, bool))
    affinities = _affinities(squared, gate, affinity)
    return Choice(_densest(affinities, np.linalg.eigh(affinities)[1][:, -1]))


def scgp_kernel(
    squared: Float[Array, "m m"], gate: Any, *, affinity: str = "gaussian"
) -> Bool[Array, " m"]:
    """The kernel of `scgp`."""
    affinities = _affinities(squared, gate, affinity)
    # Equal neighbourhoods are common there, and tied eigenvalues with them.
    eigenvector = _by_factorisation if affinity == "binary" else _leading
    return _densest(affinities, eigenvector(affinities[None])[0])


def _affinities(squared: Any, gate: Any, affinity: str) -> Any:
    if affinity not in AFFINITIES:
        raise InputError(f"affinity: {affinity!r}, expected one of {', '.join(AFFINITIES)}")
    xp, distances = namespace(squared), symmetrised(squared)
    return AFFINITIES[affinity](xp.where(xp.isnan(distances), xp.inf, distances), gate)


def _densest(affinities: Any, eigenvector: Any) -> Any:
    """The threshold of the eigenvector with the largest average affinity."""
    xp = namespace(affinities)
    leading = xp.abs(eigenvector)  # of a matrix without negative entries (Perron and Frobenius)
    order = xp.argsort(-leading, stable=True)
    rank = xp.argsort(order)
    with_earlier = xp.where(rank < rank[:, None], affinities, 0.0).sum(axis=1)
    within = xp.cumsum((xp.diagonal(affinities) + 2.0 * with_earlier)[order])
    return rank <= xp.argmax(within / xp.arange(1, len(order) + 1))


@jax.custom_batching.custom_vmap
def _leading(matrices: Float[Array, "n m m"]) -> Float[Array, "n m"]:
    """An eigenvector of the largest eigenvalue of each matrix, without negative entries.

    The matrices have no negative entries and ones as their diagonal, so that no eigenvalue is as
    large in magnitude, and the constant vector is not orthogonal to what is looked for.
    """
    number, m, _ = matrices.shape
    tolerance = _RESIDUAL * jnp.finfo(matrices.dtype).eps

    def step(_: int, vectors: Array) -> Array:
        moved = jnp.einsum("nij,nj->ni", matrices, vectors)
        return moved / jnp.linalg.norm(moved, axis=1, keepdims=True)

    def converged(vectors: Array) -> Array:
        moved = jnp.einsum("nij,nj->ni", matrices, vectors)
        value = jnp.sum(vectors * moved, axis=1)
        residual = jnp.abs(moved - value[:, None] * vectors).max(axis=1)
        # An eigenvalue of one belongs to every vector: no two measurements agree at all.
        return (residual <= tolerance * value) & (value > 1.0 + tolerance)

    def unfinished(state: tuple[Array, Array, Array]) -> Array:
        return (state[2] < _STEPS) & ~state[1].all()

    def advance(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        vectors = jax.lax.fori_loop(0, _STEPS_AT_ONCE, step, state[0])
        return vectors, converged(vectors), state[2] + _STEPS_AT_ONCE

    constant = jnp.full((number, m), m**-0.5, matrices.dtype)
    start = constant, jnp.zeros(number, bool), jnp.int32(0)
    vectors, done, _ = jax.lax.while_loop(unfinished, advance, start)

    def settle(of_one: tuple[Array, Array, Array]) -> Array:
        matrix, vector, done = of_one
        return jax.lax.cond(done, lambda: vector, lambda: _by_factorisation(matrix[None])[0])

    # One after the other, not mapped: only then are the matrices that are done passed over.
    return jax.lax.cond(
        done.all(), lambda: vectors, lambda: jax.lax.map(settle, (matrices, vectors, done))
    )


@_leading.def_vmap
def _(size: int, mapped: list[bool], matrices: Array) -> tuple[Array, bool]:
    """The mapped axis joins the batch."""
    found = _leading(matrices.reshape(-1, *matrices.shape[-2:]))
    return found.reshape(size, -1, matrices.shape[-1]), True


def _by_factorisation(matrices: Float[Array, "n m m"]) -> Float[Array, "n m"]:
    return jnp.linalg.eigh(matrices)[1][..., -1]


METHODS = (SelectionMethod("scgp", scgp, kernel=scgp_kernel),)
