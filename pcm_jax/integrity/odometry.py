"""The scale of odometry's errors, as the loop closures inside one map tell it, right or wrong.

Odometry that states its errors too small contradicts every right closure after a long way, as it
contradicts the false ones. But right ones then miss by a common multiple of what is stated, false
ones by anything. So a closure's loop with odometry alone has the density

    p(r_u) = π N(r_u; 0, f² P_u + Z_u) + (1 − π) U

with P_u what odometry states, Z_u what the closure does, f the factor in question, π the share of
right closures and U that of a pose drawn anywhere on the map. f and π maximise the likelihood: no
truth, no threshold. A factor that is too small leaves right closures to U; one that is too large
spreads N over the map, which costs every right one ln f^d.

With P_u = Z_u-whitened eigenvalues λ, q² and the determinant at any f are sums over d numbers, so
that a grid of factors costs as much as one. One factor for translation and rotation: long loops
show what rotations do and hardly what translations add (on KITTI 00 the likelihood is highest
without any), so that two cannot be told apart here; `calibrate` tells them by what was accepted.

It is never below 1: that odometry is better than stated narrows the test, which is not asked here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pcm_jax.consistency import OwnLoops

LARGEST = 32.0
"""Factors that are looked at: with more odometry says nothing."""
FINENESS = 4
"""Factors looked at in each doubling."""
ROUNDS = 30
"""Of the share of right closures."""
LIKELIER = 3.0
"""By how much the logarithm of a likelihood must be larger to say anything."""
FLAT = 0.1
"""Of its largest extent: the least width of a map."""
ROTATIONS = {3: 2.0 * np.pi, 6: 8.0 * np.pi**2}
"""The volume of all rotations, by d; rad, rad³."""


@dataclass(frozen=True)
class OdometryScale:
    """The factor on odometry's standard deviations under which closures agree with it.

    Attributes:
        factor: at least 1, at most 32.
        share: of the closures that are right, by the model.
        gain: by how much the logarithm of the likelihood is larger than that of "none is right".
    """

    factor: float
    share: float
    gain: float

    @property
    def found(self) -> bool:
        """False where no factor is likelier than that none is right, or only the largest one."""
        return self.factor < LARGEST and self.gain > LIKELIER


def odometry_scale(loops: OwnLoops, extent: Float[np.ndarray, " s"]) -> OdometryScale:
    """Estimates by how much odometry states its errors too small.

    Args:
        loops: of m closures, right and wrong.
        extent: of the map, metres along each axis.
    """
    factors = 2.0 ** (np.arange(FINENESS * int(np.log2(LARGEST)) + 1) / FINENESS)
    if not len(loops.error):
        return OdometryScale(1.0, 0.0, 0.0)
    right = _log_density(loops, factors)
    width = np.maximum(extent, max(FLAT * extent.max(), np.finfo(float).tiny))
    wrong = -np.log(width).sum() - np.log(ROTATIONS[loops.error.shape[1]])
    ratio = np.exp(np.clip(wrong - right, -500.0, 500.0))
    share = np.full((len(factors), 1), 0.5)
    for _ in range(ROUNDS):
        of_right = share / (share + (1.0 - share) * ratio)
        share = of_right.mean(axis=1, keepdims=True)
        share = np.clip(share, 1e-9, 1.0 - 1e-9)
    gain = np.log((1.0 - share) + share / ratio).sum(axis=1)
    best = int(np.argmax(gain))
    return OdometryScale(float(factors[best]), float(share[best, 0]), float(gain[best]))


def _log_density(loops: OwnLoops, factors: Float[np.ndarray, " f"]) -> Float[np.ndarray, "f m"]:
    """The logarithm of N(r; 0, f² P + Z) at every factor."""
    lower = np.linalg.cholesky(loops.measured)
    whitened = np.linalg.solve(lower, loops.odometry)
    whitened = np.linalg.solve(lower, whitened.swapaxes(1, 2))
    values, vectors = np.linalg.eigh(0.5 * (whitened + whitened.swapaxes(1, 2)))
    along = (vectors.swapaxes(1, 2) @ np.linalg.solve(lower, loops.error[..., None]))[..., 0]
    spread = 1.0 + factors[:, None, None] ** 2 * np.maximum(values, 0.0)
    squared = (along**2 / spread).sum(axis=2)
    own = 2.0 * np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=1)
    volume = np.log(spread).sum(axis=2) + own + loops.error.shape[1] * np.log(2.0 * np.pi)
    return -0.5 * (squared + volume)
