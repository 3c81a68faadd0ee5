"""The linear part of a step: the block-sparse Jacobian and the solvers of its normal equations.

`(Jᵀ J + λ diag(Jᵀ J)) δ = Jᵀ r` with `J` held as two `d x d` blocks per edge. `BlockJacobian` is a
lineax operator, `BlockCholesky` and `Cholmod` are lineax solvers, so that optimistix's descents use
them like any other.

The pattern of `J` is traced, so that graphs of different shapes but equal padded sizes share one
compilation; the host finds what follows from it by content (`sparse.system`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from pcm_jax.mapping._callbacks import call_host
from pcm_jax.mapping._host_step import solve_on_host
from pcm_jax.mapping._linearization import EdgeProducts, apart, differential, edge_products


class BlockJacobian(lx.AbstractLinearOperator):
    """The Jacobian of all whitened residuals `[d, e]` by right perturbations `[n, d]`.

    Attributes:
        tail, head: `[e]` poses of each edge.
        by_tail, by_head: `[d, d, e]` blocks.
        free: `[n]` poses that may move; the others' columns are zero.
        counts: poses and edges that are no padding, `[2]`.
    """

    tail: Int[Array, " e"]
    head: Int[Array, " e"]
    by_tail: Float[Array, "d d e"]
    by_head: Float[Array, "d d e"]
    free: Bool[Array, " n"]
    counts: Int[Array, "2"]

    def mv(self, vector: Float[Array, "n d"]) -> Float[Array, "d e"]:
        """J δ."""
        step = jnp.where(self.free[:, None], vector, 0.0).T
        return differential(self.by_tail, self.by_head, self.tail, self.head, step)

    def as_matrix(self) -> Float[Array, "a b"]:
        """Dense J, for small problems."""
        return _dense(self)

    def transpose(self) -> lx.AbstractLinearOperator:
        """Jᵀ."""
        return _transpose(self)

    def in_structure(self) -> jax.ShapeDtypeStruct:
        """`[n, d]`."""
        return jax.ShapeDtypeStruct((len(self.free), len(self.by_tail)), self.by_tail.dtype)

    def out_structure(self) -> jax.ShapeDtypeStruct:
        """`[d, e]`."""
        return jax.ShapeDtypeStruct(self.by_tail.shape[1:], self.by_tail.dtype)


class DampedJacobian(lx.AbstractLinearOperator):
    """J above √(λ diag(JᵀJ)), whose normal equations are those of Levenberg-Marquardt.

    Attributes:
        jacobian: J.
        damping: λ, relative to the diagonal.
    """

    jacobian: BlockJacobian
    damping: Float[Array, ""]

    def mv(self, vector: Float[Array, "n d"]) -> tuple[Float[Array, "d e"], Float[Array, "n d"]]:
        """J δ and √(λ diag(JᵀJ)) δ."""
        return self.jacobian.mv(vector), self.weight() * vector

    def weight(self) -> Float[Array, "n d"]:
        """√(λ diag(JᵀJ))."""
        jacobian = self.jacobian
        squared = [jnp.sum(by * by, axis=0).T for by in (jacobian.by_tail, jacobian.by_head)]
        diagonal = jnp.zeros(jacobian.in_structure().shape, jacobian.by_tail.dtype)
        diagonal = diagonal.at[jacobian.tail].add(squared[0]).at[jacobian.head].add(squared[1])
        return jnp.sqrt(self.damping * jnp.where(jacobian.free[:, None], diagonal, 0.0))

    def as_matrix(self) -> Float[Array, "a b"]:
        """Dense, for small problems."""
        return _dense(self)

    def transpose(self) -> lx.AbstractLinearOperator:
        """Jᵀ beside √(λ diag(JᵀJ))."""
        return _transpose(self)

    def in_structure(self) -> jax.ShapeDtypeStruct:
        """`[n, d]`."""
        return self.jacobian.in_structure()

    def out_structure(self) -> tuple[jax.ShapeDtypeStruct, jax.ShapeDtypeStruct]:
        """`[d, e]` and `[n, d]`."""
        return self.jacobian.out_structure(), self.jacobian.in_structure()


def _dense(operator: BlockJacobian | DampedJacobian) -> Float[Array, "a b"]:
    struct = operator.in_structure()

    def column(unit: Float[Array, " b"]) -> Float[Array, " a"]:
        return ravel_pytree(operator.mv(unit.reshape(struct.shape)))[0]

    return jax.vmap(column)(jnp.eye(operator.in_size(), dtype=struct.dtype)).T


def _transpose(operator: BlockJacobian | DampedJacobian) -> lx.AbstractLinearOperator:
    transposed = jax.linear_transpose(operator.mv, operator.in_structure())
    return lx.FunctionLinearOperator(lambda r: transposed(r)[0], operator.out_structure())


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
    for _kind in (BlockJacobian, DampedJacobian):
        _property.register(_kind)(lambda operator: False)
for _identity in (lx.linearise, lx.materialise, lx.conj):
    for _kind in (BlockJacobian, DampedJacobian):
        _identity.register(_kind)(lambda operator: operator)


class _Damped(NamedTuple):
    """The equations that an engine solves: `(JᵀJ + λ diag(JᵀJ)) δ = Jᵀ r + √(λ diag(JᵀJ)) s`.

    Attributes:
        damped: both operators in one form, an undamped one with λ = 0.
        products: of the edges, with r.
        below: s.
    """

    damped: DampedJacobian
    products: EdgeProducts
    below: Float[Array, "n d"]


def _equations(state: BlockJacobian | DampedJacobian, vector: Any) -> _Damped:
    if isinstance(state, BlockJacobian):
        like = state.in_structure()
        vector = vector, jnp.zeros(like.shape, like.dtype)
        state = DampedJacobian(state, jnp.zeros((), like.dtype))
    residual, below = vector
    jacobian = state.jacobian
    parts = jacobian.by_tail, jacobian.by_head, residual
    return _Damped(state, apart(jacobian.tail[0] >= 0, edge_products, *parts), below)


class _NormalEquationsSolver(lx.AbstractLinearSolver):
    """The protocol of lineax that both engines share, around `(JᵀJ + λ diag) δ = Jᵀ r`."""

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> Any:
        """The operator is all the state."""
        del options
        if not isinstance(operator, BlockJacobian | DampedJacobian):
            raise TypeError(f"operator: expected a BlockJacobian, found {type(operator).__name__}")
        return operator

    def _status(self, step: Array) -> tuple[Array, lx.RESULTS, dict[str, Any]]:
        failed = ~jnp.all(jnp.isfinite(step))
        result = lx.RESULTS.where(failed, lx.RESULTS.singular, lx.RESULTS.successful)
        return step, result, {}

    def transpose(self, state: Any, options: dict[str, Any]) -> Any:
        """Not offered: the least-squares problem of Jᵀ is another one."""
        raise NotImplementedError("the normal equations of a transposed Jacobian")

    def conj(self, state: Any, options: dict[str, Any]) -> Any:
        """J is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """A singular system is reported as such."""
        return True


class BlockCholesky(_NormalEquationsSolver):
    """The default engine: NumPy's and LAPACK's block Cholesky factorisation, on the host."""

    def compute(
        self, state: BlockJacobian | DampedJacobian, vector: Any, options: dict[str, Any]
    ) -> tuple[Array, lx.RESULTS, dict[str, Any]]:
        """δ `[n, d]`; NaN and `RESULTS.singular` if there is no factor."""
        del options
        equations = _equations(state, vector)
        jacobian = equations.damped.jacobian
        pattern = jacobian.tail, jacobian.head, jacobian.free, jacobian.counts
        numbers = equations.damped.damping, *equations.products, equations.below
        step = call_host(solve_on_host, state.in_structure(), *pattern, *numbers)
        return self._status(step)


class Cholmod(_NormalEquationsSolver):
    """CHOLMOD (Chen et al. 2008) through sparsax, the `cholmod` extra: native code, no callback."""

    def compute(
        self, state: BlockJacobian | DampedJacobian, vector: Any, options: dict[str, Any]
    ) -> tuple[Array, lx.RESULTS, dict[str, Any]]:
        """δ `[n, d]`; NaN and `RESULTS.singular` if there is no factor."""
        import sparsax

        del options
        damped, (products, gradients), below = _equations(state, vector)
        jacobian = damped.jacobian
        row, column, value = _upper_triangle(damped, products)
        gradient = damped.weight() * below
        gradient = gradient.at[jacobian.tail].add(gradients[0])
        gradient = gradient.at[jacobian.head].add(gradients[1])
        gradient = jnp.where(jacobian.free[:, None], gradient, 0.0)
        step = sparsax.solve(row, column, value, gradient.ravel())
        return self._status(step.reshape(gradient.shape))


def _upper_triangle(damped: DampedJacobian, products: Array) -> tuple[Array, Array, Array]:
    """Coordinates of `H + λ diag(H)`: the diagonal blocks' triangles, and a block for every edge.

    Blocks of equal place are repeated, which CHOLMOD sums; entries below the diagonal are left out.
    """
    state, damping = damped.jacobian, damped.damping
    size, identity = products.shape[-1], jnp.eye(products.shape[-1])
    diagonal = jnp.zeros((len(state.free), size, size), products.dtype)
    diagonal = diagonal.at[state.tail].add(products[0]).at[state.head].add(products[1])
    diagonal *= 1.0 + damping * identity
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
