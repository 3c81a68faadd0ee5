"""Two drives over one rolling campus, in 3D: long odometry drift, few closures, much confusion.

After the shape of the paper's NCLT experiment, with none of its data: paths run between jittered
crossings, round the corners, follow the ground's height and tilt, and drift by about 2 m and 2.3°
per 100 m as NCLT's own odometry does. Registrations are as good as GICP's on Duderstadt, 0.1 m and
1°, so a closure is worth much more than the odometry around it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jaxlie
import numpy as np
from jaxtyping import Float

from pcm_jax import lie
from pcm_jax.simulation._streets import drive
from pcm_jax.simulation.measurements import diagonal_covariance
from pcm_jax.simulation.world import (
    SimulatedWorld,
    drive_and_measure,
    require_at_least,
    require_positive,
)

_BLOCK = 60.0  # m between crossings
_JITTER = 10.0  # m, standard deviation of a crossing's place
_STEP = 2.0  # m between keyframes
_ROUNDING = 4.0  # m, width of the Gaussian that rounds corners
_FINE = 0.5  # m between the points a path is drawn with
_WAVES = 5  # of the ground
_WAVELENGTHS = (80.0, 250.0)  # m
_AMPLITUDE = 1.5  # m
_SAME_SPOT = 2.0  # m

Ground = Callable[[Float[np.ndarray, "n 2"]], tuple[np.ndarray, np.ndarray]]


def simulate_sessions(
    *,
    seed: int = 0,
    poses: int = 500,
    sessions: int = 2,
    inliers: int = 10,
    aliased_groups: int = 2,
    aliased_size: int = 4,
    random: int = 90,
    sigma_translation: float = 0.05,
    sigma_rotation: float = 0.005,
    closure_sigma_translation: float = 0.1,
    closure_sigma_rotation: float = 0.017,
    reach: float = 3.0,
    random_range: float | None = None,
) -> SimulatedWorld:
    """SE(3) maps of one campus, with candidate closures between every two sessions.

    Arguments that `simulate_city` has as well mean the same; here odometry and closures differ in
    noise. By default 10 closures are true and 98 are not, as in the paper's NCLT experiment.

    Args:
        seed: of `numpy.random.default_rng`; the same seed gives the same world.
        poses: keyframes of each session, one every 2 m.
        sessions: number of drives.
        inliers: true closures between each two sessions.
        aliased_groups: groups of false closures that agree among themselves.
        aliased_size: closures in each group.
        random: random closures between each two sessions.
        sigma_translation: standard deviation along each axis of an odometry step, metres.
        sigma_rotation: standard deviation about each axis of an odometry step, radians.
        closure_sigma_translation: the same of a closure, inside a session or between two.
        closure_sigma_rotation: the same of a closure.
        reach: metres between two poses that can measure each other.
        random_range: metres between the two poses of a random closure; None: the whole campus.

    Raises:
        InputError: a number out of range, or sessions that pass each other too seldom.
    """
    require_at_least(2, poses=poses)
    require_at_least(1, sessions=sessions, aliased_size=aliased_size)
    require_at_least(0, inliers=inliers, aliased_groups=aliased_groups, random=random)
    require_positive(
        sigma_translation=sigma_translation,
        sigma_rotation=sigma_rotation,
        closure_sigma_translation=closure_sigma_translation,
        closure_sigma_rotation=closure_sigma_rotation,
        reach=reach,
    )
    generator = np.random.default_rng(seed)
    truth = _campus_poses(generator, poses, sessions)
    odometry = diagonal_covariance(jaxlie.SE3, sigma_translation, sigma_rotation)
    closure = diagonal_covariance(jaxlie.SE3, closure_sigma_translation, closure_sigma_rotation)
    return drive_and_measure(
        generator,
        truth,
        spot=_SAME_SPOT,
        loops_per_return=1,
        odometry=odometry,
        closure=closure,
        inliers=inliers,
        reach=reach,
        aliased_groups=aliased_groups,
        aliased_size=aliased_size,
        random=random,
        random_range=random_range,
    )


def _campus_poses(generator: np.random.Generator, poses: int, sessions: int) -> list[jaxlie.SE3]:
    """True poses of each session, NumPy-backed, in the campus frame (z up)."""
    streets = sessions * poses * _STEP / _BLOCK
    blocks = max(2, round(np.sqrt(streets / 3.0)))
    grid = np.arange(blocks + 1.0)
    crossings = _BLOCK * np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1)
    crossings += _JITTER * generator.uniform(-1.0, 1.0, crossings.shape)
    ground = _rolling_ground(generator)
    shortest = _BLOCK - 2.0 * _JITTER - 2.0 * _ROUNDING
    count = 3 + int(np.ceil(poses * _STEP / shortest))
    # All sessions leave one garage by one street: they meet there at least.
    start = (np.full(2, blocks // 2), int(generator.integers(4)))
    paths = []
    for _ in range(sessions):
        places, _ = drive(generator, crossings=count, blocks=blocks, start=start)
        paths.append(_on_ground(_rounded(crossings[tuple(places.T)], poses), ground))
    return paths


def _rounded(corners: Float[np.ndarray, "c 2"], poses: int) -> Float[np.ndarray, "n 2"]:
    """Points `_STEP` apart along the polyline of `corners` with its corners rounded."""
    from scipy.ndimage import gaussian_filter1d

    fine = _resampled(corners, _FINE)
    return _resampled(gaussian_filter1d(fine, _ROUNDING / _FINE, axis=0), _STEP)[:poses]


def _resampled(points: Float[np.ndarray, "p 2"], step: float) -> Float[np.ndarray, "q 2"]:
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    places = np.arange(0.0, along[-1], step)
    return np.stack([np.interp(places, along, axis) for axis in points.T], axis=-1)


def _rolling_ground(generator: np.random.Generator) -> Ground:
    """Height and slope of a ground made of a few long waves."""
    direction = generator.uniform(0.0, 2.0 * np.pi, _WAVES)
    number = 2.0 * np.pi / generator.uniform(*_WAVELENGTHS, _WAVES)
    phase = generator.uniform(0.0, 2.0 * np.pi, _WAVES)
    waves = number * np.stack([np.cos(direction), np.sin(direction)])

    def ground(places: Float[np.ndarray, "n 2"]) -> tuple[np.ndarray, np.ndarray]:
        angle = places @ waves + phase
        return _AMPLITUDE * np.sin(angle).sum(axis=1), _AMPLITUDE * np.cos(angle) @ waves.T

    return ground


def _on_ground(places: Float[np.ndarray, "n 2"], ground: Ground) -> jaxlie.SE3:
    """Poses that look along the path (x forward) and stand upright on the ground (z its normal)."""
    height, slope = ground(places)
    ahead = np.gradient(places, axis=0)
    forward = np.concatenate([ahead, np.sum(slope * ahead, axis=1, keepdims=True)], axis=1)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    normal = np.concatenate([-slope, np.ones((len(places), 1))], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    matrix: Any = np.zeros((len(places), 4, 4))
    matrix[:, :3, 0], matrix[:, :3, 2] = forward, normal
    matrix[:, :3, 1] = np.cross(normal, forward)
    matrix[:, :2, 3], matrix[:, 2, 3], matrix[:, 3, 3] = places, height, 1.0
    return lie.from_matrix(matrix)
