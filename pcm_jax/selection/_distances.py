"""The two ways in which methods read squared distances that are not symmetric; NumPy or JAX."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from jaxtyping import Bool, Float

from pcm_jax.arrays import namespace
from pcm_jax.consistency import consistency_graph


def consistent_pairs(squared: Float[np.ndarray, "m m"], gate: float) -> Bool[np.ndarray, "m m"]:
    """The consistency graph, in NumPy."""
    return np.asarray(consistency_graph(cast(Any, squared), gate))


def symmetrised(squared: Float[Any, "m m"]) -> Float[Any, "m m"]:
    """The larger of the two directions of every pair, the diagonal zero; NaN stays NaN."""
    xp = namespace(squared)
    larger = xp.maximum(squared, squared.T)
    return xp.where(np.eye(len(squared), dtype=bool), 0.0, larger)
