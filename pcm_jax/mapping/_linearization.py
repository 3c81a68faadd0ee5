"""Residuals of the edges and their Jacobians, entry by entry over arrays `[…, edges]`.

An edge from pose `i` to pose `j` with measurement `z` and information `Ω = L Lᵀ` has the residual

    r = Log( z⁻¹ x ),  x = X_i⁻¹ X_j,  whitened: Lᵀ r.

With right perturbations `X exp(δ)`:  z⁻¹ X_i⁻¹ X_j exp(δ_j) gives  ∂r/∂δ_j = Jr⁻¹(r),  and
`exp(−δ_i) x = x exp(−Ad(x⁻¹) δ_i)` gives  ∂r/∂δ_i = −Jr⁻¹(r) Ad(x⁻¹).

Pure kernels: jit-, vmap- and grad-safe, evaluated once per step of the optimiser. A small map's
arrays in NumPy are linearised in NumPy, by the same formulas.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import namespace

T = TypeVar("T")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Edges:
    """The edges of a least-squares problem, padded; padded edges have zero `whitening`.

    Attributes:
        tail, head: `[e]` poses.
        measurement: Lie `[e]`, seen from `tail`.
        whitening: `[d, d, e]`, Lᵀ.
    """

    tail: Int[Array, " e"]
    head: Int[Array, " e"]
    measurement: lie.Transform  # type: ignore[valid-type]
    whitening: Float[Array, "d d e"]

    def part(self, some: slice) -> Edges:
        """Some of the edges."""
        measurement = lie.take(self.measurement, some)
        return Edges(self.tail[some], self.head[some], measurement, self.whitening[..., some])


class EdgeJacobians(NamedTuple):
    """Whitened residuals and Jacobians of all edges.

    Attributes:
        residual: `[d, e]`.
        tail, head: `[d, d, e]` derivatives by the right perturbations of the two poses.
    """

    residual: Float[Array, "d e"]
    tail: Float[Array, "d d e"]
    head: Float[Array, "d d e"]


def apart(
    always: Bool[Array, ""], function: Callable[..., T], *arguments: Any, static: tuple = ()
) -> T:
    """`function(*static, *arguments)`, compiled apart from what comes before and after it.

    XLA fuses elementwise code without bound and evaluates a shared subexpression once for each of
    the 36 entries that use it: linearising 6,000 SE(3) edges took 114 ms, in stages it takes 3 ms.
    It does not fuse across a conditional (and drops optimization barriers before it fuses).

    NumPy's arrays are computed in NumPy, which compiles nothing.

    Args:
        always: a traced value that is True, but not to the compiler's knowledge.
        function: of a module, so that it is traced once for all who call it with equal shapes.
        arguments: arrays.
        static: hashable leading arguments.
    """
    if all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(arguments)):
        return function(*static, *arguments)
    traced = _traced_once(function, static)
    struct = jax.eval_shape(traced, *arguments)
    absent = functools.partial(jax.tree.map, lambda x: jnp.full(x.shape, jnp.nan, x.dtype), struct)
    return jax.lax.cond(always, traced, lambda *_: absent(), *arguments)


@functools.lru_cache(maxsize=64)
def _traced_once(function: Callable[..., T], static: tuple) -> Callable[..., T]:
    return jax.jit(functools.partial(function, *static))


def _relative(poses: Any, edges: Edges) -> tuple[Any, Any]:
    """X = X_i⁻¹ X_j and r = Log(z⁻¹ x), in entries."""
    group = lie.module_of(lie.group_of(poses))
    from_pose = lie.components(lie.take(poses, edges.tail))
    to_pose = lie.components(lie.take(poses, edges.head))
    relative = group.compose(group.inverse(from_pose), to_pose)
    error = group.compose(group.inverse(lie.components(edges.measurement)), relative)
    return relative, group.log(error)


def multiply(a: Float[Array, "i j e"], b: Float[Array, "j k e"]) -> Float[Array, "i k e"]:
    """A B for every edge, as elementwise arithmetic along the edges."""
    return sum(a[:, j, None] * b[None, j] for j in range(len(b)))  # type: ignore[return-value]


def differential(
    by_tail: Float[Array, "d d e"],
    by_head: Float[Array, "d d e"],
    tail: Int[Array, " e"],
    head: Int[Array, " e"],
    step: Float[Array, "d n"],
) -> Float[Array, "d e"]:
    """J δ, from the blocks of J and right perturbations of the poses."""
    einsum = namespace(by_tail).einsum
    along = einsum("ijk,jk->ik", by_tail, step[:, tail])
    return along + einsum("ijk,jk->ik", by_head, step[:, head])


def whitened_residual(poses: Any, edges: Edges) -> Float[Array, "d e"]:
    """Lᵀ Log(z⁻¹ X_i⁻¹ X_j) of every edge; half the sum of its squares is the cost."""
    _, residual = apart(edges.tail[0] >= 0, _relative, poses, edges)
    return multiply(edges.whitening, namespace(*residual).stack(residual)[:, None])[:, 0]


class Slopes(NamedTuple):
    """Residuals and how they change with x = X_i⁻¹ X_j, no edge weighed.

    Attributes:
        residual: `[d, e]`, r.
        slope: `[d, d, e]`, Jr⁻¹(r): r by a right perturbation of x.
        transport: `[d, d, e]`, Ad(x⁻¹): what a right perturbation of X_i is to x, negated.
    """

    residual: Float[Array, "d e"]
    slope: Float[Array, "d d e"]
    transport: Float[Array, "d d e"]


def slopes(poses: Any, edges: Edges) -> Slopes:
    """Unwhitened residuals and the two factors of their derivatives."""
    always, group = edges.tail[0] >= 0, lie.module_of(lie.group_of(poses))
    return apart(always, _factors, *apart(always, _relative, poses, edges), static=(group,))


def _factors(group: ModuleType, relative: Any, residual: Any) -> Slopes:
    slope = _dense(group.right_jacobian_inverse(residual), residual[0])
    transport = _dense(group.adjoint(group.inverse(relative)), residual[0])
    return Slopes(namespace(*residual).stack(residual), slope, transport)


def linearize(poses: Any, edges: Edges) -> EdgeJacobians:
    """Whitened residuals and their derivatives by right perturbations of the poses."""
    always = edges.tail[0] >= 0
    residual, slope, transport = slopes(poses, edges)
    by_head = apart(always, multiply, edges.whitening, slope)
    by_tail = apart(always, multiply, -by_head, transport)
    return EdgeJacobians(multiply(edges.whitening, residual[:, None])[:, 0], by_tail, by_head)


class EdgeProducts(NamedTuple):
    """The share of every edge in the normal equations, edges first.

    Attributes:
        products: JᵗᵀJᵗ, JʰᵀJʰ and JʰᵀJᵗ (t: tail, h: head).
        gradients: Jᵗᵀ r and Jʰᵀ r.
    """

    products: Float[Array, "3 e d d"]
    gradients: Float[Array, "2 e d"]


def edge_products(
    by_tail: Float[Array, "d d e"], by_head: Float[Array, "d d e"], residual: Float[Array, "d e"]
) -> EdgeProducts:
    """Products of the edges' Jacobians with each other and with the residual."""
    xp = namespace(by_tail, by_head, residual)
    to_tail, to_head = xp.swapaxes(by_tail, 0, 1), xp.swapaxes(by_head, 0, 1)
    pairs = ((to_tail, by_tail), (to_head, by_head), (to_head, by_tail))
    products = xp.moveaxis(xp.stack([multiply(*pair) for pair in pairs]), -1, 1)
    return EdgeProducts(products, edge_gradients(by_tail, by_head, residual))


def edge_gradients(
    by_tail: Float[Array, "d d e"], by_head: Float[Array, "d d e"], residual: Float[Array, "d e"]
) -> Float[Array, "2 e d"]:
    """`EdgeProducts.gradients` alone."""
    xp = namespace(by_tail, by_head, residual)
    transposed = (xp.swapaxes(by, 0, 1) for by in (by_tail, by_head))
    gradients = [multiply(by, residual[:, None])[:, 0] for by in transposed]
    return xp.moveaxis(xp.stack(gradients), -1, 1)


def _dense(matrix: Any, like: Array) -> Float[Array, "i j e"]:
    xp = namespace(like)
    rows = [[xp.broadcast_to(xp.asarray(x, like.dtype), like.shape) for x in r] for r in matrix]
    return xp.stack([xp.stack(row) for row in rows])


def retract(poses: Any, step: Float[Array, "n d"]) -> Any:
    """X exp(δ), scaled back to the group so that rounding does not add up."""
    kind = lie.group_of(poses)
    group = lie.module_of(kind)
    xp = namespace(step)
    moved = group.compose(lie.components(poses), group.exp(tuple(xp.moveaxis(step, -1, 0))))
    return lie.from_components(kind, group.normalize(moved))


def whitening_of(information: Float[np.ndarray, "e d d"]) -> Float[np.ndarray, "d d e"]:
    """Lᵀ with Ω = L Lᵀ, on the host; Ω may lack directions, as that of a position's prior does."""
    try:
        lower = np.linalg.cholesky(information)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(information)
        lower = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return np.ascontiguousarray(np.moveaxis(lower, (0, 1, 2), (2, 1, 0)))
