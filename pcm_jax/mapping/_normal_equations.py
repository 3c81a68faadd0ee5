"""The linear part of a step: the block-sparse Jacobian and what solves its normal equations.

`(Jᵀ J + λ diag(Jᵀ J)) δ = Jᵀ r` with `J` held as two `d x d` blocks per edge. `BlockJacobian` is a
lineax operator, `BlockCholesky` and `Cholmod` are lineax solvers, so that optimistix's descents use
them like any other.

The pattern of `J` lives on the host (`System`): a traced integer names it, so that graphs of
different shapes but equal padded sizes share one compilation. The numbers cross over without a
copy by JAX's buffer callback; `jax.pure_callback` copies its arguments on JAX's own threads, and
deadlocks where those wait for the callback (jax issue 24255; it does on one core).
"""

from __future__ import annotations

import functools
import itertools
from typing import Any
from weakref import WeakValueDictionary

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pcm_jax.mapping._linearization import EdgeProducts, apart, edge_products
from pcm_jax.sparse.assembly import CholeskyPlan, plan_for
from pcm_jax.sparse.cholesky import (
    CholeskyFactor,
    NotPositiveDefiniteError,
    factorize,
    spare_memory,
)
from pcm_jax.sparse.pattern_cache import PatternCache


class System:
    """The pattern of a pose graph's normal equations, with some poses held fixed.

    Attributes:
        size, edges: unpadded numbers of poses and edges.
        handle: the number by which traced code names this system.
    """

    def __init__(
        self,
        size: int,
        tail: np.ndarray,
        head: np.ndarray,
        fixed: np.ndarray,
        block_dim: int,
    ):
        self.size, self.edges = size, len(tail)
        self.fixed = np.flatnonzero(fixed)
        self.tail, self.head = tail, head
        self.free_tail, self.free_head = ~fixed[tail], ~fixed[head]
        self.both = np.flatnonzero(self.free_tail & self.free_head)
        self._pattern = size, tail[self.both], head[self.both], block_dim
        self.handle = next(_handles)
        _systems[self.handle] = self

    @property
    def plan(self) -> CholeskyPlan:
        """Of the factorisation; edges between the same two poses share a block.

        Made when it is first needed, which CHOLMOD never does, and kept by its own cache.
        """
        return plan_for(*self._pattern)

    @functools.cached_property
    def _sum_blocks(self) -> tuple[Any, Any, Any, Any]:
        """0/1 matrices from the edges' products to the blocks of `H`.

        For those of tails, of heads, and of both; and for the last that are to be transposed.
        """
        plan, both = self.plan, self.both
        tails, heads = np.flatnonzero(self.free_tail), np.flatnonzero(self.free_head)
        as_given, flipped = ~plan.edge_transposed, plan.edge_transposed
        blocks, edges = len(plan.block_row), self.edges
        return (
            _ones(plan.position[self.tail[tails]], tails, (blocks, edges)),
            _ones(plan.position[self.head[heads]], heads, (blocks, edges)),
            _ones(plan.edge_block[as_given], both[as_given], (blocks, edges)),
            _ones(plan.edge_block[flipped], np.arange(flipped.sum()), (blocks, flipped.sum())),
        )

    @functools.cached_property
    def _sum_gradient(self) -> Any:
        """0/1 matrix from the edges' (tail, head) gradients to the poses."""
        tails, heads = np.flatnonzero(self.free_tail), np.flatnonzero(self.free_head)
        pose = np.concatenate([self.tail[tails], self.head[heads]])
        source = np.concatenate([tails, heads + self.edges])
        return _ones(pose, source, (self.size, 2 * self.edges))

    def factorize(
        self,
        products: Float[np.ndarray, "3 e d d"],
        damping: float = 0.0,
        memory: Float[np.ndarray, " s"] | None = None,
    ) -> CholeskyFactor:
        """Factorises `H + λ diag(H)`; fixed poses have identity blocks.

        Args:
            products: per edge JᵗᵀJᵗ, JʰᵀJʰ and JʰᵀJᵗ (t: tail, h: head); padding is ignored.
            damping: λ.
            memory: as for `cholesky.factorize`.

        Raises:
            NotPositiveDefiniteError: the system is singular or not finite.
        """
        plan = self.plan
        d = plan.block_dim
        flipped = products[2, self.both[plan.edge_transposed]].transpose(0, 2, 1)
        parts = *products[:, : self.edges], flipped
        blocks = np.zeros((len(plan.block_row), d, d))
        for sums, part in zip(self._sum_blocks, parts, strict=True):
            blocks += (sums @ part.reshape(len(part), d * d)).reshape(blocks.shape)
        scalar = np.arange(d)
        blocks[: self.size, scalar, scalar] *= 1.0 + damping
        blocks[plan.position[self.fixed]] = np.eye(d)
        return factorize(plan, blocks, memory)

    def gradient(self, gradients: Float[np.ndarray, "2 e d"]) -> Float[np.ndarray, "n d"]:
        """Jᵀ r of every pose; zero for fixed ones."""
        terms = np.ascontiguousarray(gradients[:, : self.edges])
        return self._sum_gradient @ terms.reshape(-1, gradients.shape[2])


_handles = itertools.count()
_systems: WeakValueDictionary[int, System] = WeakValueDictionary()
_recent: PatternCache[System] = PatternCache()


def _ones(row: np.ndarray, column: np.ndarray, shape: tuple[int, int]) -> Any:
    from scipy.sparse import csr_array

    return csr_array((np.ones(len(row)), (row, column)), shape=shape)


def system_for(
    size: int,
    tail: Int[np.ndarray, " e"],
    head: Int[np.ndarray, " e"],
    fixed: Bool[np.ndarray, " n"],
    block_dim: int,
) -> System:
    """The system of a pattern, made once and then found by content.

    The caller keeps the result for as long as traced code may use its handle.
    """
    tail, head = np.asarray(tail, np.int64), np.asarray(head, np.int64)
    return _recent.get(
        lambda: System(size, tail, head, fixed, block_dim),
        size,
        block_dim,
        tail,
        head,
        np.flatnonzero(fixed),
    )


def system_of(handle: Any) -> System:
    """The system that a handle names, which somebody has kept."""
    return _systems[int(np.asarray(handle))]


class BlockJacobian(lx.AbstractLinearOperator):
    """The Jacobian of all whitened residuals `[d, e]` by right perturbations `[n, d]`.

    Attributes:
        tail, head: `[e]` poses of each edge.
        by_tail, by_head: `[d, d, e]` blocks.
        free: `[n]` poses that may move; the others' columns count as absent.
        system: handle of the pattern.
        damping: λ of Levenberg-Marquardt, relative to the diagonal of JᵀJ; read by the solvers
            below, not by `mv`.
    """

    tail: Int[Array, " e"]
    head: Int[Array, " e"]
    by_tail: Float[Array, "d d e"]
    by_head: Float[Array, "d d e"]
    free: Bool[Array, " n"]
    system: Int[Array, ""]
    damping: Float[Array, ""]

    def mv(self, vector: Float[Array, "n d"]) -> Float[Array, "d e"]:
        """J δ."""
        step = vector.T
        return jnp.einsum("ijk,jk->ik", self.by_tail, step[:, self.tail]) + jnp.einsum(
            "ijk,jk->ik", self.by_head, step[:, self.head]
        )

    def as_matrix(self) -> Float[Array, "a b"]:
        """Dense J, for small problems."""
        size = self.in_size()
        columns = jax.vmap(lambda unit: self.mv(unit.reshape(len(self.free), -1)).ravel())(
            jnp.eye(size, dtype=self.by_tail.dtype)
        )
        return columns.T

    def transpose(self) -> lx.AbstractLinearOperator:
        """Jᵀ."""
        transposed = jax.linear_transpose(self.mv, self.in_structure())
        return lx.FunctionLinearOperator(lambda r: transposed(r)[0], self.out_structure())

    def in_structure(self) -> jax.ShapeDtypeStruct:
        """`[n, d]`."""
        return jax.ShapeDtypeStruct((len(self.free), len(self.by_tail)), self.by_tail.dtype)

    def out_structure(self) -> jax.ShapeDtypeStruct:
        """`[d, e]`."""
        return jax.ShapeDtypeStruct(self.by_tail.shape[1:], self.by_tail.dtype)


for _property in (
    lx.is_symmetric,
    lx.is_diagonal,
    lx.is_tridiagonal,
    lx.is_lower_triangular,
    lx.is_upper_triangular,
    lx.is_positive_semidefinite,
    lx.is_negative_semidefinite,
    lx.has_unit_diagonal,
):
    _property.register(BlockJacobian)(lambda operator: False)
for _identity in (lx.linearise, lx.materialise, lx.conj):
    _identity.register(BlockJacobian)(lambda operator: operator)


def _products_of(jacobian: BlockJacobian, residual: Array) -> EdgeProducts:
    parts = jacobian.by_tail, jacobian.by_head, residual
    return apart(jacobian.tail[0] >= 0, edge_products, *parts)


def _solve_on_host(
    context: Any, step: Any, handle: Any, damping: Any, products: Any, gradients: Any
) -> None:
    """Body of the callback: δ into the buffer `step`, NaN if there is no factor."""
    del context
    system = system_of(handle)
    out, products = np.asarray(step), np.asarray(products).astype(np.float64, copy=False)
    gradient = system.gradient(np.asarray(gradients).astype(np.float64, copy=False))
    out[...] = 0.0
    with spare_memory(system.plan.scalars) as memory:
        try:
            factor = system.factorize(products, float(np.asarray(damping)), memory)
        except NotPositiveDefiniteError:
            out[...] = np.nan
        else:
            out[: system.size] = factor.solve(gradient.ravel()).reshape(gradient.shape)


class _NormalEquationsSolver(lx.AbstractLinearSolver):
    """What the two engines share: lineax's protocol around `(JᵀJ + λ diag) δ = Jᵀ r`."""

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> BlockJacobian:
        """The operator is all the state."""
        del options
        if not isinstance(operator, BlockJacobian):
            raise TypeError(f"operator: expected a BlockJacobian, found {type(operator).__name__}")
        return operator

    def _status(self, step: Array) -> tuple[Array, lx.RESULTS, dict[str, Any]]:
        failed = ~jnp.all(jnp.isfinite(step))
        result = lx.RESULTS.where(failed, lx.RESULTS.singular, lx.RESULTS.successful)
        return step, result, {}

    def transpose(self, state: BlockJacobian, options: dict[str, Any]) -> Any:
        """Not offered: the least-squares problem of Jᵀ is another one."""
        raise NotImplementedError("the normal equations of a transposed Jacobian")

    def conj(self, state: BlockJacobian, options: dict[str, Any]) -> Any:
        """J is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """A singular system is reported as such."""
        return True


class BlockCholesky(_NormalEquationsSolver):
    """The default engine: NumPy's and LAPACK's block Cholesky factorisation, on the host."""

    def compute(
        self, state: BlockJacobian, vector: Float[Array, "d e"], options: dict[str, Any]
    ) -> tuple[Array, lx.RESULTS, dict[str, Any]]:
        """δ `[n, d]`; NaN and `RESULTS.singular` if there is no factor."""
        from jax.experimental.buffer_callback import buffer_callback

        del options
        edges = _products_of(state, vector)
        solve = buffer_callback(_solve_on_host, state.in_structure(), vmap_method="sequential")
        step = solve(state.system, state.damping, edges.products, edges.gradients)
        return self._status(step)


class Cholmod(_NormalEquationsSolver):
    """CHOLMOD (Chen et al. 2008) through sparsax, the `cholmod` extra: native code, no callback."""

    def compute(
        self, state: BlockJacobian, vector: Float[Array, "d e"], options: dict[str, Any]
    ) -> tuple[Array, lx.RESULTS, dict[str, Any]]:
        """δ `[n, d]`; NaN and `RESULTS.singular` if there is no factor."""
        import sparsax

        del options
        edges = _products_of(state, vector)
        row, column, value = _upper_triangle(state, edges.products)
        gradient = jnp.zeros((len(state.free), len(vector)), vector.dtype)
        gradient = gradient.at[state.tail].add(edges.gradients[0])
        gradient = gradient.at[state.head].add(edges.gradients[1])
        gradient = jnp.where(state.free[:, None], gradient, 0.0)
        step = sparsax.solve(row, column, value, gradient.ravel())
        return self._status(step.reshape(gradient.shape))


def _upper_triangle(state: BlockJacobian, products: Array) -> tuple[Array, Array, Array]:
    """Coordinates of `H + λ diag(H)`: the diagonal blocks' triangles, and a block for every edge.

    Blocks of equal place are repeated, which CHOLMOD sums; entries below the diagonal are left out.
    """
    size, identity = products.shape[-1], jnp.eye(products.shape[-1])
    diagonal = jnp.zeros((len(state.free), size, size), products.dtype)
    diagonal = diagonal.at[state.tail].add(products[0]).at[state.head].add(products[1])
    diagonal *= 1.0 + state.damping * identity
    diagonal = jnp.where(state.free[:, None, None], diagonal, identity)
    i, j = np.triu_indices(size)
    own = jnp.arange(len(state.free))[:, None] * size
    scalar = np.arange(size)
    t, h = state.tail[:, None, None] * size, state.head[:, None, None] * size
    below = t + scalar + 0 * scalar[:, None], h + scalar[:, None] + 0 * scalar  # of JhᵀJt
    forward = t < h
    between = products[2] * (state.free[state.tail] & state.free[state.head])[:, None, None]
    parts = (
        (own + i, own + j, diagonal[:, i, j]),
        (
            jnp.where(forward, below[0], below[1]),
            jnp.where(forward, below[1], below[0]),
            between,
        ),
    )
    row, column, value = (jnp.concatenate([p[k].ravel() for p in parts]) for k in range(3))
    return row.astype(jnp.int32), column.astype(jnp.int32), value
