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

Within one map (`within`) ξ and η are errors of one odometry, so the two sides of the loop share
the steps that lie between i and j and between k and l as well. Steps are independent of each other:
with O the covariance that the shared ones add up to, A and B that of what is left of either side,
and s = ±1 whether both sides walk the shared steps in the same direction,

    M_uv  = A + Ad(T_v) B Ad(T_v)ᵀ + (I + s Ad(T_v)) O (I + s Ad(T_v))ᵀ + Z_u + Z_v

which for closures that start at their earlier pose leaves next to nothing of O (s = −1, T_v ≈ I),
however long the shared way: nothing large is subtracted from anything large. One closure with
odometry alone, ε = Log(z_u⁻¹ x_ik), has by the same derivation

    q²_u  = r_uᵀ (S_k − S_i + Z_u)⁻¹ r_u,      r_u = Log(T_u⁻¹)
"""

from __future__ import annotations

import functools
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import namespace
from pcm_jax.consistency.limit import Limit, carried, columns_of, limit
from pcm_jax.consistency.problem import ConsistencyProblem
from pcm_jax.consistency.within import WithinProblem
from pcm_jax.lie import unrolled

# Rows and columns of a tile of pairs: what a tile reads (two maps' G) then stays in a core's cache.
TILE = 64
PAIRS_AT_ONCE = 4096
"""Pairs that NumPy weighs together: what they take stays in a core's cache."""


def closed_form_kernel(problem: ConsistencyProblem | WithinProblem) -> Any:
    """q² of all ordered pairs; padding is computed like anything else.

    A `Limit` of `[m, m]` where closures leave directions unsaid.
    """
    placed, noise = per_closure(problem)
    count = problem.valid.shape[0]
    blocks, size = _blocks(count)

    def tile(corner: tuple[Any, Any]) -> tuple[Any, Any]:
        # Indices past the end repeat the last closure, and are cut below.
        u, v = (jnp.minimum(k * size + jnp.arange(size), count - 1) for k in corner)
        return _tile(problem, placed, noise, u, v)

    # One triangle of tiles. Their inputs are kept for the backward pass, not what is in between.
    rows, columns = np.triu_indices(blocks)
    forward, backward = jax.lax.map(jax.checkpoint(tile), (rows, columns))

    def square(forward: Any, backward: Any) -> Any:
        grid = jnp.zeros((blocks, blocks, size, size), forward.dtype)
        grid = grid.at[columns, rows].set(jnp.swapaxes(backward, 1, 2))
        grid = grid.at[rows, columns].set(forward)
        table = jnp.swapaxes(grid, 1, 2).reshape(blocks * size, blocks * size)[:count, :count]
        return jnp.where(jnp.eye(count, dtype=bool), 0.0, table)

    return jax.tree.map(square, forward, backward)


def closed_form_rows(
    problem: ConsistencyProblem | WithinProblem, rows: Int[Array, " r"]
) -> Float[Array, "r m"]:
    """q²_uv of the closures u in `rows` with all v: the share of one of several devices.

    Both triangles are computed, since what one device finds is not sent to another.
    """
    placed, noise = per_closure(problem)
    count = problem.valid.shape[0]
    (down, height), (across, width) = (_blocks(size) for size in (len(rows), count))

    def tile(corner: tuple[Any, Any]) -> Any:
        u = jnp.minimum(corner[0] * height + jnp.arange(height), len(rows) - 1)
        v = jnp.minimum(corner[1] * width + jnp.arange(width), count - 1)
        return _tile(problem, placed, noise, rows[u], v)[0]

    corners = (np.repeat(np.arange(down), across), np.tile(np.arange(across), down))
    grid = jax.lax.map(jax.checkpoint(tile), corners).reshape(down, across, height, width)
    return jnp.swapaxes(grid, 1, 2).reshape(down * height, across * width)[: len(rows), :count]


def closed_form_new(
    problem: ConsistencyProblem | WithinProblem, rows: Int[Array, " r"]
) -> tuple[Float[Array, "r m"], Float[Array, "r m"]]:
    """q²_uv and q²_vu of the closures u in `rows` with all v: the rows and columns they add."""
    placed, noise = per_closure(problem)
    return _tile(problem, placed, noise, rows, jnp.arange(problem.valid.shape[0]))


def _blocks(count: int) -> tuple[int, int]:
    """The number of tiles in a row, and their width: at most `TILE`, and as even as can be."""
    blocks = -(-count // TILE)
    return blocks, -(-count // blocks)


def own_loop_kernel(problem: WithinProblem) -> Float[Array, " m"]:
    """q² of the loop that each closure makes with odometry alone."""
    placed, noise = per_closure(problem)
    module = lie.module_of(lie.group_of(problem.measurement))
    error = module.log(module.inverse(tuple(placed)))
    cumulated = problem.cumulated_covariance
    total = cumulated[:, problem.row_b] - cumulated[:, problem.row_a] + noise
    return unrolled.inverse_quadratic_form(unrolled.unpack(total), error)


def per_closure(closures: Any) -> tuple[Any, Any]:
    """T_u as components `[p, m]`, and Z_u packed, `[d(d+1)/2, m]`.

    Args:
        closures: a problem, or anything else with its `measurement`, `measurement_covariance`,
            `pose_a` and `pose_b`.
    """
    module = lie.module_of(lie.group_of(closures.measurement))
    pose_a, pose_b = lie.components(closures.pose_a), lie.components(closures.pose_b)
    reached = module.compose(pose_a, lie.components(closures.measurement))
    placed = module.compose(reached, module.inverse(pose_b))
    covariance = unrolled.from_array(closures.measurement_covariance)
    noise = unrolled.pack(module.adjoint_sandwich(reached, covariance))
    xp = namespace(*placed)
    return xp.stack(placed), xp.stack(noise)


def limits_in_numpy(problem: ConsistencyProblem) -> Limit:
    """q² of all ordered pairs on NumPy arrays, which compiles nothing.

    Args:
        problem: NumPy arrays of valid closures alone.

    Returns:
        With degrees of freedom where closures leave directions unsaid, else None for them.
    """
    (placed, noise), free = per_closure(problem), carried(problem)
    module, count = lie.module_of(lie.group_of(problem.measurement)), placed.shape[1]
    tables = [np.zeros((count, count)) for _ in range(1 if free is None else 2)]
    first, second = np.triu_indices(count, 1)
    for start in range(0, len(first), PAIRS_AT_ONCE):
        u, v = first[start : start + PAIRS_AT_ONCE], second[start : start + PAIRS_AT_ONCE]
        side_a, side_b = _two_maps_in_numpy(problem, u, v)
        fixed = tuple(side_a + noise[:, u] + noise[:, v])
        t_u, t_v = tuple(placed[:, u]), tuple(placed[:, v])
        columns = None
        if free is not None:
            columns = columns_of(free, lambda n, u=u: n[:, :, u], lambda n, v=v: n[:, :, v])
        for at, pairs in ((t_v, (u, v)), (t_u, (v, u))):
            with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
                found = squared_one_way(module, t_u, t_v, at, fixed, side_b, columns)
            for table, values in zip(tables, [found] if free is None else found, strict=True):
                table[pairs] = values
    return Limit(tables[0], None if free is None else tables[1])


def _two_maps_in_numpy(problem: ConsistencyProblem, u: Any, v: Any) -> tuple[Any, Any]:
    """Ga_ij and Gb_kl, packed, of pairs of closures."""
    side_a = problem.relative_covariance_a[:, problem.row_a[u], problem.row_a[v]]
    return side_a, problem.relative_covariance_b[:, problem.row_b[u], problem.row_b[v]]


def _tile(
    problem: ConsistencyProblem | WithinProblem, placed: Any, noise: Any, u: Any, v: Any
) -> tuple[Any, Any]:
    """q²_uv and q²_vu for closures `u` (rows) and `v` (columns) of a problem."""
    if isinstance(problem, WithinProblem):
        sides = _one_map(problem, u, v)
    else:
        sides = (*_two_maps(problem, u, v), None)
    module = lie.module_of(lie.group_of(problem.measurement))
    return weigh(module, placed, noise, (u, v), sides, carried(problem))


def weigh(
    module: ModuleType,
    placed: Any,
    noise: Any,
    tile: tuple[Any, Any],
    sides: tuple[Any, Any, Any],
    free: Float[Array, "f d m"] | None = None,
) -> tuple[Any, Any]:
    """q²_uv and q²_vu of a tile; with `free` a `Limit` of each.

    Args:
        module: of the group.
        placed, noise: of `per_closure`.
        tile: int `[r]` and `[c]`, the closures u (rows) and v (columns).
        sides: Ga_ij and Gb_kl, packed, each a leading axis or a tuple of `[r, c]`, and None;
            within one map A, B and (s, O).
        free: of `carried`.
    """
    u, v = tile
    side_a, side_b, both_sides = sides
    t_u = tuple(component[u][:, None] for component in placed)
    t_v = tuple(component[v][None, :] for component in placed)
    error = _error(module, t_u, t_v)
    fixed = tuple(a + (z[u][:, None] + z[v][None, :]) for a, z in zip(side_a, noise, strict=True))
    if free is not None:
        columns = columns_of(free, lambda n: n[:, :, u, None], lambda n: n[:, :, None, v])
        first, second = (_total(module, t, fixed, side_b, both_sides) for t in (t_v, t_u))
        return limit(first, error, columns), limit(second, error, columns)
    return tuple(_weighted_square(module, t, error, fixed, side_b, both_sides) for t in (t_v, t_u))


def squared_one_way(
    module: ModuleType,
    t_u: Any,
    t_v: Any,
    at: Any,
    fixed: Any,
    side_b: Any,
    free: Any = None,
    both_sides: Any = None,
) -> Any:
    """One direction's q² of pairs, on NumPy arrays as on JAX's.

    Args:
        module: of the group.
        t_u: entries of T_u, one a pair.
        t_v: of T_v.
        at: the one of them whose adjoint turns map b's share: T_v for q²_uv, T_u for q²_vu.
        fixed: Ga_ij + Z_u + Z_v, packed.
        side_b: Gb_kl, packed.
        free: columns of N, see `columns_of`; with them a `Limit` is returned.
        both_sides: within one map (s, O packed), see `sides_of_one_map`.
    """
    error = module.log(module.compose(t_v, module.inverse(t_u)))
    total = _total(module, at, fixed, side_b, both_sides)
    if free is not None:
        return limit(total, error, free)
    return unrolled.inverse_quadratic_form(total, error)


def _two_maps(problem: ConsistencyProblem, u: Any, v: Any) -> tuple[Any, Any]:
    """Ga_ij and Gb_kl, packed, of all pairs of a tile."""
    side_a = gather(problem.relative_covariance_a, problem.row_a[u], problem.row_a[v])
    return side_a, gather(problem.relative_covariance_b, problem.row_b[u], problem.row_b[v])


def gather(packed: Any, rows: Any, columns: Any) -> Any:
    """G of all pairs of a tile; the rows and columns are the caller's own, so none is checked."""
    return packed.at[:, rows[:, None], columns[None, :]].get(mode="promise_in_bounds")


def _one_map(problem: WithinProblem, u: Any, v: Any) -> tuple[Any, Any, Any]:
    """A and B, packed, and (s, O packed), of all pairs of a tile."""

    def instant(rows: Any, axis: int) -> Any:
        cumulated = problem.cumulated_covariance[:, rows]
        return jnp.expand_dims(rows, axis), tuple(jnp.expand_dims(c, axis) for c in cumulated)

    i, j = instant(problem.row_a[u], 1), instant(problem.row_a[v], 0)
    k, l = instant(problem.row_b[u], 1), instant(problem.row_b[v], 0)  # noqa: E741
    return sides_of_one_map(i, j, k, l)


def sides_of_one_map(i: Any, j: Any, k: Any, l: Any) -> tuple[Any, Any, Any]:  # noqa: E741
    """A and B, packed, and (s, O packed), of pairs of closures inside one map.

    Args:
        i: the instants at which closures u start, each its place in the order of time and S,
            packed; likewise
        j: those at which closures v start,
        k: those at which closures u end,
        l: those at which closures v end.
    """
    (first_a, last_a), (first_b, last_b) = _in_order(i, j), _in_order(l, k)
    start, end = _in_order(first_a, first_b)[1], _in_order(last_a, last_b)[0]
    end = _in_order(start, end)[1]  # of intervals that do not meet nothing is shared

    def without(first: Any, last: Any) -> Any:
        ends = zip(first[1], last[1], start[1], end[1], strict=True)
        return tuple((x_last - x_end) + (x_start - x) for x, x_last, x_start, x_end in ends)

    shared = tuple(x_end - x_start for x_start, x_end in zip(start[1], end[1], strict=True))
    together = (i[0] < j[0]) == (l[0] < k[0])
    xp = namespace(shared[0])
    sign = xp.where(together, xp.ones((), shared[0].dtype), -1.0)
    return without(first_a, last_a), without(first_b, last_b), (sign, shared)


def _in_order(one: Any, other: Any) -> tuple[Any, Any]:
    """The earlier and the later of two instants, each its row and S, packed."""
    swapped, xp = one[0] > other[0], namespace(one[0], other[0])
    earlier = jax.tree.map(lambda x, y: xp.where(swapped, y, x), one, other)
    later = jax.tree.map(lambda x, y: xp.where(swapped, x, y), one, other)
    return earlier, later


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
def _weighted_square(
    module: ModuleType, t: Any, error: Any, fixed: Any, side_b: Any, both_sides: Any
) -> Any:
    """The number rᵀ M⁻¹ r, M of `_total`."""
    return unrolled.inverse_quadratic_form(_total(module, t, fixed, side_b, both_sides), error)


@_weighted_square.defjvp
def _weighted_square_jvp(module: ModuleType, primals: Any, velocities: Any) -> tuple[Any, Any]:
    """d(rᵀ M⁻¹ r) = 2 wᵀ dr − wᵀ dM w with w = M⁻¹ r, and d Ad(T) = [τ, Ad(T) ·].

    By hand, because the factorisation's own derivative takes a minute to compile.
    """
    t, error, fixed, side_b, both_sides = primals
    velocity, error_dot, fixed_dot, side_b_dot, both_sides_dot = velocities
    square = _weighted_square(module, *primals)
    w = unrolled.solve_symmetric(_total(module, t, fixed, side_b, both_sides), error)
    # Where M is not positive definite the value is NaN, and nothing flows.
    w = tuple(jnp.where(jnp.isfinite(square), x, 0.0) for x in w)
    adjoint = module.adjoint(t)
    back = unrolled.apply(unrolled.transpose(adjoint), w)
    moved = unrolled.apply(unrolled.unpack(side_b), back)
    by_covariance = _form(fixed_dot, w) + _form(side_b_dot, back)
    if both_sides is not None:
        sign, shared = both_sides
        lever = tuple(x + sign * y for x, y in zip(w, back, strict=True))
        also = unrolled.apply(unrolled.unpack(shared), lever)
        moved = tuple(x + sign * y for x, y in zip(moved, also, strict=True))
        by_covariance += _form(both_sides_dot[1], lever)
    carried = unrolled.apply(adjoint, moved)
    turned = module.bracket(module.left_tangent(t, velocity), carried)
    slope = 2.0 * (unrolled.dot(w, error_dot) - unrolled.dot(w, turned)) - by_covariance
    return square, slope


def _total(module: ModuleType, t: Any, fixed: Any, side_b: Any, both_sides: Any) -> unrolled.Matrix:
    """M = fixed + Ad(T) B Ad(T)ᵀ + (I + s Ad(T)) O (I + s Ad(T))ᵀ, the last within one map."""
    total = unrolled.add(
        unrolled.unpack(fixed), module.adjoint_sandwich(t, unrolled.unpack(side_b))
    )
    if both_sides is None:
        return total
    sign, shared = both_sides
    signed = tuple(tuple(unrolled.product(sign, x) for x in row) for row in module.adjoint(t))
    lever = unrolled.add(unrolled.identity(len(signed)), signed)
    return unrolled.add(total, unrolled.sandwich(lever, unrolled.unpack(shared)))


def _form(packed: Any, vector: Any) -> Any:
    """The number vᵀ S v."""
    return unrolled.dot(vector, unrolled.apply(unrolled.unpack(packed), vector))
