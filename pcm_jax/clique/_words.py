"""Sets of vertices as machine words: one bit a vertex, many sets in one array operation.

What `bitset` does with one Python integer, for kernels. An array of sets has the shape [w, ...]:
vertex v is bit v % bits of word v // bits. The words lead, so that the sets lie side by side in
memory and one vector instruction works on several of them.
"""

from __future__ import annotations

from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, UInt


def pack(members: Bool[Array, "*batch m"]) -> UInt[Array, "w *batch"]:
    """Masks as sets, in 64-bit words where there are any (under x64) and need for them."""
    m = members.shape[-1]
    word = jax.dtypes.canonicalize_dtype(np.uint64 if m > 32 else np.uint32)
    padding = [(0, 0)] * (members.ndim - 1) + [(0, -m % _bits(word))]
    octets = jnp.packbits(jnp.pad(members, padding), axis=-1, bitorder="little")
    octets = octets.reshape(*members.shape[:-1], -1, word.itemsize)
    return jnp.moveaxis(jax.lax.bitcast_convert_type(octets, word), -1, 0)


def unpack(sets: UInt[Array, "w *batch"], m: int) -> Bool[Array, "*batch m"]:
    """Sets as masks over the vertices 0..m-1."""
    shifts = jnp.arange(_bits(sets.dtype), dtype=sets.dtype)
    members = [word[..., None] >> shifts & 1 != 0 for word in sets]
    return jnp.concatenate(members, axis=-1)[..., :m]


def some(sets: UInt[Array, "w *batch"]) -> Bool[Array, "*batch"]:
    """True where the sets have any member."""
    return reduce(jnp.bitwise_or, list(sets)) != 0


def count(sets: UInt[Array, "w *batch"]) -> Int[Array, "*batch"]:
    """The numbers of members, int32."""
    return jnp.sum(jax.lax.population_count(sets), axis=0, dtype=jnp.int32)


def first(sets: UInt[Array, "w *batch"]) -> Int[Array, "*batch"]:
    """The smallest members, int32; of empty sets, any vertex or -1."""
    return _last_bit(sets & -sets, range(len(sets)))


def last(sets: UInt[Array, "w *batch"]) -> Int[Array, "*batch"]:
    """The largest members, int32; of empty sets, any vertex or -1."""
    return _last_bit(sets, reversed(range(len(sets))))


def single(vertex: Int[Array, "*batch"], like: UInt[Array, "w *batch"]) -> UInt[Array, "w *batch"]:
    """The sets of one vertex each, in the words of `like`."""
    bits = _bits(like.dtype)
    bit = like.dtype.type(1) << (vertex % bits).astype(like.dtype)
    return jnp.stack([jnp.where(vertex // bits == word, bit, 0) for word in range(len(like))])


def precedes(
    left: UInt[Array, "w *batch"], right: UInt[Array, "w *batch"]
) -> Bool[Array, "*batch"]:
    """True where the smallest vertex that is in only one of two sets is in the left one.

    Of sets of equal size, the one that precedes is the lexicographically smaller tuple.
    """
    different = left ^ right
    owned = left & different & -different != 0
    answer = owned[-1]
    for word in reversed(range(len(left) - 1)):
        answer = jnp.where(different[word] != 0, owned[word], answer)
    return answer


def _last_bit(sets: Array, order: Any) -> Array:
    """The position of the highest bit of the first word, in this order, that is not zero."""
    bits = _bits(sets.dtype)
    position: Any = None
    for word in reversed(list(order)):
        here = bits * (word + 1) - 1 - jax.lax.clz(sets[word]).astype(jnp.int32)
        position = here if position is None else jnp.where(sets[word] != 0, here, position)
    return position


def _bits(word: Any) -> int:
    return 8 * np.dtype(word).itemsize
