"""The selection methods as pure kernels, for many small problems at once.

Each takes one matrix and returns one mask; the shape alone fixes the work, so that worlds are
batched by `vmap` (`select_batched` does it, in blocks that fit into cache; PCM-Exact, whose work
depends on the world, gets all worlds at once and shares them out itself). With the same rules for
ties as the host's methods of the same names, they return the same sets:

- combinatorial: all subsets of the first half and all of the second, 2^(m/2) each, meet in the
  middle. With N(v) the measurements consistent with v, the largest set within S is found for all S
  of the second half by `f(S ∪ {v}) = max(f(S), 1 + f(S ∩ N(v)))`, and a consistent set T of the
  first half goes on with `f(∩ N(t), t in T)`. Of equal sets, the lexicographically smallest.
- PCM-Exact: `maximum_clique_batched`.
- PCM-HeuPatt: candidates only ever leave, so one sweep in the order of falling degree takes from
  every start at once what the greedy rule would.
- RANSAC: as in `ransac`.
- SCGP: as in `scgp`, the leading eigenvector by power iteration wherever that converges: the
  residual |A v − λ v| is then what rounding leaves of it, as it is after a factorisation, which
  takes twenty times as long and is left for matrices whose largest eigenvalues nearly tie.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt32

from pcm_jax.clique import maximum_clique_batched
from pcm_jax.consistency import consistency_graph
from pcm_jax.errors import InputError

WORD = 32
EXACT_LIMIT = 128
_BLOCK = 1 << 20  # entries of the largest array within a block of worlds
# Of power iteration: 99 % of the worlds of 115 closures converge within 120 steps.
_STEPS, _STEPS_AT_ONCE = 256, 8
_RESIDUAL = 512  # units of rounding of the eigenvalue: 1e-13 in float64


def select_batched(
    squared: Float[Array, "*batch m m"], gate: Any, *, method: str = "pcm-exact", **options: Any
) -> Bool[Array, "*batch m"]:
    """What a method keeps in each of many small problems; jit it.

    Args:
        squared: [..., m, m], squared distances, as in `select_from`.
        gate: γ², one number.
        method: as in `select_from`.
        **options: `affinity` of `"scgp"`.

    Returns:
        bool [..., m], what `select_from` returns for each matrix in the same precision.

    Raises:
        InputError: an unknown method, or more measurements than 32 for `"combinatorial"` or
            128 for `"pcm-exact"`.
    """
    if method not in KERNELS:
        raise InputError(f"method: {method!r}, expected one of {', '.join(KERNELS)}")
    *batch, m, _ = squared.shape
    if m == 0:
        return jnp.zeros((*batch, 0), bool)
    worlds = squared.reshape(-1, m, m)
    widest = max(m * m, 1 << m // 2) if method == "combinatorial" else m * m
    block = len(worlds) if method == "pcm-exact" else max(1, _BLOCK // widest)
    kernel = partial(KERNELS[method], gate=gate, **options)
    members = jax.lax.map(kernel, worlds, batch_size=block)
    return members.reshape(*batch, m)


def combinatorial(squared: Float[Array, "m m"], gate: Any) -> Bool[Array, " m"]:
    """The largest pairwise consistent set by enumeration of each half's subsets, m ≤ 32."""
    m = _at_most(WORD, squared, "combinatorial")
    graph = consistency_graph(squared, gate)
    half = m // 2
    weight = 1 << np.concatenate([np.arange(half - 1, -1, -1), np.arange(m - half - 1, -1, -1)])
    near_first = _words(graph[:, :half], weight[:half])
    near_second = _words(graph[:, half:], weight[half:])
    # Ranks: larger sets first, of equal ones the larger number, which is the smaller set.
    one = 1 << (m - half)
    largest = jnp.zeros(1, jnp.uint32)  # rank of the best set within each subset of the second half
    for v in range(m - 1, half - 1, -1):
        lower = jnp.arange(largest.size, dtype=jnp.uint32)
        with_v = largest[lower & near_second[v]] + np.uint32(one + weight[v])
        largest = jnp.append(largest, jnp.maximum(largest, with_v))
    consistent = jnp.ones(1, bool)
    common = jnp.full(1, one - 1, jnp.uint32)  # of the second half, near every member
    for v in range(half - 1, -1, -1):
        lower = jnp.arange(common.size, dtype=jnp.uint32)
        consistent = jnp.append(consistent, consistent & (lower & ~near_first[v] == 0))
        common = jnp.append(common, common & near_second[v])
    first = np.arange(1 << half, dtype=np.uint32)
    size = np.bitwise_count(first) + (largest[common] // one)
    best = jnp.argmax(jnp.where(consistent, size << half | first, 0)).astype(jnp.uint32)
    halves = [jnp.full(half, best), jnp.full(m - half, largest[common[best]])]
    return jnp.concatenate(halves) & weight.astype(np.uint32) != 0


def pcm_exact(squared: Float[Array, "m m"], gate: Any) -> Bool[Array, " m"]:
    """The largest pairwise consistent set by branch and bound, m ≤ 128."""
    _at_most(EXACT_LIMIT, squared, "pcm-exact")
    return maximum_clique_batched(consistency_graph(squared, gate)).members


def pcm_heuristic(squared: Float[Array, "m m"], gate: Any) -> Bool[Array, " m"]:
    """A large pairwise consistent set, greedily by degree from every measurement (HeuPatt)."""
    return _greedy(consistency_graph(squared, gate))


def ransac(squared: Float[Array, "m m"], gate: Any) -> Bool[Array, " m"]:
    """The measurements within the gate of the model that has most of them."""
    distances = _symmetrised(squared)
    support = distances <= gate
    total = jnp.where(support, distances, 0.0).sum(axis=1)
    return support[jnp.lexsort((total, -support.sum(axis=1)))[0]]


def scgp(
    squared: Float[Array, "m m"], gate: Any, *, affinity: str = "gaussian"
) -> Bool[Array, " m"]:
    """The cluster of largest average affinity among the leading eigenvector's thresholds."""
    if affinity not in AFFINITIES:
        raise InputError(f"affinity: {affinity!r}, expected one of {', '.join(AFFINITIES)}")
    distances = _symmetrised(squared)
    affinities = AFFINITIES[affinity](jnp.where(jnp.isnan(distances), jnp.inf, distances), gate)
    # Equal neighbourhoods are common there, and tied eigenvalues with them.
    eigenvector = _by_factorisation if affinity == "binary" else _leading
    leading = jnp.abs(eigenvector(affinities[None])[0])
    order = jnp.argsort(-leading, stable=True)
    rank = jnp.argsort(order)
    with_earlier = jnp.where(rank < rank[:, None], affinities, 0.0).sum(axis=1)
    within = jnp.cumsum((jnp.diagonal(affinities) + 2.0 * with_earlier)[order])
    return rank <= jnp.argmax(within / jnp.arange(1, len(order) + 1))


@jax.custom_batching.custom_vmap
def _leading(matrices: Float[Array, "n m m"]) -> Float[Array, "n m"]:
    """An eigenvector of the largest eigenvalue of each matrix, without negative entries.

    The matrices have no negative entries and ones as their diagonal, so that no eigenvalue is as
    large in magnitude, and the constant vector is not orthogonal to what is looked for.
    """
    number, m, _ = matrices.shape
    tolerance = _RESIDUAL * jnp.finfo(matrices.dtype).eps

    def step(_: int, vectors: Array) -> Array:
        moved = jnp.einsum("nij,nj->ni", matrices, vectors)
        return moved / jnp.linalg.norm(moved, axis=1, keepdims=True)

    def converged(vectors: Array) -> Array:
        moved = jnp.einsum("nij,nj->ni", matrices, vectors)
        value = jnp.sum(vectors * moved, axis=1)
        residual = jnp.abs(moved - value[:, None] * vectors).max(axis=1)
        # An eigenvalue of one belongs to every vector: no two measurements agree at all.
        return (residual <= tolerance * value) & (value > 1.0 + tolerance)

    def unfinished(state: tuple[Array, Array, Array]) -> Array:
        return (state[2] < _STEPS) & ~state[1].all()

    def advance(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        vectors = jax.lax.fori_loop(0, _STEPS_AT_ONCE, step, state[0])
        return vectors, converged(vectors), state[2] + _STEPS_AT_ONCE

    constant = jnp.full((number, m), m**-0.5, matrices.dtype)
    start = constant, jnp.zeros(number, bool), jnp.int32(0)
    vectors, done, _ = jax.lax.while_loop(unfinished, advance, start)

    def settle(of_one: tuple[Array, Array, Array]) -> Array:
        matrix, vector, done = of_one
        return jax.lax.cond(done, lambda: vector, lambda: _by_factorisation(matrix[None])[0])

    # One after the other, not mapped: only then are the matrices that are done passed over.
    return jax.lax.cond(
        done.all(), lambda: vectors, lambda: jax.lax.map(settle, (matrices, vectors, done))
    )


@_leading.def_vmap
def _(size: int, mapped: list[bool], matrices: Array) -> tuple[Array, bool]:
    """The mapped axis joins the batch."""
    found = _leading(matrices.reshape(-1, *matrices.shape[-2:]))
    return found.reshape(size, -1, matrices.shape[-1]), True


def _by_factorisation(matrices: Float[Array, "n m m"]) -> Float[Array, "n m"]:
    return jnp.linalg.eigh(matrices)[1][..., -1]


def _greedy(graph: Bool[Array, "m m"]) -> Bool[Array, " m"]:
    """From every start: always the candidate of largest degree, ties by index; the first best."""
    order = jnp.argsort(-graph.sum(axis=0), stable=True)
    ranked = graph[order][:, order]

    def visit(carry: tuple[Array, Array], vertex: tuple[Array, Array]) -> tuple[Any, None]:
        candidates, members = carry  # [start, vertex]
        index, near = vertex
        taken = candidates[:, index]
        candidates = candidates & (near | ~taken[:, None])
        return (candidates, members.at[:, index].max(taken)), None

    starts = jnp.eye(len(graph), dtype=bool)
    (_, members), _ = jax.lax.scan(visit, (ranked, starts), (jnp.arange(len(graph)), ranked))
    best = members[jnp.argmax(members.sum(axis=1))]
    return jnp.zeros_like(best).at[order].set(best)


def _symmetrised(squared: Float[Array, "m m"]) -> Float[Array, "m m"]:
    larger = jnp.maximum(squared, squared.T)
    return jnp.where(np.eye(len(squared), dtype=bool), 0.0, larger)


def _words(rows: Bool[Array, "m m"], weight: Any) -> UInt32[Array, " m"]:
    """Each row as a bit set; different bits add without a carry."""
    return jnp.sum(jnp.where(rows, weight.astype(np.uint32), 0), axis=1, dtype=jnp.uint32)


def _at_most(limit: int, squared: Any, method: str) -> int:
    m = squared.shape[-1]
    if m > limit:
        raise InputError(
            f"squared: {m} measurements, expected at most {limit} for batched method {method!r}"
        )
    return m


AFFINITIES: dict[str, Callable[[Any, Any], Any]] = {
    "gaussian": lambda squared, gate: jnp.exp(-0.5 * squared),
    "binary": lambda squared, gate: (squared <= gate).astype(squared.dtype),
    "linear": lambda squared, gate: jnp.clip(1.0 - jnp.sqrt(squared / gate), 0.0, 1.0),
}
"""As in `scgp`; "linear" needs a gate above zero."""

KERNELS: dict[str, Callable[..., Bool[Array, " m"]]] = {
    "pcm-exact": pcm_exact,
    "pcm-heuristic": pcm_heuristic,
    "combinatorial": combinatorial,
    "ransac": ransac,
    "scgp": scgp,
}
