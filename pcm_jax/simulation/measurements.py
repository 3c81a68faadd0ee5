"""Noisy relative poses, and who meets whom: what every simulated world is made of.

All of it runs in NumPy, on NumPy-backed transforms. A measurement is `true · exp(δ)` with δ normal:
noise on the right, in the measurement's own end frame, whose inverse covariance is the edge's
information.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.lie import Group, Transform

# Poses fewer steps apart than this are neighbours on the chain, no loop closures: in City10000 99 %
# of the closures span 41 steps or more, the shortest 5.
_REVISIT_GAP = 10


def space_dim(group: Group[Any]) -> int:
    """2 in the plane, 3 in space."""
    return lie.module_of(group).MATRIX_DIM - 1


def diagonal_covariance(
    group: Group[Any], sigma_translation: float, sigma_rotation: float
) -> Float[np.ndarray, "d d"]:
    """Independent noise of one deviation (m) along every axis and one (rad) about every axis."""
    space = space_dim(group)
    sigmas = [sigma_translation] * space + [sigma_rotation] * (lie.tangent_dim(group) - space)
    return np.diag(np.square(sigmas))


def measure(
    generator: np.random.Generator, truth: Transform, covariance: Float[np.ndarray, "#m d d"]
) -> Transform:
    """`truth · exp(δ)` with δ drawn from `N(0, covariance)`, one draw for each of `truth` `[m]`."""
    group = lie.group_of(truth)
    white = generator.standard_normal((*lie.parameters(truth).shape[:-1], lie.tangent_dim(group)))
    noise = np.einsum("...ij,...j->...i", np.linalg.cholesky(covariance), white)
    return lie.normalize(lie.compose(truth, lie.exp(group, noise)))


def near_pairs(
    places: Float[np.ndarray, "n s"], others: Float[np.ndarray, "k s"], reach: float
) -> Int[np.ndarray, "p 2"]:
    """All pairs (row of `places`, row of `others`) within `reach` of each other, in order."""
    from scipy.spatial import KDTree

    trees = KDTree(places), KDTree(others)
    found = trees[0].sparse_distance_matrix(trees[1], reach, output_type="ndarray")
    pairs = np.stack([found["i"], found["j"]], axis=-1)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def revisits(
    generator: np.random.Generator,
    places: Float[np.ndarray, "n s"],
    *,
    spot: float,
    reach: float,
    most: int,
) -> Int[np.ndarray, "l 2"]:
    """Loop closures of one trajectory: (earlier, later) pairs where it passes a place again.

    A pose that returns to within `spot` of an earlier one is tied to at most `most` of the earlier
    poses within `reach` of it, chosen at random (City10000: the same spot, 2 poses, about 3 m).
    """
    pairs = near_pairs(places, places, reach)
    earlier, later = pairs[pairs[:, 1] - pairs[:, 0] >= _REVISIT_GAP].T
    near = np.linalg.norm(places[earlier] - places[later], axis=1) <= spot
    returned = np.bincount(later[near], minlength=len(places)) > 0
    earlier, later = earlier[returned[later]], later[returned[later]]
    order = np.lexsort((generator.random(len(later)), later))
    chosen = order[_rank_in_run(later[order]) < most]
    return np.stack([earlier[chosen], later[chosen]], axis=-1)


def _rank_in_run(keys: Int[np.ndarray, " p"]) -> Int[np.ndarray, " p"]:
    """0, 1, 2, … within each run of equal keys."""
    index = np.arange(len(keys))
    starts = np.where(np.diff(keys, prepend=-1) != 0, index, 0)
    return index - np.maximum.accumulate(starts)
