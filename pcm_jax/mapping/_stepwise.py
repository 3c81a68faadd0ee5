"""Gauss-Newton step by step in NumPy: the law of `ManifoldGaussNewton` where nothing is compiled.

The same linearisation, the same normal equations and factorisation, the same tests of when to stop
(`_gauss_newton`), driven by a loop of Python: for small problems, and for those that are solved
once, where compiling would take a thousand times what it saves.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from pcm_jax import lie
from pcm_jax.mapping._host_step import solve_on_host
from pcm_jax.mapping._linearization import Edges, edge_products, linearize, retract

ROUNDING = 16
"""Units in the last place of the farthest coordinate: a step's product of several roundings."""


class Found(NamedTuple):
    """The end of a solve; fields as those of `least_squares.Solved`."""

    poses: Any
    initial_cost: float
    cost: float
    iterations: int
    converged: bool


def gauss_newton(
    poses: Any,
    edges: Edges,
    free: Bool[np.ndarray, " n"],
    *,
    rtol: float,
    atol: float,
    max_steps: int,
) -> Found:
    """Minimises half the sum of squares of the whitened residuals; full steps, all accepted.

    Args:
        poses: Lie `[n]`, NumPy.
        edges: no padding.
        free: poses that may move.
        rtol, atol: see `ManifoldGaussNewton`.
        max_steps: evaluations after which to give up.
    """
    candidate, delta = poses, np.zeros((len(free), lie.tangent_dim(poses)))
    before = initial = np.nan
    for step in range(max_steps):
        residual, by_tail, by_head = linearize(candidate, edges)
        cost = 0.5 * float(np.sum(residual * residual))
        if step == 0:
            initial = cost
        if not np.isfinite(cost):
            return Found(candidate, initial, cost, step, False)
        unchanged = abs(before - cost) <= rtol * before
        if step and (unchanged or at_rest(delta, poses, atol)):
            return Found(candidate, initial, cost, step, True)
        poses, before = candidate, cost
        if step + 1 < max_steps:
            delta = -_step(edges, free, by_tail, by_head, residual)
            candidate = retract(poses, delta)
    return Found(poses, initial, cost, max_steps - 1, False)


def at_rest(delta: Float[Any, "n d"], poses: Any, atol: float) -> Any:
    """Whether a step moves no coordinate by more than `atol` and what rounding leaves of it.

    Over NumPy's arrays or JAX's.
    """
    positions = lie.translation(poses)
    space = positions.shape[-1]
    rounding = ROUNDING * np.finfo(delta.dtype).eps * abs(positions).max()
    moved, turned = abs(delta[:, :space]).max(), abs(delta[:, space:]).max()
    return (moved <= atol + rounding) & (turned <= atol)


def _step(
    edges: Edges, free: np.ndarray, by_tail: np.ndarray, by_head: np.ndarray, residual: np.ndarray
) -> Float[np.ndarray, "n d"]:
    """(JᵀJ)⁻¹ Jᵀ r; NaN if there is no factor."""
    step = np.empty((len(free), len(residual)))
    counts: Any = np.array([len(free), residual.shape[1]])
    pattern: Any = edges.tail, edges.head, free, counts
    numbers = edge_products(by_tail, by_head, residual)
    solve_on_host(step, *pattern, np.zeros(()), *numbers, np.zeros_like(step))
    return step
