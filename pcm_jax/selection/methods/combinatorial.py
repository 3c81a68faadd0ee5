"""The largest pairwise consistent set by enumeration: the paper's gold standard for small m.

Shares no code with the clique search, which it tests. The host looks at all 2^m subsets. The kernel
enumerates all subsets of the first half and all of the second, 2^(m/2) each, and meets in the
middle: with N(v) the measurements consistent with v, the largest set within S is found for all S of
the second half by `f(S ∪ {v}) = max(f(S), 1 + f(S ∩ N(v)))`, and a consistent set T of the first
half goes on with `f(∩ N(t), t in T)`. Of equal sets, the lexicographically smallest.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt32

from pcm_jax.consistency import consistency_graph
from pcm_jax.errors import InputError
from pcm_jax.selection._distances import consistent_pairs
from pcm_jax.selection.method import Choice, SelectionMethod, at_most

LARGEST = 24
WORD = 32
"""Measurements of the kernel."""


def combinatorial(squared: Float[np.ndarray, "m m"], gate: float) -> Choice:
    """Looks at every subset; of equal sizes the lexicographically smallest wins.

    Raises:
        InputError: for more than 24 measurements.
    """
    count = len(squared)
    if count > LARGEST:
        raise InputError(
            f"squared: {count} measurements, expected at most {LARGEST} for method "
            "'combinatorial' (it looks at all 2^m subsets)"
        )
    # Measurement 0 is the highest bit, so that of equal sizes the largest number is first.
    weight = 1 << np.arange(count - 1, -1, -1)
    strangers = ~consistent_pairs(squared, gate) @ weight
    consistent = np.ones(1, bool)
    for measurement in range(count - 1, -1, -1):
        lower = np.arange(len(consistent))
        consistent = np.append(consistent, consistent & (lower & strangers[measurement] == 0))
    subsets = np.flatnonzero(consistent)
    sizes = np.bitwise_count(subsets)
    best = subsets[sizes == sizes.max()][-1]
    return Choice(best & weight != 0, True, int(sizes.max()))


def combinatorial_kernel(squared: Float[Array, "m m"], gate: Any) -> Bool[Array, " m"]:
    """The kernel of `combinatorial`, m ≤ 32."""
    m = at_most(WORD, squared, "combinatorial")
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


def _words(rows: Bool[Array, "m m"], weight: Any) -> UInt32[Array, " m"]:
    """Each row as a bit set; different bits add without a carry."""
    return jnp.sum(jnp.where(rows, weight.astype(np.uint32), 0), axis=1, dtype=jnp.uint32)


METHODS = (
    SelectionMethod(
        "combinatorial",
        combinatorial,
        kernel=combinatorial_kernel,
        entries=lambda m: max(m * m, 1 << m // 2),
    ),
)
