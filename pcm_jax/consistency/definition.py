"""The definition: the loop error of a pair of closures and its covariance (paper, eq. 4).

    ε_uv = Log( z_u⁻¹ · x_ij · z_v · x_lk ),   Σ_uv = J blkdiag(Σ_zu, Σ_ij, Σ_zv, Σ_lk) Jᵀ,
    q²_uv = ε_uvᵀ Σ_uv⁻¹ ε_uv

with closure u from pose i to pose k, closure v from j to l, x_ij the pose of j seen from i, x_lk
that of k seen from l. J is taken by automatic differentiation with respect to right perturbations,
at δ = 0. This is the specification that `closed_form` is tested against, and the path for a
residual of one's own (`squared_mahalanobis_of`).
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from pcm_jax import lie
from pcm_jax.consistency.limit import DIFFERENT, Limit
from pcm_jax.consistency.problem import ConsistencyProblem
from pcm_jax.consistency.within import WithinProblem
from pcm_jax.errors import InputError
from pcm_jax.lie import unrolled

# Pairs differentiated in one batch: 30 MB of intermediates in SE(3); larger is slower.
PAIRS_AT_ONCE = 1 << 12


def loop_error(z_u: Any, x_ij: Any, z_v: Any, x_lk: Any) -> Float[Array, " d"]:
    """ε = Log(z_u⁻¹ x_ij z_v x_lk): zero when the two closures agree (paper, eq. 4).

    Args:
        z_u: closure u, pose k of map b seen from pose i of map a.
        x_ij: pose j of map a seen from pose i.
        z_v: closure v, pose l of map b seen from pose j of map a.
        x_lk: pose k of map b seen from pose l.
    """
    return lie.log(lie.compose(lie.compose(lie.inverse(z_u), x_ij), lie.compose(z_v, x_lk)))


def squared_error(
    residual: Callable[..., Any],
    arguments: Sequence[Any],
    covariances: Sequence[Any],
    free: Float[Array, "n f"] | None = None,
) -> Any:
    """εᵀ Σ⁻¹ ε of ε = residual(*arguments), Σ propagated to first order.

    Args:
        residual: maps the arguments to a vector.
        arguments: pytrees with independent errors. Lie leaves are perturbed on the right, arrays
            by addition.
        covariances: `[n, n]` for each argument, over its leaves' perturbations in order.
        free: directions of all arguments' perturbations along which the covariance has no bound.

    Returns:
        The number; with `free` a `Limit`, of which see `consistency.limit`.
    """
    sizes = [covariance.shape[-1] for covariance in covariances]
    splits = list(itertools.accumulate(sizes))[:-1]

    def perturbed(delta: Any) -> tuple[Any, ...]:
        # One output per entry: stacked, XLA would fuse them into one loop that recomputes the
        # whole chain for every entry, 200 times slower.
        return tuple(residual(*map(_retract, arguments, jnp.split(delta, splits))))

    error = residual(*arguments)
    given = jax.scipy.linalg.block_diag(*covariances)
    jacobian = jax.jacfwd(perturbed)(jnp.zeros(sum(sizes), error.dtype))
    carried = jnp.stack([given @ row for row in jacobian])
    covariance = jnp.stack([carried @ row for row in jacobian])
    if free is not None:
        return _limit(error, covariance, jnp.stack([row @ free for row in jacobian]))
    factor = jax.scipy.linalg.cho_factor(covariance, lower=True)
    return error @ jax.scipy.linalg.cho_solve(factor, error)


def _limit(error: Any, covariance: Any, free: Any) -> Limit:
    """The limit of q² by the singular values of the whitened free directions."""
    lower = jnp.linalg.cholesky(covariance)
    white = jax.scipy.linalg.solve_triangular(lower, jnp.column_stack([error, free]), lower=True)
    length = jnp.linalg.norm(white[:, 1:], axis=0)
    units = white[:, 1:] / jnp.where(length > 0.0, length, 1.0)
    basis, values, _ = jnp.linalg.svd(units, full_matrices=False)
    new = values > DIFFERENT
    along = jnp.where(new, basis.T @ white[:, 0], 0.0)
    freedom = jnp.asarray(len(error) - new.sum(), error.dtype)
    return Limit(white[:, 0] @ white[:, 0] - along @ along, freedom)


def _is_lie(node: Any) -> bool:
    return isinstance(node, jaxlie.MatrixLieGroup)


def _retract(tree: Any, delta: Float[Array, " n"]) -> Any:
    """Every leaf of `tree` moved by its part of `delta`."""
    leaves, structure = jax.tree.flatten(tree, is_leaf=_is_lie)
    moved, start = [], 0
    for leaf in leaves:
        size = lie.tangent_dim(leaf) if _is_lie(leaf) else leaf.size
        part = delta[start : start + size]
        start += size
        if _is_lie(leaf):
            moved.append(lie.compose(leaf, lie.exp(lie.group_of(leaf), part)))
        else:
            moved.append(leaf + part.reshape(leaf.shape))
    return jax.tree.unflatten(structure, moved)


def all_pairs(pair: Callable[[Any, Any], Any], count: int) -> Any:
    """`pair(u, v)` for all indices below `count`, vmapped, a batch at a time; diagonal zero.

    A pytree of `[m, m]`, as `pair` returns one of numbers.
    """
    if count == 0:
        return jnp.zeros((0, 0))
    pairs = count * count
    batches = -(-pairs // PAIRS_AT_ONCE)
    # Pairs past the end repeat the last one, and are cut below: one shape to compile.
    pair_index = jnp.minimum(jnp.arange(batches * -(-pairs // batches)), pairs - 1)
    batch = jax.vmap(lambda index: pair(index // count, index % count))
    values = jax.lax.map(batch, pair_index.reshape(batches, -1))

    def square(of_pairs: Any) -> Any:
        table = of_pairs.reshape(-1)[:pairs].reshape(count, count)
        return jnp.where(jnp.eye(count, dtype=bool), 0.0, table)

    return jax.tree.map(square, values)


def jacfwd_kernel(problem: ConsistencyProblem | WithinProblem) -> Any:
    """q² of all ordered pairs by the definition; padding is computed like anything else.

    A `Limit` of `[m, m]` where closures leave directions unsaid.
    """
    pair = _pair_within if isinstance(problem, WithinProblem) else _pair_between
    return all_pairs(functools.partial(pair, problem), problem.valid.shape[0])


def _pair_between(problem: ConsistencyProblem, u: Any, v: Any) -> Any:
    """q²_uv of closures between two maps: two relative poses with independent errors."""

    def relative_covariance(packed: Any, rows: Any, first: Any, last: Any, frame: Any) -> Any:
        """Covariance of the right perturbation of a relative pose that ends at `frame`.

        With X_i → exp(ξ_i) X_i it is x_ij → x_ij exp(Ad(X_j⁻¹)(ξ_j − ξ_i)).
        """
        adjoint = lie.adjoint(lie.inverse(frame))
        return adjoint @ _unpacked(packed[:, rows[first], rows[last]]) @ adjoint.T

    (z_u, x_i, y_k), (z_v, x_j, y_l) = _closure(problem, u), _closure(problem, v)
    covariances = (
        problem.measurement_covariance[u],
        relative_covariance(problem.relative_covariance_a, problem.row_a, u, v, x_j),
        problem.measurement_covariance[v],
        relative_covariance(problem.relative_covariance_b, problem.row_b, v, u, y_k),
    )
    arguments = (z_u, lie.between(x_i, x_j), z_v, lie.between(y_l, y_k))
    if problem.free is None:
        return squared_error(loop_error, arguments, covariances)
    none = jnp.zeros_like(problem.free[u])
    rows = [[problem.free[u], none], [none, none], [none, problem.free[v]], [none, none]]
    return squared_error(loop_error, arguments, covariances, jnp.block(rows))


def _pair_within(problem: WithinProblem, u: Any, v: Any) -> Any:
    """q²_uv of closures within one map: four poses with one joint covariance."""

    def error(z_u: Any, ends: Any, z_v: Any) -> Any:
        x_i, x_j, x_k, x_l = ends
        return loop_error(z_u, lie.between(x_i, x_j), z_v, lie.between(x_l, x_k))

    (z_u, x_i, x_k), (z_v, x_j, x_l) = _closure(problem, u), _closure(problem, v)
    ends = x_i, x_j, x_k, x_l
    rows = [row[closure] for row in (problem.row_a, problem.row_b) for closure in (u, v)]
    back = [lie.adjoint(lie.inverse(end)) for end in ends]
    joint = [  # of right perturbations; Cov(x_p, x_q) = S_min(p, q) is that of left ones
        [
            back[p] @ _unpacked(problem.cumulated_covariance[:, jnp.minimum(*pair)]) @ back[q].T
            for q, pair in enumerate((row, other) for other in rows)
        ]
        for p, row in enumerate(rows)
    ]
    noise = problem.measurement_covariance
    return squared_error(error, (z_u, ends, z_v), (noise[u], jnp.block(joint), noise[v]))


def _closure(problem: Any, index: Any) -> tuple[Any, Any, Any]:
    """The measurement of a closure, and the poses it starts and ends at."""
    transforms = problem.measurement, problem.pose_a, problem.pose_b
    return tuple(lie.take(transform, index) for transform in transforms)


def _unpacked(packed: Any) -> Any:
    """The symmetric matrix `[d, d]` of packed entries."""
    return jnp.stack([jnp.stack(row) for row in unrolled.unpack(packed)])


def squared_mahalanobis_of(
    residual: Callable[[Any, Any], Float[Array, " r"]],
    measurements: Any,
    covariances: Float[Array, "m n n"],
) -> Float[Array, "m m"]:
    """Computes squared Mahalanobis distances of any residual of two measurements.

    `[u, v]` is εᵀ Σ⁻¹ ε of ε = residual(z_u, z_v), with Σ = J_u Σ_u J_uᵀ + J_v Σ_v J_vᵀ by
    automatic differentiation; the diagonal is zero. For measurements x_u of one number on the line:

        squared_mahalanobis_of(lambda u, v: lie.log(lie.between(u, v)), lie.R1(x), variance)

    Args:
        residual: of two measurements, each one element of `measurements`, to a vector.
        measurements: pytree whose leaves have a leading axis m. Lie leaves have errors on the
            right, z exp(δ), arrays additive ones.
        covariances: of the errors of each measurement, over its leaves in order, n in all.

    Returns:
        Not symmetrised, in the dtype of the inputs; safe under jit, vmap and grad.

    Raises:
        InputError: when the measurements and covariances do not fit together.
    """
    _check_sizes(measurements, covariances)
    with lie.own_precision((measurements, covariances)):
        return _all_pairs_of(_SameCode(residual), measurements, covariances)


class _SameCode:
    """A function that equals every other of the same code that closes over the same objects.

    A lambda written in a loop is a new object each time, and as jit's static argument would be
    compiled each time. What a function closes over counts by value where it can be hashed.
    """

    def __init__(self, function: Callable[..., Any]):
        self._function = function
        code = getattr(function, "__code__", None)
        if code is None:  # a callable object: itself alone
            self._key: Any = (function,)
            return
        cells = (cell.cell_contents for cell in function.__closure__ or ())
        given = (*cells, *(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).items())
        self._kept = given  # so that no other object takes an id among the key's
        parts = tuple(x if _is_plain(x) else id(x) for x in given)
        self._key = (code, id(function.__globals__), parts)

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _SameCode) and self._key == other._key


def _is_plain(value: Any) -> bool:
    """True for what equals another by value and cannot change."""
    return isinstance(value, int | float | str | bytes | bool | type | None)


def _check_sizes(measurements: Any, covariances: Any) -> None:
    leaves = jax.tree.leaves(measurements, is_leaf=_is_lie)
    shapes = [
        jnp.shape(leaf) if not _is_lie(leaf) else lie.parameters(leaf).shape[:-1] for leaf in leaves
    ]
    own = [lie.tangent_dim(leaf) if _is_lie(leaf) else 1 for leaf in leaves]
    if not shapes or any(len(shape) == 0 or shape[0] != shapes[0][0] for shape in shapes):
        raise InputError(
            f"measurements: shapes {shapes}; expected one leading axis m in all leaves"
        )
    n = sum(size * math.prod(shape[1:]) for size, shape in zip(own, shapes, strict=True))
    if jnp.shape(covariances) != (shapes[0][0], n, n):
        raise InputError(
            f"covariances: shape {jnp.shape(covariances)}; expected {(shapes[0][0], n, n)}"
        )


@functools.partial(jax.jit, static_argnums=0)
def _all_pairs_of(residual: Any, measurements: Any, covariances: Any) -> Any:
    def pair(u: Any, v: Any) -> Any:
        both = [jax.tree.map(lambda leaf, k=k: leaf[k], measurements) for k in (u, v)]
        return squared_error(residual, both, (covariances[u], covariances[v]))

    return all_pairs(pair, covariances.shape[0])
