"""Robots that drive through one city of square blocks, after City10000 (Kaess et al., iSAM).

What is copied from that data set, by measuring it: streets every 5 m, steps of 1 m, a turn at 23 %
of the crossings, noise of 0.02 m and 0.01 rad on every measurement, about one pose for every square
metre of the city, and up to two loop closures (to poses within about 3 m) wherever a robot returns
to a spot, 1.07 a pose over the whole drive.
"""

from __future__ import annotations

from string import ascii_lowercase

import jaxlie
import numpy as np

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.simulation._streets import block_poses, drive
from pcm_jax.simulation.measurements import diagonal_covariance
from pcm_jax.simulation.world import (
    SimulatedWorld,
    drive_and_measure,
    require_at_least,
    require_positive,
)

_BLOCK = 5  # m between streets, and steps of 1 m between crossings
_SAME_SPOT = 0.5  # m


def simulate_city(
    *,
    seed: int = 0,
    poses: int = 1_000,
    robots: int = 2,
    inliers: int = 15,
    aliased_groups: int = 2,
    aliased_size: int = 5,
    random: int = 90,
    sigma_translation: float = 0.02,
    sigma_rotation: float = 0.01,
    blocks: int | None = None,
    reach: float = 3.0,
    random_range: float | None = None,
    loops_per_return: int = 2,
) -> SimulatedWorld:
    """SE(2) maps of one city, with candidate closures between every two robots.

    Every measurement is `true · exp(δ)`, δ normal, and its information the inverse covariance.
    The defaults are the paper's numbers of closures: 15 true, two aliased groups of 5, 90 random.
    `pcm_jax.simulation.outliers` states the outliers' law.

    Args:
        seed: of `numpy.random.default_rng`; the same seed gives the same world.
        poses: poses of each robot.
        robots: number of robots.
        inliers: true closures between each two robots, at random among the pose pairs in reach.
        aliased_groups: groups of false closures that agree among themselves, for each two robots.
        aliased_size: closures in each group.
        random: random closures between each two robots.
        sigma_translation: standard deviation along x and y of every measurement, metres.
        sigma_rotation: standard deviation of the heading in every measurement, radians.
        blocks: blocks of 5 m along each side of the city; by default City10000's density.
        reach: metres between two poses that can measure each other.
        random_range: metres between the two poses of a random closure; None: the whole city.
        loops_per_return: loop closures that a robot makes at most where it is back at a place.

    Raises:
        InputError: a number out of range, or robots that pass each other too seldom.
    """
    require_at_least(2, poses=poses)
    require_at_least(1, robots=robots)
    require_at_least(0, inliers=inliers, aliased_groups=aliased_groups, random=random)
    require_at_least(1, aliased_size=aliased_size, loops_per_return=loops_per_return)
    require_positive(
        sigma_translation=sigma_translation, sigma_rotation=sigma_rotation, reach=reach
    )
    if robots > len(ascii_lowercase):
        raise InputError(f"robots: {robots} given, expected at most 26, named a to z")
    blocks = blocks or max(2, round(np.sqrt(poses * robots) / _BLOCK))
    generator = np.random.default_rng(seed)
    truth = [_street_poses(generator, poses, blocks) for _ in range(robots)]
    covariance = diagonal_covariance(jaxlie.SE2, sigma_translation, sigma_rotation)
    return drive_and_measure(
        generator,
        truth,
        spot=_SAME_SPOT,
        loops_per_return=loops_per_return,
        odometry=covariance,
        closure=covariance,
        inliers=inliers,
        reach=reach,
        aliased_groups=aliased_groups,
        aliased_size=aliased_size,
        random=random,
        random_range=random_range,
    )


def _street_poses(generator: np.random.Generator, poses: int, blocks: int) -> jaxlie.SE2:
    """True poses `[n]` of one drive, NumPy-backed, in the city's frame."""
    places, headings = drive(generator, crossings=2 + (poses - 2) // _BLOCK + 1, blocks=blocks)
    position, heading = block_poses(places, headings, steps=_BLOCK)
    angle = 0.5 * np.pi * heading[:poses]
    x, y = _BLOCK * position[:poses].T
    return lie.from_components(jaxlie.SE2, (np.cos(angle), np.sin(angle), x, y))
