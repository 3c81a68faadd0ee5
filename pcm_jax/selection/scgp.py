"""Single-cluster graph partitioning: the densest cluster, by the leading eigenvector.

E. Olson, M. Walter, J. Leonard and S. Teller, "Single-cluster graph partitioning for robotics
applications", RSS 2005. With affinities A and a cluster's indicator u, the average affinity
uᵀAu / uᵀu is largest over real vectors at A's leading eigenvector; u is that vector thresholded at
whichever of its m values gives the largest average.

The diagonal of A is 1 (a measurement agrees with itself). Any other constant would shift every
average alike and change nothing.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from pcm_jax.errors import InputError
from pcm_jax.selection._distances import symmetrised
from pcm_jax.selection.choice import Choice


def _gaussian(squared: np.ndarray, gate: float) -> np.ndarray:
    return np.exp(-0.5 * squared)


def _binary(squared: np.ndarray, gate: float) -> np.ndarray:
    return (squared <= gate).astype(float)


def _linear(squared: np.ndarray, gate: float) -> np.ndarray:
    if gate == 0.0:
        return _binary(squared, gate)
    return np.clip(1.0 - np.sqrt(squared / gate), 0.0, 1.0)


AFFINITIES: dict[str, Callable[[np.ndarray, float], np.ndarray]] = {
    "gaussian": _gaussian,
    "binary": _binary,
    "linear": _linear,
}


def scgp(squared: Float[np.ndarray, "m m"], gate: float, *, affinity: str = "gaussian") -> Choice:
    """The cluster of largest average affinity among the eigenvector's thresholds.

    Args:
        squared: squared distances q²; the larger of a pair's two counts.
        gate: γ², not used by the Gaussian affinity.
        affinity: `"gaussian"`: exp(−q²/2); `"binary"`: 1 within the gate, else 0; `"linear"`:
            1 − q/γ, and 0 beyond the gate.

    Raises:
        InputError: for another affinity.
    """
    if affinity not in AFFINITIES:
        raise InputError(f"affinity: {affinity!r}, expected one of {', '.join(AFFINITIES)}")
    if len(squared) == 0:
        return Choice(np.zeros(0, bool))
    distances = np.nan_to_num(symmetrised(squared), nan=np.inf, posinf=np.inf)
    affinities = AFFINITIES[affinity](distances, gate)
    leading = np.linalg.eigh(affinities)[1][:, -1]
    leading = np.abs(leading)  # of a matrix without negative entries (Perron and Frobenius)
    order = np.argsort(-leading, kind="stable")
    within = affinities[np.ix_(order, order)].cumsum(axis=0).cumsum(axis=1).diagonal()
    average = within / np.arange(1, len(order) + 1)
    members = np.zeros(len(order), bool)
    members[order[: 1 + int(average.argmax())]] = True
    return Choice(members)
