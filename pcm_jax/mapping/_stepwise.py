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
from pcm_jax.mapping._host_step import solve_on_host, system_of
from pcm_jax.mapping._linearization import (
    Edges,
    differential,
    edge_gradients,
    edge_products,
    linearize,
    retract,
)
from pcm_jax.sparse import registry

FIRST_DAMPING = 1e-5
"""λ of Levenberg-Marquardt at step size 1, where the trust region starts."""
LOW_CUTOFF, HIGH_CUTOFF = 0.01, 0.75
"""Of the predicted fall of the cost: with less a step is refused, with more it may grow."""
SHRINKING, GROWING = 0.25, 10.0
SLICE = 4096
"""Edges that are linearised at once: what is formed on the way takes memory for so many."""
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
    """A candidate, and what the next step needs of it.

    Attributes:
        poses: Lie `[n]`.
        cost: half the sum of squares.
        products, gradients: see `EdgeProducts`.
        slopes: of each slice of edges its residuals and Jacobians; none without damping.
    """

    poses: Any
    cost: float
    products: Float[np.ndarray, "3 e d d"]
    gradients: Float[np.ndarray, "2 e d"]
    slopes: list[tuple[Edges, Any]]

    @classmethod
    def at(cls, poses: Any, edges: Edges, damped: bool) -> _Judged:
        d, count = edges.whitening.shape[1:]
        products, gradients = np.empty((3, count, d, d)), np.empty((2, count, d))
        cost, slopes = 0.0, []
        with np.errstate(over="ignore", invalid="ignore"):  # a poor step's: its cost says so
            for start in range(0, count, SLICE):
                part = slice(start, start + SLICE)
                some = edges.part(part)
                linear: Any = linearize(poses, some)
                cost += 0.5 * float(np.sum(np.square(linear.residual)))
                found = edge_products(linear.tail, linear.head, linear.residual)
                products[:, part], gradients[:, part] = found
                slopes += [(some, linear)] * damped
        return cls(poses, cost, products, gradients, slopes)

    def predicted(self, delta: Any) -> float:
        """The change of the cost by a step, if the residuals were linear."""
        after = 0.0
        for some, (residual, by_tail, by_head) in self.slopes:
            moved = differential(by_tail, by_head, some.tail, some.head, delta.T)
            after += float(np.sum(np.square(residual + moved)))
        return 0.5 * after - self.cost


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
    best = _Judged.at(poses, edges, damped)
    initial, step_size, accepted = best.cost, 1.0, 0
    for _ in range(max_steps - 1):
        if not np.isfinite(best.cost):
            break
        damping = FIRST_DAMPING / step_size if damped else 0.0
        delta: Any = -_step(edges, free, best, damping)
        found, before = _Judged.at(retract(best.poses, delta), edges, damped), best
        accept, growth = True, 1.0
        if damped:
            accept, growth = _judge(found.cost - before.cost, before.predicted(delta))
        step_size *= growth
        settled = at_rest(delta, before.poses, atol)
        if accept:
            best, accepted = found, accepted + 1
            settled |= abs(before.cost - best.cost) <= rtol * before.cost
        if settled:
            return Found(best.poses, initial, best.cost, accepted, bool(np.isfinite(best.cost)))
    return Found(best.poses, initial, best.cost, accepted, False)


class Stepped(NamedTuple):
    """The end of two steps with one factor.

    Attributes:
        halfway: Lie `[n]`, poses after the first.
        cost: there.
        poses: after both.
        left: by how much the second was to lower the cost: about what was left to gain.
    """

    halfway: Any
    cost: float
    poses: Any
    left: float


def step_twice(poses: Any, edges: Edges, free: Bool[np.ndarray, " n"]) -> Stepped:
    """Takes a step of Gauss-Newton, and another with the same factor.

    Args:
        poses, edges, free: as for `minimize`.

    Raises:
        NotPositiveDefiniteError: there is no factor.
    """
    here, counts = _Judged.at(poses, edges, False), np.array([len(free), len(edges.tail)])
    d = here.gradients.shape[-1]
    system = system_of((edges.tail, edges.head, free, counts), d)  # type: ignore[arg-type]
    with registry.spare.borrow(system.plan.scalars) as memory:
        factor = system.factorize(here.products, 0.0, memory)
        gradient = system.gradient(here.gradients)
        step: Any = factor.solve(gradient.ravel()).reshape(gradient.shape)
        halfway = retract(poses, -step)
        residual, by_tail, by_head = linearize(halfway, edges)
        gradients: Any = edge_gradients(by_tail, by_head, residual)
        gradient = system.gradient(gradients)
        step = factor.solve(gradient.ravel()).reshape(gradient.shape)
    cost = 0.5 * float(np.sum(np.square(residual)))
    left = 0.5 * float(np.sum(step * gradient))
    return Stepped(halfway, cost, retract(halfway, -step), left)


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
    edges: Edges, free: np.ndarray, here: _Judged, damping: float
) -> Float[np.ndarray, "n d"]:
    """(JᵀJ + λ diag(JᵀJ))⁻¹ Jᵀ r; NaN if there is no factor."""
    step = np.empty((len(free), here.gradients.shape[-1]))
    counts: Any = np.array([len(free), len(edges.tail)])
    pattern: Any = edges.tail, edges.head, free, counts
    numbers: Any = here.products, here.gradients
    solve_on_host(step, *pattern, np.asarray(damping), *numbers, np.zeros_like(step))
    return step
