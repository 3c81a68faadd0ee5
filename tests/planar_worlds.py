"""Worlds in the plane, as maps of SE(2) and as the same maps of SE(3) with planar closures."""

import jaxlie
import numpy as np

from pcm_jax import lie
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph

PLANE = np.ix_([0, 1, 5], [0, 1, 5])
ODOMETRY, CLOSURE = np.array([0.05, 0.05, 0.02]), np.array([0.1, 0.1, 0.03])


def in_space(planar):
    """Transforms of SE(2) as those of SE(3) that move in the plane z = 0."""
    cos, sin, x, y = np.asarray(lie.parameters(planar)).T
    half, none = 0.5 * np.arctan2(sin, cos), np.zeros_like(x)
    return jaxlie.SE3(
        np.stack([np.cos(half), none, none, np.sin(half), x, y, none], axis=1)  # type: ignore
    )


def information_in_space(planar, rest=0.0):
    """The same information over (x, y, yaw) of six, `rest` of the others' diagonal."""
    information = np.zeros((len(planar), 6, 6))
    information[:, PLANE[0], PLANE[1]] = planar
    information[:, [2, 3, 4], [2, 3, 4]] = rest
    return information


def planar_world(seed, closures=12, poses=25, false=()):
    """One world as two graphs: of SE(2), and of SE(3) whose closures say x, y and yaw alone."""
    rng = np.random.default_rng(seed)
    true, flat, deep = [], [], []
    for name in "ab":
        step = np.stack([rng.uniform(0.5, 1.5, poses - 1), *rng.normal(0, 0.25, (2, poses - 1))], 1)
        exact = lie.exp(jaxlie.SE2, step)
        true.append(_chained(exact))
        measured = lie.compose(
            exact, lie.exp(jaxlie.SE2, rng.normal(size=(poses - 1, 3)) * ODOMETRY)
        )
        information = np.tile(np.diag(ODOMETRY**-2), (poses - 1, 1, 1))
        ends = {"tail": np.arange(poses - 1), "head": np.arange(1, poses), "name": name}
        placed = _chained(measured)
        flat.append(
            PoseGraph.from_arrays(
                poses=placed, measurement=measured, information=information, **ends
            )
        )
        deep.append(
            PoseGraph.from_arrays(
                poses=in_space(placed),
                measurement=in_space(measured),
                information=information_in_space(information, 900.0),
                **ends,
            )
        )
    ends = {
        "robot_a": np.zeros(closures, int),
        "pose_a": rng.integers(poses, size=closures),
        "robot_b": np.ones(closures, int),
        "pose_b": rng.integers(poses, size=closures),
    }
    between = lie.stack([lie.exp(jaxlie.SE2, np.array([3.0, 2.0, 0.7]))] * closures)
    start, end = lie.take(true[0], ends["pose_a"]), lie.take(true[1], ends["pose_b"])
    measured = lie.compose(lie.inverse(start), lie.compose(between, end))
    noise = rng.normal(size=(closures, 3)) * CLOSURE
    noise[list(false)] = rng.normal(size=(len(false), 3)) * [8.0, 8.0, 1.5]
    measured = lie.compose(measured, lie.exp(jaxlie.SE2, noise))
    information = np.tile(np.diag(CLOSURE**-2), (closures, 1, 1))
    return (
        MultiRobotGraph(
            tuple(flat),
            LoopClosures.from_arrays(measurement=measured, information=information, **ends),
        ),
        MultiRobotGraph(
            tuple(deep),
            LoopClosures.from_arrays(
                measurement=in_space(measured),
                information=information_in_space(information),
                **ends,
            ),
        ),
    )


def _chained(steps):
    """Poses `[n + 1]` from n steps, the first at the origin."""
    poses = [lie.identity(jaxlie.SE2)]
    for step in range(len(lie.parameters(steps))):
        poses.append(lie.compose(poses[-1], lie.take(steps, step)))
    return lie.stack(poses)
