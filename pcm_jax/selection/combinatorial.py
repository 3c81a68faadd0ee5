"""The largest pairwise consistent set by enumeration: the paper's gold standard for small m.

Needs 2^m bits of memory and time; shares no code with the clique search, which it tests.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pcm_jax.errors import InputError
from pcm_jax.selection._distances import consistent_pairs
from pcm_jax.selection.choice import Choice

LARGEST = 24


def combinatorial(squared: Float[np.ndarray, "m m"], gate: float) -> Choice:
    """Every subset is looked at; of equal sizes the lexicographically smallest wins.

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
