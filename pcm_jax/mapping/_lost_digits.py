"""The share of covariances that rounding takes, measured by one step of iterative refinement."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax.sparse.cholesky import CholeskyFactor

RIGHT_SIDES = 4
"""By which the loss of digits is measured: of one alone an entry may be small by accident."""


def lost_digits(
    factor: CholeskyFactor,
    products: Float[np.ndarray, "3 e d d"],
    ends: Int[np.ndarray, "2 e"],
    free: Bool[np.ndarray, " n"],
) -> float:
    """Measures the largest share of a solution H⁻¹ b that rounding takes, as of covariances.

    Found by one step of iterative refinement, δ = H⁻¹ (b − H x), for a few b in the units of the
    poses' own information, and measured entry by entry, δ over x. Against sixty digits, of maps
    whose edges span 0 to 14 orders, it is 0.7 to 2.3 times the largest error of a covariance over
    the two standard deviations.
    """
    of_tail, of_head, across = products[:, : ends.shape[1]]
    diagonal = np.zeros((len(free), products.shape[-1]))
    np.add.at(diagonal, ends[0], np.diagonal(of_tail, axis1=1, axis2=2))
    np.add.at(diagonal, ends[1], np.diagonal(of_head, axis1=1, axis2=2))
    shape = (*diagonal.shape, RIGHT_SIDES)
    held = free[:, None, None]
    right = np.random.default_rng(0).normal(size=shape) * np.sqrt(diagonal)[..., None] * held
    found = factor.solve(right.reshape(-1, RIGHT_SIDES)).reshape(shape)
    tail, head = found[ends[0]], found[ends[1]]
    left = right.copy()
    np.subtract.at(left, ends[0], of_tail @ tail + across.swapaxes(1, 2) @ head)
    np.subtract.at(left, ends[1], of_head @ head + across @ tail)
    left = (left * held).reshape(-1, RIGHT_SIDES)
    missed = factor.solve(left).reshape(shape)[free]
    lost = np.sqrt((missed**2).sum(axis=2) / (found[free] ** 2).sum(axis=2))
    return float(lost.max(initial=0.0))
