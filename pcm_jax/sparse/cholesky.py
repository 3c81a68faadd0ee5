"""The block Cholesky factorisation itself: NumPy over groups of equal fronts, LAPACK below.

Per group and call: one sparse product sums the fronts, then batched `A = L Lᵀ`, `X = B L⁻ᵀ`,
`U = C − X Xᵀ`. Inverses of the small triangles L are kept, so that everything else, the solves
included, is matrix products. BLAS runs on one thread except in large fronts (`_blas`).

Runs on the host, once per outer step of the optimiser; what depends only on the pattern was done
before (`assembly.plan_for`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from pcm_jax.sparse import registry
from pcm_jax.sparse.assembly import CholeskyPlan, FrontGroup

LARGE_PIVOTS = 96
"""Scalars: fronts with more pivots are factorised one by one with LAPACK's triangular routines."""
LARGE_REST = 64
"""Scalars: update matrices of this size are formed one by one, and half of each."""
SMALL_TRIANGLE = 24
"""Scalars: LAPACK's inverse of a general matrix is as fast for triangles up to this size."""
LARGE_FRONT = 2048
"""Scalars: fronts of this size gain from BLAS threads even where other work holds some cores."""

Triangles = Float[np.ndarray, "b p p"]


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
        with registry.blas.one():
            self._backward(rows, self._forward(rows))
        return ordered[plan.position].reshape(right.shape)

    def _forward(self, rows: np.ndarray) -> list[np.ndarray]:
        partial = []
        padding = self.plan.size * self.plan.block_dim
        for group, inverse, coupling in self.fronts():
            solved = inverse @ rows[group.pivot_rows]
            partial.append(solved)
            if group.rest:
                np.subtract.at(rows, group.rest_rows, coupling @ solved)
                rows[padding:] = 0.0
        return partial

    def _backward(self, rows: np.ndarray, partial: list[np.ndarray]) -> None:
        padding = self.plan.size * self.plan.block_dim
        for (group, inverse, coupling), solved in zip(
            reversed(list(self.fronts())), reversed(partial), strict=True
        ):
            known = coupling.transpose(0, 2, 1) @ rows[group.rest_rows]
            rows[group.pivot_rows] = inverse.transpose(0, 2, 1) @ (solved - known)
            rows[padding:] = 0.0

    @functools.cached_property
    def back(self) -> list[Float[np.ndarray, "b p r"]]:
        """Per group L⁻ᵀ Xᵀ: what the solution at a front's rest takes from that at its pivots."""
        with registry.blas.one():
            return [
                np.matmul(inverse.transpose(0, 2, 1), coupling.transpose(0, 2, 1))
                for _, inverse, coupling in self.fronts()
            ]

    def fronts(self) -> Iterator[tuple[FrontGroup, np.ndarray, np.ndarray]]:
        """Groups in the order of factorisation, each with its L⁻¹ and X."""
        return zip(self.plan.groups, self.inverse_pivots, self.couplings, strict=True)


def factorize(
    plan: CholeskyPlan,
    blocks: Float[np.ndarray, "k d d"],
    memory: Float[np.ndarray, " s"] | None = None,
) -> CholeskyFactor:
    """Factorises `H`.

    Args:
        plan: the pattern's plan.
        blocks: numbers of the blocks (`plan.block_row`, `plan.block_column`).
        memory: where to work and to put the factor, `plan.scalars` long; None: in new memory.

    Raises:
        NotPositiveDefiniteError: `H` is not positive definite, or not finite.
    """
    if not np.isfinite(blocks).all():
        raise NotPositiveDefiniteError("the matrix is not finite")
    d, scalars = plan.block_dim, plan.chunks * plan.block_dim
    pool = (np.empty(scalars) if memory is None else memory[:scalars]).reshape(-1, d)
    pool[:d] = np.eye(d)
    pool[d : d * (1 + len(blocks))] = blocks.reshape(-1, d)
    kept = np.empty(plan.scalars - scalars) if memory is None else memory[scalars:]
    factor = CholeskyFactor(plan, *_laid_out(plan, kept))
    try:
        with registry.blas.one():
            for group, *found in factor.fronts():
                _factorize_group(group, pool, *found)
    except np.linalg.LinAlgError as error:
        raise NotPositiveDefiniteError(str(error)) from error
    return factor


def _laid_out(
    plan: CholeskyPlan, kept: Float[np.ndarray, " s"]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The arrays of a factor, one after the other."""
    shapes = [
        (group.count, rows, group.pivots)
        for group in plan.groups
        for rows in (group.pivots, group.rest)
    ]
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    parts = [
        part.reshape(shape) for part, shape in zip(np.split(kept, ends[:-1]), shapes, strict=True)
    ]
    return parts[::2], parts[1::2]


def _factorize_group(
    group: FrontGroup,
    pool: np.ndarray,
    inverse: Float[np.ndarray, "b p p"],
    coupling: Float[np.ndarray, "b r p"],
) -> None:
    """Fills in the group's part of the factor, and its update matrices in the pool."""
    pivots, rest = group.pivots, group.rest
    fronts = (group.gather @ pool).reshape(group.count, pivots + rest, pivots + rest)
    stored = pool[group.update : group.update + group.count * rest * rest // pool.shape[1]]
    updates = stored.reshape(group.count, rest, rest)
    if pivots > LARGE_PIVOTS or pivots + rest > LARGE_FRONT:
        with registry.blas.many(pivots + rest > LARGE_FRONT):
            _invert_large(fronts[:, :pivots, :pivots], inverse)
            _couple(fronts, inverse, coupling, updates)
        return
    inverse[...] = inverse_triangles(np.linalg.cholesky(fronts[:, :pivots, :pivots]))
    _couple(fronts, inverse, coupling, updates)


def _couple(
    fronts: np.ndarray, inverse: np.ndarray, coupling: np.ndarray, updates: np.ndarray
) -> None:
    """X = B L⁻ᵀ and U."""
    pivots = inverse.shape[-1]
    np.matmul(fronts[:, pivots:, :pivots], inverse.transpose(0, 2, 1), out=coupling)
    _update(fronts[:, pivots:, pivots:], coupling, updates)


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


def _invert_large(blocks: np.ndarray, inverse: np.ndarray) -> None:
    """L⁻¹ of `A = L Lᵀ`, one by one; LAPACK sees a row-major lower triangle as an upper one."""
    from scipy.linalg import get_lapack_funcs

    potrf, trtri = get_lapack_funcs(("potrf", "trtri"), (blocks,))
    for block, found in zip(blocks, inverse, strict=True):
        upper, failed = potrf(block.T, lower=0, clean=1)
        if failed:
            raise np.linalg.LinAlgError("a pivot block is not positive definite")
        found[...] = trtri(upper, lower=0)[0].T
