"""Two maps of one city, the true closures between them, and the truth: a file's, or simulated."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcm_jax import InputError, MultiRobotGraph, PoseGraph, lie, optimize, read_graph, split
from pcm_jax.simulation import simulate_city

NOISE = np.diag([0.02**2, 0.02**2, 0.01**2])
"""Covariance of every measurement in City10000, measured against its noise-free edges."""

_POOL = 60  # true closures of a simulated city, of which a version takes 15
_BLOCKS_SQUARED_PER_POSE = 0.2  # 20 x 20 blocks for 2,000 poses


class City(NamedTuple):
    """What all versions of the experiment share.

    Attributes:
        graph: two maps at their own optima, each in its first pose's frame, so that nothing of
            their true alignment is left in them; all true closures between them.
        truth: true poses of each robot, in one frame.
    """

    graph: MultiRobotGraph
    truth: tuple[Any, ...]


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
    world = simulate_city(seed=seed, poses=poses // 2, blocks=blocks, **counts)
    graph = world.graph
    if information == "as-written":
        maps = tuple(_with_roots(one) for one in graph.maps)
        graph = MultiRobotGraph(maps, _with_roots(graph.closures))
    return _prepared(graph, world.truth)


def _portion(graph: PoseGraph, start: int, stop: int) -> PoseGraph:
    cuts = [cut for cut in (start, stop) if 0 < cut < graph.num_poses]
    return split(graph, cuts).maps[int(start > 0)] if cuts else graph


def _with_roots(edges: Any) -> Any:
    return dataclasses.replace(edges, information=np.sqrt(np.asarray(edges.information)))


def _prepared(graph: MultiRobotGraph, truth: tuple[Any, ...]) -> City:
    maps = []
    for one in graph.maps:
        best = lie.as_numpy(optimize(one).graph.poses)
        own = lie.compose(lie.inverse(lie.take(best, 0)), best)
        maps.append(one.with_poses(lie.as_device(own)))
    return City(MultiRobotGraph(tuple(maps), graph.closures), truth)
