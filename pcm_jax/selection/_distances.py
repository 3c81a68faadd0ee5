"""The two ways in which methods read a matrix of squared distances that is not symmetric."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from jaxtyping import Bool, Float

from pcm_jax.consistency import consistency_graph


def consistent_pairs(squared: Float[np.ndarray, "m m"], gate: float) -> Bool[np.ndarray, "m m"]:
    """The consistency graph, in NumPy."""
    return np.asarray(consistency_graph(cast(Any, squared), gate))


def symmetrised(squared: Float[np.ndarray, "m m"]) -> Float[np.ndarray, "m m"]:
    """The larger of the two directions of every pair, the diagonal zero; NaN stays NaN."""
    larger = np.maximum(squared, squared.T)
    np.fill_diagonal(larger, 0.0)
    return larger
