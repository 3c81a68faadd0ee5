"""The loop error's q² without a Jacobian, for all pairs in one vectorised loop.

Let T_u = X_i z_u Y_k⁻¹ be where closure u alone would put map b in map a. With all errors taken as
left perturbations in the maps' frames, and G of `problem`,

    r_uv  = Log(T_v T_u⁻¹),     Z_u = Ad(X_i z_u) Σ_zu Ad(X_i z_u)ᵀ
    M_uv  = Ga_ij + Ad(T_v) Gb_kl Ad(T_v)ᵀ + Z_u + Z_v
    q²_uv = r_uvᵀ M_uv⁻¹ r_uv

Derivation. Seen from X_i z_u, the loop of eq. 4 is T_v T_u⁻¹, so r = Ad(X_i z_u) ε. Perturbing
x_ij, z_u, z_v and x_lk turns it into exp(e) T_v T_u⁻¹ with, to first order,
e = (ξ_j − ξ_i) + ζ_v − ζ_u − Ad(T_v)(η_l − η_k), whose covariance is M_uv (ζ = Ad(X z) δ: the
measurement's error in map a's frame; ξ and η: the maps'). Log(exp(e) exp(r)) = r + Jl(r)⁻¹ e, so
εᵀ Σ⁻¹ ε = (Jl(r) r)ᵀ M⁻¹ (Jl(r) r), and Jl(r) r = r. No approximation is added to eq. 4's.

q²_vu is the same with Ad(T_u) in place of Ad(T_v); G, Z and r (up to sign) are shared. Nothing is
inverted but M, so closures that share a pose (G = 0) are no special case.
"""

from __future__ import annotations

import functools
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from pcm_jax import lie
from pcm_jax.consistency.problem import ConsistencyProblem
from pcm_jax.lie import unrolled

# Rows and columns of a tile of pairs: what a tile reads (two maps' G) then stays in a core's cache.
TILE = 64


def closed_form_kernel(problem: ConsistencyProblem) -> Float[Array, "m m"]:
    """q² of all ordered pairs; padding is computed like anything else."""
    placed, noise = _per_closure(problem)
    count = problem.valid.shape[0]
    blocks = -(-count // TILE)
    size = -(-count // blocks)

    def tile(corner: tuple[Any, Any]) -> tuple[Any, Any]:
        # Indices past the end repeat the last closure, and are cut below.
        u, v = (jnp.minimum(k * size + jnp.arange(size), count - 1) for k in corner)
        return _tile(problem, placed, noise, u, v)

    # One triangle of tiles. Their inputs are kept for the backward pass, not what is in between.
    rows, columns = np.triu_indices(blocks)
    forward, backward = jax.lax.map(jax.checkpoint(tile), (rows, columns))
    grid = jnp.zeros((blocks, blocks, size, size), forward.dtype)
    grid = grid.at[columns, rows].set(jnp.swapaxes(backward, 1, 2)).at[rows, columns].set(forward)
    squared = jnp.swapaxes(grid, 1, 2).reshape(blocks * size, blocks * size)[:count, :count]
    return jnp.where(jnp.eye(count, dtype=bool), 0.0, squared)


def _per_closure(problem: ConsistencyProblem) -> tuple[Any, Any]:
    """T_u as components `[p, m]`, and Z_u packed, `[d(d+1)/2, m]`."""
    module = lie.module_of(lie.group_of(problem.measurement))
    pose_a, pose_b = lie.components(problem.pose_a), lie.components(problem.pose_b)
    reached = module.compose(pose_a, lie.components(problem.measurement))
    placed = module.compose(reached, module.inverse(pose_b))
    covariance = unrolled.from_array(problem.measurement_covariance)
    noise = unrolled.pack(module.adjoint_sandwich(reached, covariance))
    return jnp.stack(placed), jnp.stack(noise)


def _tile(problem: ConsistencyProblem, placed: Any, noise: Any, u: Any, v: Any) -> tuple[Any, Any]:
    """q²_uv and q²_vu for closures `u` (rows) and `v` (columns)."""
    module = lie.module_of(lie.group_of(problem.measurement))
    relative_a = _gather(problem.relative_covariance_a, problem.row_a, u, v)
    relative_b = _gather(problem.relative_covariance_b, problem.row_b, u, v)
    t_u = tuple(component[u][:, None] for component in placed)
    t_v = tuple(component[v][None, :] for component in placed)
    both = unrolled.unpack([entry[u][:, None] + entry[v][None, :] for entry in noise])
    error = _error(module, t_u, t_v)
    shared = unrolled.pack(unrolled.add(relative_a, both))
    packed_b = unrolled.pack(relative_b)
    return tuple(_weighted_square(module, t, error, shared, packed_b) for t in (t_v, t_u))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _error(module: ModuleType, t_u: Any, t_v: Any) -> Any:
    """The vector r = Log(T_v T_u⁻¹)."""
    return module.log(module.compose(t_v, module.inverse(t_u)))


@_error.defjvp
def _error_jvp(module: ModuleType, primals: Any, velocities: Any) -> tuple[Any, Any]:
    """With T → exp(τ) T, dr = Jl(r)⁻¹ (τ_v − Ad(T_v T_u⁻¹) τ_u)."""
    t_u, t_v = primals
    tau_u, tau_v = map(module.left_tangent, primals, velocities)
    between = module.compose(t_v, module.inverse(t_u))
    error = module.log(between)
    carried = unrolled.apply(module.adjoint(between), tau_u)
    left_inverse = module.right_jacobian_inverse(tuple(-x for x in error))  # Jl(r) = Jr(−r)
    moved = tuple(v - u for u, v in zip(carried, tau_v, strict=True))
    return error, unrolled.apply(left_inverse, moved)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _weighted_square(module: ModuleType, t: Any, error: Any, shared: Any, other: Any) -> Any:
    """The number rᵀ M⁻¹ r with M = shared + Ad(T) other Ad(T)ᵀ, both packed."""
    return unrolled.inverse_quadratic_form(_total(module, t, shared, other), error)


@_weighted_square.defjvp
def _weighted_square_jvp(module: ModuleType, primals: Any, velocities: Any) -> tuple[Any, Any]:
    """d(rᵀ M⁻¹ r) = 2 wᵀ dr − wᵀ dM w with w = M⁻¹ r, and d Ad(T) = [τ, Ad(T) ·].

    By hand, because the factorisation's own derivative takes a minute to compile.
    """
    (t, error, shared, other), (velocity, error_dot, shared_dot, other_dot) = primals, velocities
    w = unrolled.solve_symmetric(_total(module, t, shared, other), error)
    adjoint = module.adjoint(t)
    w_other = unrolled.apply(unrolled.transpose(adjoint), w)
    carried = unrolled.apply(adjoint, unrolled.apply(unrolled.unpack(other), w_other))
    turned = module.bracket(module.left_tangent(t, velocity), carried)
    by_covariance = _form(shared_dot, w) + _form(other_dot, w_other)
    slope = 2.0 * (unrolled.dot(w, error_dot) - unrolled.dot(w, turned)) - by_covariance
    return _weighted_square(module, t, error, shared, other), slope


def _total(module: ModuleType, t: Any, shared: Any, other: Any) -> unrolled.Matrix:
    carried = module.adjoint_sandwich(t, unrolled.unpack(other))
    return unrolled.add(unrolled.unpack(shared), carried)


def _form(packed: Any, vector: Any) -> Any:
    """The number vᵀ S v."""
    return unrolled.dot(vector, unrolled.apply(unrolled.unpack(packed), vector))


def _gather(packed: Any, rows: Any, u: Any, v: Any) -> unrolled.Matrix:
    """G of all pairs of a tile. The rows are the problem's own, so no index is checked."""
    pairs = packed.at[:, rows[u][:, None], rows[v][None, :]].get(mode="promise_in_bounds")
    return unrolled.unpack(pairs)
