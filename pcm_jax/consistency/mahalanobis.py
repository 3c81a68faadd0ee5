"""The pure kernel's entry: squared Mahalanobis distances of all pairs of closures."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import bucket, device_array, on_host
from pcm_jax.compiling import is_worth_compiling
from pcm_jax.consistency._closed_form import (
    closed_form_kernel,
    closed_form_new,
    closed_form_rows,
    limits_in_numpy,
    own_loop_kernel,
)
from pcm_jax.consistency.definition import jacfwd_kernel
from pcm_jax.consistency.limit import Limit
from pcm_jax.consistency.problem import ConsistencyProblem
from pcm_jax.consistency.within import WithinProblem
from pcm_jax.errors import InputError, check_class

Problem = ConsistencyProblem | WithinProblem
SECONDS_A_PAIR = {3: 1e-6, 6: 4e-6}
"""About what an ordered pair takes in NumPy, by tangent dimensions."""


def _masked(kernel: Callable[[Any], Any]) -> Callable[[Problem], Any]:
    """`kernel`, compiled, and its result marked."""

    @jax.jit
    def masked(problem: Problem) -> Any:
        harmless, known = _harmless(problem)
        found = kernel(harmless)
        squared, freedom = (found, None) if _says_all(problem) else found
        marked = _marked(squared, known, problem.valid, jnp.arange(len(known)))
        if freedom is None:
            return marked
        d = problem.measurement_covariance.shape[-1]
        whole = jnp.where(jnp.eye(len(known), dtype=bool), d, freedom)
        return Limit(marked, jnp.round(whole).astype(np.int32))

    return masked


def _says_all(problem: Problem) -> bool:
    return getattr(problem, "free", None) is None


@functools.partial(jax.jit, static_argnames="mesh")
def _by_rows(problem: Problem, mesh: Mesh) -> Float[Array, "n n"]:
    """As the closed form's, each device of a mesh computing rows of its own."""
    harmless, known = _harmless(_padded(problem, -len(problem.valid) % mesh.size))
    share = len(known) // mesh.size

    def rows_of_one(problem: Problem, known: Any) -> Any:
        rows = jax.lax.axis_index(mesh.axis_names) * share + jnp.arange(share)
        return _marked(closed_form_rows(problem, rows), known, problem.valid, rows)

    in_order = PartitionSpec(mesh.axis_names)
    shared = jax.shard_map(rows_of_one, mesh=mesh, in_specs=PartitionSpec(), out_specs=in_order)
    return shared(harmless, known)


def _harmless(problem: Any, xp: Any = jnp) -> tuple[Any, Any]:
    """The problem with closures that are not finite replaced, and which are finite.

    Replaced before, not only marked after: in the derivatives of the other closures what is not
    finite would meet a zero, and NaN times zero is NaN.
    """
    own = {name: getattr(problem, name) for name in _OF_CLOSURES}
    known = xp.all(xp.stack([_finite_rows(leaf, xp) for leaf in jax.tree.leaves(own)]), axis=0)
    d = problem.measurement_covariance.shape[-1]
    harmless = {name: lie.identity(lie.group_of(own[name])) for name in _OF_CLOSURES[1:]}
    harmless["measurement_covariance"] = np.eye(d)
    if not _says_all(problem):
        own["free"], harmless["free"] = problem.free, np.zeros(problem.free.shape[1:])  # type: ignore[union-attr]
        known = known & _finite_rows(own["free"], xp)
    return dataclasses.replace(problem, **_where(known, own, harmless, xp)), known


def _marked(squared: Any, known: Any, valid: Any, rows: Any) -> Float[Array, "r m"]:
    """Rows of q²: infinite between padding and all else, NaN where input is not finite."""
    squared = jnp.where(known[rows, None] & known, squared, jnp.nan)
    squared = jnp.where(valid[rows, None] & valid, squared, jnp.inf)
    return jnp.where(rows[:, None] == jnp.arange(len(valid)), 0.0, squared)


def _padded(problem: Problem, more: int) -> Problem:
    """The problem with `more` closures of padding."""
    if more == 0:
        return problem

    def longer(leaf: Array) -> Array:
        return jnp.concatenate([leaf, jnp.repeat(leaf[-1:], more, axis=0)])

    names = (*_OF_CLOSURES, "row_a", "row_b")
    changes = {name: jax.tree.map(longer, getattr(problem, name)) for name in names}
    valid = jnp.concatenate([problem.valid, jnp.zeros(more, bool)])
    return dataclasses.replace(problem, valid=valid, **changes)


_OF_CLOSURES = ("measurement_covariance", "measurement", "pose_a", "pose_b")


def _finite_rows(leaf: Float[Array, "m ..."], xp: Any) -> Bool[Array, " m"]:
    return xp.all(xp.isfinite(leaf), axis=tuple(range(1, leaf.ndim)))


def _where(known: Bool[Array, " m"], tree: Any, otherwise: Any, xp: Any) -> Any:
    """The rows of `tree` that are known, and one row for all others."""

    def choose(leaf: Any, row: Any) -> Any:
        return xp.where(known.reshape(-1, *(1,) * (leaf.ndim - 1)), leaf, row.astype(leaf.dtype))

    return jax.tree.map(choose, tree, otherwise)


_KERNELS = {"closed-form": _masked(closed_form_kernel), "jacfwd": _masked(jacfwd_kernel)}
_own_loop = jax.jit(own_loop_kernel)


def squared_mahalanobis(
    problem: ConsistencyProblem | WithinProblem,
    *,
    kernel: str = "closed-form",
    mesh: Mesh | None = None,
) -> Float[Array, "m m"]:
    """Computes the squared Mahalanobis distance of every ordered pair's loop (paper, eq. 4).

        squared = pcm_jax.squared_mahalanobis(problem)
        consistent = pcm_jax.consistency_graph(squared, pcm_jax.chi2_gate(0.99, dof=3))

    `[u, v]` is q²_uv, not symmetrised; the diagonal is zero. For closures that are both right it
    follows a chi-squared distribution with d degrees of freedom: see `chi2_gate`. Where closures
    leave directions unsaid (`problem.free`) it has fewer, as many as `freedom_of` tells of each
    pair: there it is the limit of covariances that grow without bound.

    Safe under jit, vmap, grad and jvp. The result follows the dtype of the problem, which
    `consistency_problem` and `within_problem` build in float64.

    Nothing is raised for numbers that were changed after that. A closure with a number that is not
    finite has NaN in its row and column, a pair whose covariance is not positive definite has NaN
    itself: they pass no gate (`consistency_graph`), change nothing else and have no derivative.

    Args:
        problem: of closures between two robots, see `consistency_problem`, or within one robot's
            map, see `within_problem`.
        kernel: "closed-form", or "jacfwd": the definition, by automatic differentiation.
        mesh: devices that share the work, of one process or of several that all make this call
            with the same problem. Each holds the whole problem and computes rows of its own;
            nothing else passes between them. The closed form only.

    Returns:
        Of the valid closures alone. Where `problem.valid` is traced (inside jit or vmap) its
        padding cannot be cut, and padded rows and columns are infinite off the diagonal: no gate
        lets them pass. Nor is it cut with a mesh: rows are shared out evenly over its devices, in
        order, and m is padded to a multiple of their number.

    Raises:
        InputError: for another kernel, or a mesh with the definition or with closures that leave
            directions unsaid.
    """
    check_class("problem", problem, "a problem of closures", ConsistencyProblem, WithinProblem)
    if not isinstance(kernel, str) or kernel not in _KERNELS:
        raise InputError(f"kernel: {kernel!r}; expected one of {', '.join(map(repr, _KERNELS))}")
    if mesh is None:
        return limits_of(problem, kernel=kernel).squared
    if kernel != "closed-form":
        raise InputError(f"mesh: given with kernel {kernel!r}; expected kernel 'closed-form'")
    if not _says_all(problem):
        raise InputError("mesh: given with closures that leave directions unsaid; expected none")
    with lie.own_precision(problem):
        return _by_rows(_on_all(problem, mesh), mesh)


def freedom_of(problem: ConsistencyProblem | WithinProblem) -> Int[Array, "m m"]:
    """Computes the degrees of freedom of every ordered pair's q²: d, or fewer.

    A closure with information of rank r < d leaves d − r directions unsaid, and two closures have
    in common what neither of them does: for planar closures between maps in space 3 of 6. Pairs of
    no degree have nothing to compare.

        within = squared <= pcm_jax.chi2_gate(0.99, dof=freedom_of(problem))    # for degrees > 0

    Args:
        problem: as for `squared_mahalanobis`.

    Returns:
        int32, of the valid closures as `squared_mahalanobis`; d on the diagonal.
    """
    squared, freedom = limits_of(problem)
    if freedom is not None:
        return freedom
    with lie.own_precision(problem):
        return jnp.full(squared.shape, problem.measurement_covariance.shape[-1], np.int32)


def limits_of(problem: Problem, *, kernel: str = "closed-form") -> Limit:
    """Computes `squared_mahalanobis` and `freedom_of` at once; None for degrees that are all d."""
    with lie.own_precision(problem):
        if _says_all(problem):
            return Limit(_cut(_KERNELS[kernel](problem), problem.valid), None)
        traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(problem))
        if traced or kernel != "closed-form":
            return Limit(*(_cut(each, problem.valid) for each in _KERNELS[kernel](problem)))
        found = _in_numpy(problem)  # compiling takes twenty seconds
        return Limit(device_array(found.squared), device_array(found.freedom, np.int32))


def _in_numpy(problem: Any) -> Limit:
    """The closed form on NumPy, of the valid closures; marked as the compiled one is."""
    problem = jax.tree.map(np.asarray, problem)
    valid = np.flatnonzero(problem.valid)
    names = (*_OF_CLOSURES, "free", "row_a", "row_b", "valid")
    own = {name: jax.tree.map(lambda x: x[valid], getattr(problem, name)) for name in names}
    harmless, known = _harmless(dataclasses.replace(problem, **own), np)
    squared, freedom = limits_in_numpy(harmless)
    squared[~(known[:, None] & known)] = np.nan
    np.fill_diagonal(squared, 0.0)
    if freedom is not None:
        np.fill_diagonal(freedom, problem.measurement_covariance.shape[-1])
    return Limit(squared, freedom)


def _cut(table: Any, valid: Any) -> Any:
    """The rows and columns of valid closures; all of them where these are traced."""
    if isinstance(valid, Tracer):
        return table
    valid = np.flatnonzero(np.asarray(valid))
    if isinstance(table, Tracer):
        return table[valid[:, None], valid]
    # Cut by NumPy: an eager JAX gather would be compiled for every number of closures.
    return device_array(np.asarray(table)[np.ix_(valid, valid)], table.dtype)


@on_host
def weighed_on_host(problem: ConsistencyProblem) -> Limit:
    """Computes `squared_mahalanobis` and `freedom_of` for the host: in NumPy where that is cheap.

    Args:
        problem: of closures between two robots, float64, not traced.

    Returns:
        NumPy; None for degrees that are all d.
    """
    d, padded = problem.measurement_covariance.shape[-1], problem.valid.shape[0]
    if _says_all(problem) and not is_worth_compiling(padded**2 * SECONDS_A_PAIR[d]):
        return _in_numpy(problem)
    squared, freedom = limits_of(problem)
    return Limit(np.asarray(squared), None if freedom is None else np.asarray(freedom))


def squared_rows(
    problem: Problem, rows: Int[np.ndarray, " r"]
) -> tuple[Float[np.ndarray, "r m"], Float[np.ndarray, "r m"]]:
    """Computes what some closures add to Q: their rows and their columns, by the closed form.

    A closure that is new costs r m pairs and not m²: with a frame that stays (`MapCovariance`), the
    rest of Q is what it was.

    Args:
        problem: of all closures, see `consistency_problem`; not traced.
        rows: `[r]` indices of closures.

    Returns:
        `[r, m]`: q²_uv and q²_vu of u in `rows` and all v, zero for a closure with itself; NumPy.

    Raises:
        InputError: for closures that leave directions unsaid.
    """
    if not _says_all(problem):
        raise InputError(
            "problem: closures leave directions unsaid, expected information of full rank (to weigh"
            " them all at once is what squared_mahalanobis does)"
        )
    rows = np.asarray(rows)
    padded = np.zeros(bucket(len(rows), smallest=1), np.int32)
    padded[: len(rows)] = rows
    with lie.own_precision(problem):
        both = _new_pairs(problem, padded)
    count = int(np.count_nonzero(np.asarray(problem.valid)))
    forward, backward = (np.asarray(each)[: len(rows), :count] for each in both)
    return forward, backward


@jax.jit
def _new_pairs(problem: Problem, rows: Any) -> Any:
    harmless, known = _harmless(problem)
    both = closed_form_new(harmless, rows)
    return tuple(_marked(each, known, problem.valid, rows) for each in both)


def _on_all(problem: Problem, mesh: Mesh) -> Problem:
    """The problem on every device of a mesh; each process puts it on its own."""
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(problem)):
        return problem
    everywhere = NamedSharding(mesh, PartitionSpec())
    return jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf), everywhere), problem)


def squared_own_loops(problem: WithinProblem) -> Float[Array, " m"]:
    """Squared Mahalanobis distance of the loop of every closure with odometry alone.

    Chi-squared with d degrees of freedom for a right closure, as `squared_mahalanobis` is for a
    right pair. Safe under jit, vmap and grad.

    Returns:
        Of the valid closures alone; where `problem.valid` is traced, padding is infinite.
    """
    with lie.own_precision(problem):
        squared = _own_loop(problem)
        if isinstance(problem.valid, Tracer):
            return jnp.where(problem.valid, squared, jnp.inf)
        valid = np.flatnonzero(np.asarray(problem.valid))
        if isinstance(squared, Tracer):
            return squared[valid]
        return device_array(np.asarray(squared)[valid], squared.dtype)
