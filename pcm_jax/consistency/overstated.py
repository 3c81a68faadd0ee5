"""Errors stated too large: how much narrower the gate may be."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pcm_jax.consistency.gate import chi2_gate

OVERSTATED = 0.25
"""Scale of the squared distances below which errors are taken to be stated too large."""
SURE = 0.99
"""Probability with which errors as stated lead to no smaller scale than 1."""


def narrowing(
    squared: Float[np.ndarray, "*batch"], gate: float, dim: int, *, count: int | None = None
) -> float:
    """Finds the factor on a gate for closures most of which fit far better than they state.

    The median of those that pass tells by how much: it says what more than half have in common,
    whatever the others are. Of n as stated it is, with probability `SURE`, at least the quantile of
    χ²_d at the level that so large a part of a Beta distribution of (n + 1)/2 and (n + 1)/2
    exceeds; the scale is what it is of that. Errors are seldom overstated alike, so the gate
    follows the root of the scale: it is narrower by half of the orders of magnitude by which the
    median is. Not right where more than half are overstated a hundred times, and others not at all.

    Args:
        squared: squared distances.
        gate: γ²; larger ones count for nothing.
        dim: d.
        count: n, where distances are those of pairs; None: their number.

    Returns:
        at most 1; 1 for a scale above `OVERSTATED`.
    """
    from scipy.special import betaincinv

    passing = squared[(squared >= 0.0) & (squared <= gate)]
    if not len(passing):
        return 1.0
    half = 0.5 * ((len(passing) if count is None else count) + 1)
    least = float(chi2_gate(float(betaincinv(half, half, 1.0 - SURE)), dim))
    scale = float(np.median(passing)) / least
    return float(np.sqrt(scale)) if scale < OVERSTATED else 1.0
