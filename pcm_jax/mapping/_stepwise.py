"""Least squares step by step in NumPy: the law of `ManifoldGaussNewton` where nothing is compiled.

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
from pcm_jax.mapping._linearization import (
    Edges,
    differential,
    edge_products,
    linearize,
    retract,
)

FIRST_DAMPING = 1e-5
"""λ of Levenberg-Marquardt at step size 1, where the trust region starts."""
LOW_CUTOFF, HIGH_CUTOFF = 0.01, 0.75
"""Of the predicted fall of the cost: with less a step is refused, with more it may grow."""
SHRINKING, GROWING = 0.25, 10.0
ROUNDING = 16
"""Units in the last place of the farthest coordinate: a step's product of several roundings."""


class Found(NamedTuple):
    """The end of a solve; fields as those of `least_squares.Solved`."""

    poses: Any
    initial_cost: float
    cost: float
    iterations: int
    converged: bool


class _Judged(NamedTuple):
    """A candidate, linearised.

    Attributes:
        poses: Lie `[n]`.
        linear: residuals and Jacobians, see `linearize`.
        cost: half the sum of squares.
    """

    poses: Any
    linear: Any
    cost: float

    @classmethod
    def at(cls, poses: Any, edges: Edges) -> _Judged:
        linear: Any = linearize(poses, edges)
        return cls(poses, linear, 0.5 * float(np.sum(linear[0] * linear[0])))

    def predicted(self, edges: Edges, delta: Any) -> float:
        """The change of the cost by a step, if the residuals were linear."""
        residual, by_tail, by_head = self.linear
        after = residual + differential(by_tail, by_head, edges.tail, edges.head, delta.T)
        return 0.5 * float(np.sum(after * after)) - self.cost


def minimize(
    poses: Any,
    edges: Edges,
    free: Bool[np.ndarray, " n"],
    *,
    damped: bool,
    rtol: float,
    atol: float,
    max_steps: int,
) -> Found:
    """Minimises half the sum of squares of the whitened residuals.

    Args:
        poses: Lie `[n]`, NumPy.
        edges: no padding.
        free: poses that may move.
        damped: Levenberg-Marquardt, by the trust region of `optimistix.ClassicalTrustRegion`;
            else Gauss-Newton: full steps, all accepted.
        rtol, atol: see `ManifoldGaussNewton`.
        max_steps: evaluations after which to give up.
    """
    best = _Judged.at(poses, edges)
    initial, step_size, accepted = best.cost, 1.0, 0
    for _ in range(max_steps - 1):
        if not np.isfinite(best.cost):
            break
        damping = FIRST_DAMPING / step_size if damped else 0.0
        delta: Any = -_step(edges, free, best.linear, damping)
        found, before = _Judged.at(retract(best.poses, delta), edges), best
        accept, growth = True, 1.0
        if damped:
            accept, growth = _judge(found.cost - before.cost, before.predicted(edges, delta))
        step_size *= growth
        settled = at_rest(delta, before.poses, atol)
        if accept:
            best, accepted = found, accepted + 1
            settled |= abs(before.cost - best.cost) <= rtol * before.cost
        if settled:
            return Found(best.poses, initial, best.cost, accepted, bool(np.isfinite(best.cost)))
    return Found(best.poses, initial, best.cost, accepted, False)


def _judge(change: float, predicted: float) -> tuple[bool, float]:
    """The verdict on a step, and the next step size over this one."""
    if not change <= LOW_CUTOFF * predicted:
        return False, SHRINKING
    good = predicted < 0.0 and change < HIGH_CUTOFF * predicted
    return True, GROWING if good else 1.0


def at_rest(delta: Float[Any, "n d"], poses: Any, atol: float) -> Any:
    """True where a step moves no coordinate by more than `atol` and what rounding leaves of it.

    Over NumPy's arrays or JAX's.
    """
    positions = lie.translation(poses)
    space = positions.shape[-1]
    rounding = ROUNDING * np.finfo(delta.dtype).eps * abs(positions).max()
    moved, turned = abs(delta[:, :space]).max(), abs(delta[:, space:]).max()
    return (moved <= atol + rounding) & (turned <= atol)


def _step(
    edges: Edges, free: np.ndarray, linear: tuple[Any, Any, Any], damping: float
) -> Float[np.ndarray, "n d"]:
    """(JᵀJ + λ diag(JᵀJ))⁻¹ Jᵀ r; NaN if there is no factor."""
    residual, by_tail, by_head = linear
    step = np.empty((len(free), len(residual)))
    counts: Any = np.array([len(free), residual.shape[1]])
    pattern: Any = edges.tail, edges.head, free, counts
    numbers: Any = edge_products(by_tail, by_head, residual)
    solve_on_host(step, *pattern, np.asarray(damping), *numbers, np.zeros_like(step))
    return step
