"""The block Cholesky factorisation itself: NumPy over groups of equal fronts, LAPACK below.

Per group and call: one sparse product sums the fronts, then batched `A = L Lᵀ`, `X = B L⁻ᵀ`,
`U = C − X Xᵀ`. Inverses of the small triangles L are kept, so that everything else, the solves
included, is matrix products. BLAS runs on one thread except in large fronts: threading products
of tiny matrices costs an order of magnitude.

Runs on the host, once per outer step of the optimiser; what depends only on the pattern was done
before (`assembly.plan_for`).
"""

from __future__ import annotations

import dataclasses
import functools
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
from jaxtyping import Float

from pcm_jax.mapping.assembly import CholeskyPlan, FrontGroup

LARGE_PIVOTS = 96
"""Scalars: fronts with more pivots are factorised one by one with LAPACK's triangular routines."""
LARGE_REST = 64
"""Scalars: update matrices of this size are formed one by one, and half of each."""
SMALL_TRIANGLE = 24
"""Scalars: LAPACK's inverse of a general matrix is as fast for triangles up to this size."""
LARGE_FRONT = 2048
"""Scalars: fronts of this size gain from BLAS threads even where other work holds some cores."""

Triangles = Float[np.ndarray, "b p p"]


@functools.cache
def _thread_pools() -> Any:
    import scipy.linalg  # noqa: F401  (loads SciPy's own BLAS, so that it is found)
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")


def blas_threads() -> int:
    """How many threads BLAS may use now: the user's setting."""
    return max((pool.num_threads for pool in _thread_pools().lib_controllers), default=1)


def limited_to(threads: int) -> AbstractContextManager:
    """A scope in which BLAS uses so many threads; the setting before is restored after it."""
    return _thread_pools().limit(limits=threads)


class NotPositiveDefiniteError(np.linalg.LinAlgError):
    """The matrix has no Cholesky factor."""


@dataclasses.dataclass(frozen=True, eq=False)
class CholeskyFactor:
    """The factor of `H`, in the elimination order of its plan.

    Attributes:
        plan: what was known before the numbers.
        inverse_pivots: per group `[b, p, p]`, L⁻¹ (lower triangular).
        couplings: per group `[b, r, p]`, X.
    """

    plan: CholeskyPlan
    inverse_pivots: list[Triangles]
    couplings: list[Float[np.ndarray, "b r p"]]

    def solve(self, right: Float[np.ndarray, "nd *k"]) -> Float[np.ndarray, "nd *k"]:
        """H⁻¹ `right`, rows in the poses' own order."""
        plan, d = self.plan, self.plan.block_dim
        vectors = right.reshape(plan.size, d, -1)
        ordered = np.zeros((plan.size + 1, d, vectors.shape[2]))
        ordered[plan.position] = vectors
        rows = ordered.reshape(-1, vectors.shape[2])
        with limited_to(1):
            self._backward(rows, self._forward(rows))
        return ordered[plan.position].reshape(right.shape)

    def _forward(self, rows: np.ndarray) -> list[np.ndarray]:
        partial = []
        padding = self.plan.size * self.plan.block_dim
        for group, inverse, coupling in self._fronts():
            solved = inverse @ rows[group.pivot_rows]
            partial.append(solved)
            if group.rest:
                np.subtract.at(rows, group.rest_rows, coupling @ solved)
                rows[padding:] = 0.0
        return partial

    def _backward(self, rows: np.ndarray, partial: list[np.ndarray]) -> None:
        padding = self.plan.size * self.plan.block_dim
        for (group, inverse, coupling), solved in zip(
            reversed(list(self._fronts())), reversed(partial), strict=True
        ):
            known = coupling.transpose(0, 2, 1) @ rows[group.rest_rows]
            rows[group.pivot_rows] = inverse.transpose(0, 2, 1) @ (solved - known)
            rows[padding:] = 0.0

    def _fronts(self):
        return zip(self.plan.groups, self.inverse_pivots, self.couplings, strict=True)


def factorize(plan: CholeskyPlan, blocks: Float[np.ndarray, "k d d"]) -> CholeskyFactor:
    """Factorises `H`.

    Args:
        plan: the pattern's plan.
        blocks: numbers of the blocks (`plan.block_row`, `plan.block_column`).

    Raises:
        NotPositiveDefiniteError: `H` is not positive definite, or not finite.
    """
    if not np.isfinite(blocks).all():
        raise NotPositiveDefiniteError("the matrix is not finite")
    d = plan.block_dim
    pool = np.empty((plan.chunks, d))
    pool[:d] = np.eye(d)
    pool[d : d * (1 + len(blocks))] = blocks.reshape(-1, d)
    factor = CholeskyFactor(plan, [], [])
    threads = blas_threads()
    try:
        with limited_to(1):
            for group in plan.groups:
                inverse, coupling = _factorize_group(group, pool, threads)
                factor.inverse_pivots.append(inverse)
                factor.couplings.append(coupling)
    except np.linalg.LinAlgError as error:
        raise NotPositiveDefiniteError(str(error)) from error
    return factor


def _factorize_group(
    group: FrontGroup, pool: np.ndarray, threads: int
) -> tuple[np.ndarray, np.ndarray]:
    pivots, rest = group.pivots, group.rest
    fronts = (group.gather @ pool).reshape(group.count, pivots + rest, pivots + rest)
    stored = pool[group.update : group.update + group.count * rest * rest // pool.shape[1]]
    updates = stored.reshape(group.count, rest, rest)
    if pivots > LARGE_PIVOTS or pivots + rest > LARGE_FRONT:
        with limited_to(threads if pivots + rest > LARGE_FRONT else 1):
            return _factorize_large(fronts, updates, pivots)
    inverse = inverse_triangles(np.linalg.cholesky(fronts[:, :pivots, :pivots]))
    coupling = fronts[:, pivots:, :pivots] @ inverse.transpose(0, 2, 1)
    _update(fronts[:, pivots:, pivots:], coupling, updates)
    return inverse, coupling


def inverse_triangles(lower: Triangles) -> Triangles:
    """L⁻¹ of lower triangles, by halves while these are equal and large enough to be worth it.

    [ A     ]⁻¹   [  A⁻¹              ]
    [ B  C  ]   = [ −C⁻¹ B A⁻¹   C⁻¹ ]
    """
    size = lower.shape[-1]
    half = size // 2
    if size % 2 or size <= SMALL_TRIANGLE:
        return np.linalg.inv(lower)
    first, second = slice(0, half), slice(half, size)
    inverse = np.zeros_like(lower)
    halves = np.stack([lower[:, first, first], lower[:, second, second]])
    top, bottom = inverse_triangles(halves.reshape(-1, half, half)).reshape(halves.shape)
    inverse[:, first, first], inverse[:, second, second] = top, bottom
    np.matmul(-bottom, lower[:, second, first] @ top, out=inverse[:, second, first])
    return inverse


def _update(blocks: np.ndarray, coupling: np.ndarray, updates: np.ndarray) -> None:
    """U = C − X Xᵀ, of large matrices only the lower triangle, which is all that is read."""
    rest = updates.shape[-1]
    if rest < LARGE_REST:
        np.matmul(coupling, coupling.transpose(0, 2, 1), out=updates)
        np.subtract(blocks, updates, out=updates)
        return
    from scipy.linalg import get_blas_funcs

    (syrk,) = get_blas_funcs(("syrk",), (coupling,))
    updates[...] = blocks
    for update, factor in zip(updates, coupling, strict=True):
        syrk(-1.0, factor.T, beta=1.0, c=update.T, trans=1, overwrite_c=1)


def _factorize_large(
    fronts: np.ndarray, updates: np.ndarray, pivots: int
) -> tuple[np.ndarray, np.ndarray]:
    """One front after the other; LAPACK sees a row-major lower triangle as an upper one."""
    from scipy.linalg import get_lapack_funcs

    potrf, trtri = get_lapack_funcs(("potrf", "trtri"), (fronts,))

    rest = fronts.shape[1] - pivots
    inverse = np.empty((len(fronts), pivots, pivots))
    coupling = np.empty((len(fronts), rest, pivots))
    for k, front in enumerate(fronts):
        upper, failed = potrf(front[:pivots, :pivots].T, lower=0, clean=1)
        if failed:
            raise np.linalg.LinAlgError("a pivot block is not positive definite")
        inverse[k] = trtri(upper, lower=0)[0].T
        np.matmul(front[pivots:, :pivots], inverse[k].T, out=coupling[k])
    _update(fronts[:, pivots:, pivots:], coupling, updates)
    return inverse, coupling
