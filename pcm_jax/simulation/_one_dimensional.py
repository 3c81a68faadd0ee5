"""The paper's one-dimensional world: every measurement observes one number x directly.

With no map between the measurements, eq. 4 shrinks to `ε_uv = z_v − z_u`, so that a world is a
handful of numbers and hundreds of thousands of worlds can be compared with enumeration (Figs 2, 3).
The paper states the kinds of measurement but not how many there are nor how they are spread:
all of that is a parameter here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pcm_jax.errors import InputError


class OneDimensionalWorlds(NamedTuple):
    """Worlds of `m` measurements each, in an order shuffled world by world.

    Attributes:
        measurements: float64 `[w, m]`.
        variances: float64 `[w, m]`, known to the estimator.
        labels: int64 `[w, m]`: 0 of x itself, 1 aliased (all of one wrong place), -1 random.
    """

    measurements: Float[np.ndarray, "w m"]
    variances: Float[np.ndarray, "w m"]
    labels: Int[np.ndarray, "w m"]

    def squared_mahalanobis(self) -> Float[np.ndarray, "w m m"]:
        """Squared distances `q²_uv = (z_v − z_u)² / (σ_u² + σ_v²)`, chi-squared with one degree."""
        difference = self.measurements[:, None, :] - self.measurements[:, :, None]
        return difference**2 / (self.variances[:, None, :] + self.variances[:, :, None])


def simulate_one_dimensional(
    *,
    seed: int = 0,
    worlds: int = 1_000,
    inliers: int = 10,
    aliased: int = 5,
    random: int = 10,
    position: float = 0.0,
    aliased_position: float = 8.0,
    sigma: float = 1.0,
    random_positions: tuple[float, float] = (-20.0, 20.0),
    random_sigmas: tuple[float, float] = (0.5, 2.0),
) -> OneDimensionalWorlds:
    """Draws worlds of inliers, aliased outliers and random outliers.

    Args:
        seed: of `numpy.random.default_rng`.
        worlds: how many worlds, `w`.
        inliers: draws of `N(position, sigma²)` in each world.
        aliased: draws of `N(aliased_position, sigma²)`: consistent with each other, and wrong.
        random: draws of `N(p, s²)`, each with its own `p` and `s`.
        position: the true x.
        aliased_position: the place that is mistaken for x.
        sigma: standard deviation of inliers and aliased outliers.
        random_positions: range that each random outlier's `p` is uniform in.
        random_sigmas: range that each random outlier's `s` is uniform in.

    Raises:
        InputError: a negative count, no measurement at all, or a standard deviation not above 0.
    """
    counts = np.array([inliers, aliased, random])
    if worlds < 1 or counts.min() < 0 or counts.sum() == 0:
        raise InputError(
            f"worlds, inliers, aliased, random: got {worlds}, {inliers}, {aliased}, {random}; "
            "expected at least one world and one measurement, and no negative count"
        )
    if min(sigma, *random_sigmas) <= 0:
        raise InputError(
            f"sigma, random_sigmas: got {sigma}, {random_sigmas}; expected numbers above 0"
        )
    generator = np.random.default_rng(seed)
    shape = (worlds, random)
    means = np.repeat([[position, aliased_position, 0.0]], counts, axis=1).repeat(worlds, axis=0)
    sigmas = np.full(means.shape, float(sigma))
    labels = np.repeat([[0, 1, -1]], counts, axis=1).repeat(worlds, axis=0)
    means[:, inliers + aliased :] = generator.uniform(*random_positions, size=shape)
    sigmas[:, inliers + aliased :] = generator.uniform(*random_sigmas, size=shape)
    measurements = generator.normal(means, sigmas)
    order = np.argsort(generator.random(means.shape), axis=1)
    shuffled = (np.take_along_axis(a, order, axis=1) for a in (measurements, sigmas**2, labels))
    return OneDimensionalWorlds(*shuffled)
