"""Two maps of one city, their true closures, the truth, and versions with false closures added.

The city is a file's, or simulated. A version of the paper's experiment is 15 of the true closures,
two aliased groups of 5, and 90 random ones; `Law` says how the false ones are drawn.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcm_jax import lie
from pcm_jax.arrays import device_array
from pcm_jax.errors import InputError
from pcm_jax.files import read_graph
from pcm_jax.graph import MultiRobotGraph, PoseGraph, split
from pcm_jax.mapping import optimize
from pcm_jax.simulation import SimulatedWorld, add_clutter, simulate_city

NOISE = np.diag([0.02**2, 0.02**2, 0.01**2])
"""Covariance of every measurement in City10000, measured against its noise-free edges."""

_POOL = 60  # true closures of a simulated city, of which a version takes 15
# What makes it as sparse as the file's first 2,000 poses, which span 105 m with 338 loops: 20 x 20
# blocks of 5 m, and one loop a return (over the whole file it is nearly two).
_BLOCKS_SQUARED_PER_POSE = 0.2
_LOOPS_PER_RETURN = 1


class City(NamedTuple):
    """All that the versions of the experiment share.

    Attributes:
        graph: two maps at their own optima, each in its first pose's frame, so that nothing of
            their true alignment is left in them; all true closures between them.
        truth: true poses of each robot, in one frame.
    """

    graph: MultiRobotGraph
    truth: tuple[Any, ...]


class Law(NamedTuple):
    """The false closures' law, where it is not that of `pcm_jax.simulation.outliers`.

    Attributes:
        random_range: metres between the two poses of a random closure; None: the whole city.
        aliased_noise: times the true closures' noise, in those of the aliased groups.
        random_sigma: random closures claim standard deviations of 1 to so many times the true
            ones', log-uniform (the paper's random outliers of its 1-D world have random variances).
        random: how many random closures.
    """

    random_range: float | None = None
    aliased_noise: float = 1.0
    random_sigma: float = 1.0
    random: int = 90


def version_of(city: City, law: Law, seed: int, number: int) -> SimulatedWorld:
    """One version of the experiment."""
    generator = np.random.default_rng([seed, number])
    covariance = law.aliased_noise**2 * NOISE
    world = add_clutter(
        city.graph,
        city.truth,
        seed=generator,
        covariance=covariance,
        random=law.random,
        random_range=law.random_range,
    )
    if law.random_sigma == 1.0:
        return world
    closures = world.graph.closures
    claimed = law.random_sigma ** generator.random(len(closures))
    information = np.array(closures.information)
    information[world.labels < 0] /= claimed[world.labels < 0, None, None] ** 2
    clutter = dataclasses.replace(closures, information=device_array(information))
    return world._replace(graph=MultiRobotGraph(world.graph.maps, clutter))


def start_errors(world: SimulatedWorld) -> dict[str, float]:
    """Distances of closures from holding where robust methods start, with both first poses at one.

    Returns:
        Metres, the median over the closures of a kind: `true`, and `aliased`, of the aliased group
        that is nearest.
    """
    maps, closures = world.graph.maps, world.graph.closures
    first = maps[0].num_poses
    poses = lie.concatenate([lie.as_numpy(one.poses) for one in maps])
    tail, head = (
        lie.take(poses, np.asarray(pose) + first * np.asarray(robot))
        for robot, pose in (
            (closures.robot_a, closures.pose_a),
            (closures.robot_b, closures.pose_b),
        )
    )
    error = lie.between(lie.as_numpy(closures.measurement), lie.between(tail, head))
    metres = np.linalg.norm(lie.translation(error), axis=-1)
    groups = [np.median(metres[world.labels == label]) for label in set(world.labels) if label > 0]
    return {"true": float(np.median(metres[world.is_true])), "aliased": float(min(groups))}


def weakened(city: City, factor: float) -> City:
    """The city with all covariances multiplied: the same optima, q² divided."""
    maps = tuple(_with_information(one, lambda known: known / factor) for one in city.graph.maps)
    closures = _with_information(city.graph.closures, lambda known: known / factor)
    return city._replace(graph=MultiRobotGraph(maps, closures))


def city10000(
    folder: Path, poses: int = 2_000, information: str = "as-written", *, seed: int = 1
) -> City:
    """Cuts the first poses of City10000 in two; without its file, a simulated city as sparse.

        graph, truth = city10000(Path("data/city10000"))

    Args:
        folder: with `city10000.g2o.xz` and `city10000_groundtruth.isam.txt.xz` in it, or not.
        poses: of both maps together.
        information: "as-written" or "sqrt", see `read_graph`.
        seed: of the simulated city.
    """
    data = folder / "city10000.g2o.xz"
    if not data.is_file():
        return simulated_city(poses, seed, information)
    truth = folder / "city10000_groundtruth.isam.txt.xz"
    return city_of_file(data, truth, slice(poses), information)


def city_of_file(data: Path, truth: Path, poses: slice, information: str) -> City:
    """The poses of a file from `start` to `stop`, cut in the middle.

    Args:
        data: a pose graph of one robot.
        truth: its noise-free edges, chained to the true poses.
        poses: the portion.
        information: "as-written" or "sqrt", see `read_graph`.
    """
    (whole,) = read_graph(data, information=information).maps
    (exact,) = read_graph(truth).maps
    start, stop, _ = poses.indices(whole.num_poses)
    if exact.num_poses != whole.num_poses or stop - start < 4:
        raise InputError(
            f"poses: {start}:{stop} of {whole.num_poses} ({exact.num_poses} in the truth) given, "
            "expected at least 4, and as many true poses"
        )
    middle = (stop - start) // 2
    true = lie.as_numpy(exact.poses)
    parts = (slice(start, start + middle), slice(start + middle, stop))
    graph = split(_portion(whole, start, stop), middle)
    return _prepared(graph, tuple(lie.take(true, part) for part in parts))


def simulated_city(poses: int, seed: int, information: str) -> City:
    """A simulated city of so many poses in all, about as sparse as the portion of City10000.

    Its calibrated information is diag(2500, 2500, 10000); "as-written" takes the square root of
    it, as if read from City10000's file.
    """
    blocks = max(2, round(np.sqrt(_BLOCKS_SQUARED_PER_POSE * poses)))
    counts = {"inliers": _POOL, "aliased_groups": 0, "random": 0}
    extent = {"blocks": blocks, "loops_per_return": _LOOPS_PER_RETURN}
    world = simulate_city(seed=seed, poses=poses // 2, **extent, **counts)
    graph = world.graph
    if information == "as-written":
        maps = tuple(_with_information(one, np.sqrt) for one in graph.maps)
        graph = MultiRobotGraph(maps, _with_information(graph.closures, np.sqrt))
    return _prepared(graph, world.truth)


def _portion(graph: PoseGraph, start: int, stop: int) -> PoseGraph:
    cuts = [cut for cut in (start, stop) if 0 < cut < graph.num_poses]
    return split(graph, cuts).maps[int(start > 0)] if cuts else graph


def _with_information(edges: Any, change: Callable[[np.ndarray], np.ndarray]) -> Any:
    """Edges with other information; a root is taken entry by entry, as diagonal matrices allow."""
    information = change(np.asarray(edges.information))
    return dataclasses.replace(edges, information=device_array(information))


def _prepared(graph: MultiRobotGraph, truth: tuple[Any, ...]) -> City:
    maps = []
    for one in graph.maps:
        best = lie.as_numpy(optimize(one).graph.poses)
        own = lie.compose(lie.inverse(lie.take(best, 0)), best)
        maps.append(one.with_poses(lie.as_device(own)))
    return City(MultiRobotGraph(tuple(maps), graph.closures), truth)
