"""RANSAC as the paper compares with it: every measurement is tried as the model.

With one measurement as the minimal sample there are only m models, so none is left to chance.
Needs m² squared distances and a gate; the members agree with the model, not with one another.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from pcm_jax.arrays import namespace
from pcm_jax.selection._distances import symmetrised
from pcm_jax.selection.method import Choice, SelectionMethod


def largest_support(squared: Float[Any, "m m"], gate: Any) -> Bool[Any, " m"]:
    """The measurements within the gate (both ways) of the model that has most of them.

    Of models with equally many, the one with the least total squared distance, then the first.
    NumPy or JAX; m is at least 1.
    """
    xp = namespace(squared)
    distances = symmetrised(squared)
    support = distances <= gate
    total = xp.where(support, distances, 0.0).sum(axis=1)
    return support[xp.lexsort((total, -support.sum(axis=1)))[0]]


def ransac(squared: Float[np.ndarray, "m m"], gate: float) -> Choice:
    """Keeps the largest support, see `largest_support`."""
    return Choice(largest_support(squared, gate) if len(squared) else np.zeros(0, bool))


METHODS = (SelectionMethod("ransac", ransac, kernel=largest_support),)
