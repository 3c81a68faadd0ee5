"""Small worlds in which robots may or may not have met."""

import functools

from pcm_jax import weigh
from pcm_jax.simulation import simulate_city, simulate_sessions

LOOSE = {"sigma_translation": 0.2, "sigma_rotation": 0.03}
"""Odometry whose drift lets closures agree by chance."""


@functools.cache
def evidence_of(group, seed, inliers, random, groups=0, size=5, loose=False):
    """The evidence of one pair of robots, and the labels of its closures."""
    world = {"SE2": simulate_city, "SE3": simulate_sessions}[group](
        seed=seed,
        poses=80,
        inliers=inliers,
        aliased_groups=groups,
        aliased_size=size,
        random=random,
        **(LOOSE if loose else {}),
    )
    (pair,) = weigh(world.graph).pairs
    return pair, world
