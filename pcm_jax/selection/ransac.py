"""RANSAC as the paper compares with it: every measurement is tried as the model.

With one measurement as the minimal sample there are only m models, so none is left to chance.
Needs m² squared distances and a gate; the members agree with the model, not with one another.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pcm_jax.selection._distances import symmetrised
from pcm_jax.selection.choice import Choice


def ransac(squared: Float[np.ndarray, "m m"], gate: float) -> Choice:
    """The measurements within the gate (both ways) of the model that has most of them.

    Of models with equally many, the one with the least total squared distance, then the first.
    """
    if len(squared) == 0:
        return Choice(np.zeros(0, bool))
    distances = symmetrised(squared)
    support = distances <= gate
    total = np.where(support, distances, 0.0).sum(axis=1)
    model = np.lexsort((total, -support.sum(axis=1)))[0]
    return Choice(support[model])
