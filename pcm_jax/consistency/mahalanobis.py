"""The pure kernel's entry: squared Mahalanobis distances of all pairs of closures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from pcm_jax import lie
from pcm_jax.consistency.closed_form import closed_form_kernel, own_loop_kernel
from pcm_jax.consistency.definition import jacfwd_kernel
from pcm_jax.consistency.problem import ConsistencyProblem
from pcm_jax.consistency.within import WithinProblem
from pcm_jax.errors import InputError
from pcm_jax.precision import device_array

Problem = ConsistencyProblem | WithinProblem


def _masked(kernel: Callable[[Any], Any]) -> Callable[[Problem], Any]:
    """`kernel`, compiled, with infinite distances between padding and anything else."""

    @jax.jit
    def masked(problem: Problem) -> Any:
        both = problem.valid[:, None] & problem.valid[None, :]
        both |= jnp.eye(len(problem.valid), dtype=bool)
        return jnp.where(both, kernel(problem), jnp.inf)

    return masked


_KERNELS = {"closed-form": _masked(closed_form_kernel), "jacfwd": _masked(jacfwd_kernel)}
_own_loop = jax.jit(own_loop_kernel)


def squared_mahalanobis(
    problem: ConsistencyProblem | WithinProblem, *, kernel: str = "closed-form"
) -> Float[Array, "m m"]:
    """Squared Mahalanobis distance of the loop error of every ordered pair (paper, eq. 4).

    `[u, v]` is q²_uv, not symmetrised; the diagonal is zero. For closures that are both right it
    follows a chi-squared distribution with d degrees of freedom: see `chi2_gate`.

    Safe under jit, vmap and grad. The result follows the dtype of the problem, which
    `consistency_problem` and `within_problem` build in float64.

    Args:
        problem: of closures between two robots, see `consistency_problem`, or within one robot's
            map, see `within_problem`.
        kernel: "closed-form", or "jacfwd": the definition, by automatic differentiation.

    Returns:
        Of the valid closures alone. Where `problem.valid` is traced (inside jit or vmap) its
        padding cannot be cut, and padded rows and columns are infinite off the diagonal: no gate
        lets them pass.

    Raises:
        InputError: for another kernel.
    """
    if kernel not in _KERNELS:
        raise InputError(f"kernel: {kernel!r}; expected one of {', '.join(map(repr, _KERNELS))}")
    with lie.own_precision(problem):
        squared = _KERNELS[kernel](problem)
        if isinstance(problem.valid, Tracer):
            return squared
        valid = np.flatnonzero(np.asarray(problem.valid))
        if isinstance(squared, Tracer):
            return squared[valid[:, None], valid]
        # Cut by NumPy: an eager JAX gather would be compiled for every number of closures.
        return device_array(np.asarray(squared)[np.ix_(valid, valid)], squared.dtype)


def squared_own_loops(problem: WithinProblem) -> Float[Array, " m"]:
    """Squared Mahalanobis distance of the loop of every closure with odometry alone.

    Chi-squared with d degrees of freedom for a right closure, as `squared_mahalanobis` is for a
    right pair. Safe under jit, vmap and grad.

    Returns:
        Of the valid closures alone; where `problem.valid` is traced, padding is infinite.
    """
    with lie.own_precision(problem):
        squared = _own_loop(problem)
        if isinstance(problem.valid, Tracer):
            return jnp.where(problem.valid, squared, jnp.inf)
        valid = np.flatnonzero(np.asarray(problem.valid))
        if isinstance(squared, Tracer):
            return squared[valid]
        return device_array(np.asarray(squared)[valid], squared.dtype)
