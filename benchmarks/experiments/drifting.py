"""Worlds whose maps drift more or less and have more or fewer loops, with outliers that are hard.

The paths are those of `simulate_city` (SE(2)) and `simulate_sessions` (SE(3)); the odometry's noise
is scaled by the drift, and a share of the loop closures inside the maps is kept. Candidates between
the two robots: right ones; the paper's outliers, aliased groups with a wrong alignment anywhere and
random ones; and some that take one place for the next, `NEXT_PLACE` further along the street, with
the inliers' noise. All noise is that of the recorded information.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jaxlie
import numpy as np
from jaxtyping import Bool, Float

from pcm_jax import LoopClosures, MultiRobotGraph, PoseGraph, lie, optimize
from pcm_jax.simulation import SimulatedWorld, simulate_city, simulate_sessions
from pcm_jax.simulation.measurements import diagonal_covariance, measure, near_pairs
from pcm_jax.simulation.world import drive_and_measure

NEXT_PLACE = 5.0  # m: a street, or a bay, further on
REACH = 3.0  # m between poses that can measure each other, or be mistaken for it
RIGHT, NEXT = 15, 5  # candidates: right ones, and such that take a place for the next
FALSE = {"aliased_groups": 2, "aliased_size": 5, "random": 90}


class Kind(NamedTuple):
    """Worlds of one kind.

    Attributes:
        simulate: gives the true paths.
        poses: of each map.
        odometry, closure: deviations of an odometry step at drift 1 and of a closure, m and rad.
        spot, loops: as `drive_and_measure`'s `spot` and `loops_per_return`.
        drifts: scales of the odometry's noise; the sweep of them keeps `share`.
        shares: of the loop closures that are kept; the sweep of them keeps `drift`.
        share, drift: where the other is swept.
    """

    simulate: Any
    group: Any
    poses: int
    odometry: tuple[float, float]
    closure: tuple[float, float]
    spot: float
    loops: int
    share: float
    drift: float
    drifts: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 6.0)
    shares: tuple[float, ...] = (0.0, 0.03, 0.1, 0.3, 1.0)


CITY = Kind(simulate_city, jaxlie.SE2, 400, (0.02, 0.01), (0.02, 0.01), 0.5, 2, 0.1, 2.0)
SESSIONS = Kind(simulate_sessions, jaxlie.SE3, 500, (0.05, 0.005), (0.1, 0.017), 2.0, 4, 0.3, 2.0)
KINDS = {"city": CITY, "sessions": SESSIONS}


class Point(NamedTuple):
    """A place in one of the sweeps."""

    drift: float
    share: float


class Candidates(NamedTuple):
    """A world with its maps optimised: which closures are right, and which the next place's."""

    graph: MultiRobotGraph
    truth: tuple[Any, ...]
    right: Bool[np.ndarray, " m"]
    next_place: Bool[np.ndarray, " m"]


def points(kind: Kind) -> list[Point]:
    """All places in the two sweeps, once each."""
    sweeps = [Point(drift, kind.share) for drift in kind.drifts]
    return list(dict.fromkeys([*sweeps, *(Point(kind.drift, share) for share in kind.shares)]))


def candidates(kind: Kind, point: Point, seed: int, number: int) -> Candidates:
    """The world of a number: the same paths and closures at every point, more or less noisy."""
    own = np.random.SeedSequence([seed, number])
    generator, thinning, aliasing = map(np.random.default_rng, own.spawn(3))
    paths = kind.simulate(
        seed=generator, poses=kind.poses, inliers=0, aliased_groups=0, random=0
    ).truth
    closure = diagonal_covariance(kind.group, *kind.closure)
    world = drive_and_measure(
        generator,
        paths,
        spot=kind.spot,
        loops_per_return=kind.loops,
        odometry=point.drift**2 * diagonal_covariance(kind.group, *kind.odometry),
        closure=closure,
        inliers=RIGHT,
        reach=REACH,
        random_range=None,
        **FALSE,
    )
    maps = [
        one.with_edges(odometry(one) | (thinning.random(one.num_edges) < point.share))
        for one in world.graph.maps
    ]
    closures = _with_next_place(aliasing, world, closure)
    graph = MultiRobotGraph(tuple(optimize(one).graph for one in maps), closures)
    right = np.append(world.is_true, np.zeros(NEXT, bool))
    return Candidates(graph, world.truth, right, np.arange(len(right)) >= len(world.is_true))


def odometry(one: PoseGraph) -> Bool[np.ndarray, " e"]:
    """Marks the edges that join a pose to the next."""
    return np.asarray(one.head) - np.asarray(one.tail) == 1


def _with_next_place(
    generator: np.random.Generator, world: SimulatedWorld, covariance: Float[np.ndarray, "d d"]
) -> LoopClosures:
    """The world's closures, then those that take one place for the next along a street."""
    closures, (truth_a, truth_b) = world.graph.closures, world.truth
    met = generator.choice(np.asarray(closures.pose_a)[world.is_true])
    ahead = lie.as_matrix(lie.take(truth_a, met))[:-1, 0]  # x is forward
    tangent: Any = np.zeros(lie.tangent_dim(lie.group_of(truth_a)))
    tangent[: len(ahead)] = NEXT_PLACE * ahead
    moved = lie.compose(lie.exp(lie.group_of(truth_a), tangent), truth_b)
    pairs = near_pairs(lie.translation(truth_a), lie.translation(moved), REACH)
    pose_a, pose_b = generator.choice(pairs, NEXT, replace=len(pairs) < NEXT).T
    exact = lie.between(lie.take(truth_a, pose_a), lie.take(moved, pose_b))
    measured = [lie.as_numpy(closures.measurement), measure(generator, exact, covariance)]
    information = np.repeat(np.linalg.inv(covariance)[None], NEXT, axis=0)
    return LoopClosures.from_arrays(
        robot_a=np.append(closures.robot_a, np.zeros(NEXT, int)),
        pose_a=np.append(closures.pose_a, pose_a),
        robot_b=np.append(closures.robot_b, np.ones(NEXT, int)),
        pose_b=np.append(closures.pose_b, pose_b),
        measurement=lie.concatenate(measured),
        information=np.concatenate([np.asarray(closures.information), information]),
    )
