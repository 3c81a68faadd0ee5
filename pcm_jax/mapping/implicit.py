"""Derivatives of the optimal poses by the data they came from: the implicit function theorem.

At the optimum X of 0.5 Σ w rᵀΩr, r = Log(z⁻¹ X_i⁻¹ X_j), the gradient by right perturbations is
zero, and stays so when the data move:

    g(X, z, Ω, w) = Σ w Jᵀ Ω r = 0,      H u = −ġ,      Ẋ = d/ds X exp(s u)

with ġ the derivative of g along the data's own, X held, and H = ∂g/∂X. H is the exact Hessian: JᵀΩJ
leaves out what the residuals' curvature adds, a few per cent of the derivative on real graphs. Edge
by edge it has the blocks of the normal equations, so their sparse factorisation serves here too.

Everything below is traced, the pattern included: the host finds its plan by content. It takes
one factorisation for a derivative, forward or reverse, and one for the Newton step that ends a
solve.
"""

from __future__ import annotations

import dataclasses
import functools
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pcm_jax import lie
from pcm_jax.lie import unrolled
from pcm_jax.mapping._callbacks import call_host
from pcm_jax.mapping._host_step import system_of
from pcm_jax.mapping._linearization import (
    Edges,
    apart,
    multiply,
    retract,
    slopes,
)
from pcm_jax.mapping.least_squares import ATOL, MAX_STEPS, RTOL
from pcm_jax.sparse import registry
from pcm_jax.sparse.cholesky import NotPositiveDefiniteError


class Pattern(NamedTuple):
    """The poses that each edge joins, padded; the last that counts is held, all others are free.

    Attributes:
        tail, head: int32 `[e]`; padded edges join the first pose to itself.
        free: bool `[n]`, false for the held pose and for padding.
        counts: int32 `[2]`, poses and edges that are no padding.
    """

    tail: Int[Array, " e"]
    head: Int[Array, " e"]
    free: Bool[Array, " n"]
    counts: Int[Array, "2"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Data:
    """The data that the optimum depends on, padded; padded edges have weight zero.

    Attributes:
        measurement: Lie `[e]`.
        information: `[e, d, d]`.
        weight: `[e]`, not negative; scales the information.
    """

    measurement: Any
    information: Float[Array, "e d d"]
    weight: Float[Array, " e"]


def pattern_of(
    tail: Int[Array, " e"],
    head: Int[Array, " e"],
    *,
    poses: Int[Array, ""],
    edges: Int[Array, ""],
    size: int,
) -> Pattern:
    """Pads a pattern.

    Args:
        tail, head: of all edges, those that count first; may be traced.
        poses: number of poses that count; the last is held.
        edges: number of edges that count; the others join the first pose to itself.
        size: padded number of poses, and of edges.
    """
    missing = (0, size - len(tail))
    counts = jnp.stack([poses, edges]).astype(jnp.int32)
    free = jnp.arange(size) < poses - 1
    return Pattern(jnp.pad(tail, missing), jnp.pad(head, missing), free, counts)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def optimum(solver: str, pattern: Pattern, start: Any, data: Data) -> tuple[Any, Bool[Array, ""]]:
    """The poses of least cost, differentiable by `data`, in both modes and more than once.

    Args:
        solver: "gauss-newton" or "levenberg-marquardt".
        pattern: see there.
        start: Lie `[n]`; the result does not depend on it, and no derivative is taken.
        data: see there.

    Returns:
        Poses, Lie `[n]`, and whether the solve converged to a minimum. Where it did not, the poses
        mean nothing and their derivatives are zero.
    """
    import optimistix as optx

    from pcm_jax.mapping._gauss_newton import Problem, least_squares

    lower = jnp.linalg.cholesky(data.information) * jnp.sqrt(data.weight)[:, None, None]
    edges = Edges(pattern.tail, pattern.head, data.measurement, jnp.moveaxis(lower, (0, 2), (2, 0)))
    problem = Problem(edges, pattern.free, pattern.counts, jnp.asarray(MAX_STEPS, jnp.int32))
    options = {"solver": solver, "engine": "blocks", "rtol": RTOL, "atol": ATOL}
    solution = least_squares(start, problem, **options)
    edges = _about(pattern, solution.value, data)
    newton = -_solve(pattern, _hessian(edges), _gradient(pattern, edges))
    poses = retract(solution.value, newton)
    finite = jnp.all(jnp.isfinite(lie.parameters(poses)))
    return poses, finite & (solution.result == optx.RESULTS.successful)


@optimum.defjvp
def _optimum_jvp(solver: str, primals: Any, tangents: Any) -> Any:
    pattern, start, data = primals
    poses, converged = optimum(solver, pattern, start, data)
    # Without a minimum, a harmless point instead: what is not finite must not meet a zero below.
    harmless = (_identities(poses), _harmless(data))
    at, near = jax.tree.map(lambda x, y: jnp.where(converged, x, y), (poses, data), harmless)
    edges = _about(pattern, at, near)
    step = -_solve(pattern, _hessian(edges), _change(pattern, edges, near, tangents[2]))
    step = jnp.where(converged, step, 0.0)
    _, velocity = jax.jvp(lambda s: retract(at, s), (jnp.zeros_like(step),), (step,))
    return (poses, converged), (velocity, np.zeros((), jax.dtypes.float0))


def _identities(poses: Any) -> Any:
    values = lie.parameters(poses)
    one = lie.identity(lie.group_of(poses), values.shape[:-1], xp=jnp)
    return lie.group_of(poses)(lie.parameters(one).astype(values.dtype))


def _harmless(data: Data) -> Data:
    unit = jnp.broadcast_to(jnp.eye(data.information.shape[-1]), data.information.shape)
    ones = jnp.ones_like(data.weight)
    return Data(_identities(data.measurement), unit.astype(data.information.dtype), ones)


class _Edges(NamedTuple):
    """Every edge to second order about some poses; matrices `[d, d, e]`, nothing whitened.

    With x = X_i⁻¹ X_j moved to x exp(δ), δ = δ_j − A δ_i, the residual changes by J δ; with z moved
    to exp(τ) z, by −J A τ. The gradient by δ is f = w Jᵀ Ω r, and changes by K δ:

        K = w (Jᵀ Ω + ∂(Jᵀ p)/∂r) J,      p = Ω r held in the derivative

    Attributes:
        residual: `[d, e]`, r.
        jacobian: J = Jr⁻¹(r).
        transport: A = Ad(x⁻¹).
        force: `[d, e]`, f.
        stiffness: K.
    """

    residual: Float[Array, "d e"]
    jacobian: Float[Array, "d d e"]
    transport: Float[Array, "d d e"]
    force: Float[Array, "d e"]
    stiffness: Float[Array, "d d e"]


def _about(pattern: Pattern, poses: Any, data: Data) -> _Edges:
    edges = Edges(pattern.tail, pattern.head, data.measurement, data.information)
    residual, jacobian, transport = slopes(poses, edges)
    back = jnp.swapaxes(jacobian, 0, 1)
    information = jnp.moveaxis(data.information, 0, -1) * data.weight
    pull = multiply(information, residual[:, None])
    always, group = pattern.tail[0] >= 0, lie.module_of(lie.group_of(poses))
    bent = apart(always, _bend, residual, pull[:, 0], static=(group,))
    curved = multiply(back, information) + bent
    force = multiply(back, pull)[:, 0]
    return _Edges(residual, jacobian, transport, force, multiply(curved, jacobian))


def _bend(
    group: ModuleType, residual: Float[Array, "d e"], pull: Float[Array, "d e"]
) -> Float[Array, "d d e"]:
    """∂(Jr⁻¹(r)ᵀ p)/∂r."""

    def pulled(moved: Float[Array, "d e"]) -> Float[Array, "d e"]:
        columns = zip(*group.right_jacobian_inverse(tuple(moved)), strict=True)
        return jnp.stack([unrolled.dot(column, tuple(pull)) for column in columns])

    units = jnp.eye(len(residual), dtype=residual.dtype)[:, :, None] + jnp.zeros_like(residual)
    along = jax.vmap(lambda unit: jax.jvp(pulled, (residual,), (unit,))[1])(units)
    return jnp.swapaxes(along, 0, 1)


def _gather(
    pattern: Pattern, by_tail: Float[Array, "d e"], by_head: Float[Array, "d e"]
) -> Float[Array, "n d"]:
    """Sums what edges contribute to their poses; nothing for held ones."""
    total = jnp.zeros((len(pattern.free), len(by_tail)), by_tail.dtype)
    total = total.at[pattern.tail].add(by_tail.T).at[pattern.head].add(by_head.T)
    return jnp.where(pattern.free[:, None], total, 0.0)


def _gradient(pattern: Pattern, edges: _Edges) -> Float[Array, "n d"]:
    """g, by right perturbations of the poses."""
    return _gather(pattern, *_both_ends(edges, edges.force))


def _both_ends(edges: _Edges, force: Float[Array, "d e"]) -> tuple[Array, Array]:
    """A gradient by δ as gradients by δ_i and by δ_j."""
    return -multiply(jnp.swapaxes(edges.transport, 0, 1), force[:, None])[:, 0], force


def _change(pattern: Pattern, edges: _Edges, data: Data, moved: Data) -> Float[Array, "n d"]:
    """ġ: how the gradient changes along the data's own velocity `moved`, the poses held."""
    group = lie.module_of(lie.group_of(data.measurement))
    velocity = lie.components(moved.measurement)
    turn = jnp.stack(group.left_tangent(lie.components(data.measurement), velocity))
    stiffer = data.information * moved.weight[:, None, None]
    stiffer += moved.information * data.weight[:, None, None]
    pull = multiply(jnp.moveaxis(stiffer, 0, -1), edges.residual[:, None])
    force = multiply(jnp.swapaxes(edges.jacobian, 0, 1), pull)
    force -= multiply(edges.stiffness, multiply(edges.transport, turn[:, None]))
    return _gather(pattern, *_both_ends(edges, force[:, 0]))


def _hessian(edges: _Edges) -> Float[Array, "3 e d d"]:
    """H by edges: its tail-tail, head-head and head-tail blocks, Aᵀ K A, K and −K A.

    The first two are symmetrised: what is skew in K is the bracket of two perturbations of one
    pose, and adds up to nothing where the gradient is zero.
    """
    both = -multiply(edges.stiffness, edges.transport)
    by_head = 0.5 * (edges.stiffness + jnp.swapaxes(edges.stiffness, 0, 1))
    back = jnp.swapaxes(edges.transport, 0, 1)
    by_tail = multiply(back, multiply(by_head, edges.transport))
    return jnp.moveaxis(jnp.stack([by_tail, by_head, both]), -1, 1)


def _solve(
    pattern: Pattern, products: Float[Array, "3 e d d"], right: Float[Array, "n d"]
) -> Float[Array, "n d"]:
    """H⁻¹ `right`, for a right side that is zero at held poses; linear in it, and symmetric."""

    def times_hessian(step: Float[Array, "n d"]) -> Float[Array, "n d"]:
        step = jnp.where(pattern.free[:, None], step, 0.0)
        tail, head = step[pattern.tail], step[pattern.head]
        by_tail = jnp.einsum("eij,ej->ie", products[0], tail)
        by_tail += jnp.einsum("eji,ej->ie", products[2], head)
        by_head = jnp.einsum("eij,ej->ie", products[1], head)
        by_head += jnp.einsum("eij,ej->ie", products[2], tail)
        return _gather(pattern, by_tail, by_head)

    def solve(_: Any, vector: Float[Array, "n d"]) -> Float[Array, "n d"]:
        struct = jax.ShapeDtypeStruct(vector.shape, vector.dtype)
        return call_host(_solve_on_host, struct, *pattern, products, vector)

    return jax.lax.custom_linear_solve(times_hessian, right, solve, symmetric=True)


def _solve_on_host(out: np.ndarray, *arguments: np.ndarray) -> None:
    """Body of the callback: H⁻¹ `right` into `out`, NaN if H has no factor.

    It is the last of its solve's factorisations, or of a derivative's, so no memory is kept.
    """
    *pattern, products, right = arguments
    system = system_of(pattern, products.shape[-1])
    known = right[: system.size].astype(np.float64, copy=False)
    with registry.spare.borrow(system.plan.scalars, last=True) as memory:
        try:
            factor = system.factorize(products.astype(np.float64, copy=False), 0.0, memory)
        except NotPositiveDefiniteError:
            out[...] = np.nan
        else:
            out[...] = 0.0
            out[: system.size] = factor.solve(known.ravel()).reshape(known.shape)
