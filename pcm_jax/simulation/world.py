"""The result of a simulation, and clutter for maps whose truth is known."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph
from pcm_jax.graph.multi_robot import letter_names
from pcm_jax.simulation.measurements import measure, near_pairs, revisits
from pcm_jax.simulation.outliers import false_closures


class SimulatedWorld(NamedTuple):
    """Maps, candidate closures between them, and the truth about both.

    Attributes:
        graph: the robots' maps, each at its raw odometry in its own frame (first pose the
            identity), and the candidate closures in shuffled order.
        is_true: bool `[m]`, which closures are true.
        labels: int64 `[m]`: 0 true; 1, 2, … the aliased group; -1 random.
        truth: true poses of each robot in one common frame, NumPy-backed Lie `[n]`.
    """

    graph: MultiRobotGraph
    is_true: Bool[np.ndarray, " m"]
    labels: Int[np.ndarray, " m"]
    truth: tuple[Any, ...]


def add_clutter(
    graph: MultiRobotGraph,
    truth: Sequence[Any],
    *,
    seed: int | np.random.Generator = 0,
    inliers: int | None = 15,
    aliased_groups: int = 2,
    aliased_size: int = 5,
    random: int = 90,
    random_range: float | None = None,
    reach: float = 3.0,
    covariance: Float[np.ndarray, "d d"] | None = None,
    information: Float[np.ndarray, "d d"] | None = None,
) -> SimulatedWorld:
    """Keeps some of a graph's closures, all of them true, and adds false ones to them.

    One version of the paper's City10000 experiment, from the graph that `split` makes of it. The
    counts are for each pair of robots; `pcm_jax.simulation.outliers` states the outliers' law.

    Args:
        graph: maps and true closures only.
        truth: true poses of each robot in one common frame, `jaxlie.SE2` or `SE3` `[n]`.
        seed: of `numpy.random.default_rng`.
        inliers: true closures to keep, drawn at random; None keeps all of them.
        aliased_groups: groups of false closures that agree among themselves.
        aliased_size: closures in each group.
        random: false closures that agree with nothing.
        random_range: metres between the two poses of a random closure; None: the whole map.
        reach: metres between two poses that can be mistaken for each other.
        covariance: noise that the aliased closures are drawn with, right perturbation, m² and
            rad². By default the inverse of the information recorded; to be given for files whose
            information is not that of their noise (City10000).
        information: what is recorded for every false closure. By default that of a true closure
            of the same pair of robots, drawn at random, and pairs without any get no clutter.

    Raises:
        InputError: fewer true closures between a pair of robots than are to be kept, poses of
            another number than the maps', or a negative count.
    """
    require_at_least(
        0, aliased_groups=aliased_groups, aliased_size=aliased_size, random=random, reach=reach
    )
    truth = _matching_truth(graph, truth)
    generator = np.random.default_rng(seed)
    every_pair = list(combinations(range(len(graph.maps)), 2))
    parts, labels = [LoopClosures.empty(graph.group)], [np.zeros(0, np.int64)]
    for rank, (a, b) in enumerate(graph.closures.pairs() if information is None else every_pair):
        available, _ = graph.closures.between(a, b)
        genuine = available[_choice(generator, len(available), inliers, (a, b))]
        stated = np.asarray(available.information) if information is None else information[None]
        count = aliased_groups * aliased_size + random
        recorded = stated[generator.integers(len(stated), size=count)]
        false = false_closures(
            generator,
            truth[a],
            truth[b],
            groups=aliased_groups,
            size=aliased_size,
            first_label=1 + rank * aliased_groups,
            random=random,
            random_range=random_range,
            reach=reach,
            covariance=np.linalg.inv(recorded) if covariance is None else covariance[None],
        )
        parts += [genuine, _closures((a, b), false.poses, false.measurement, recorded)]
        labels += [np.zeros(len(genuine), np.int64), false.labels]
    label = np.concatenate(labels)
    order = generator.permutation(len(label))
    cluttered = MultiRobotGraph(graph.maps, LoopClosures.concatenate(parts)[order])
    return SimulatedWorld(cluttered, label[order] == 0, label[order], truth)


def drive_and_measure(
    generator: np.random.Generator,
    truth: Sequence[Any],
    *,
    spot: float,
    loops_per_return: int,
    odometry: Float[np.ndarray, "d d"],
    closure: Float[np.ndarray, "d d"],
    inliers: int,
    reach: float,
    **clutter: Any,
) -> SimulatedWorld:
    """The world of some true paths: noisy maps, true closures between them, and clutter.

    Args:
        generator: source of randomness.
        truth: true poses of each robot in one common frame, NumPy-backed Lie `[n]`.
        spot: metres within which a robot is back at a place (see `revisits`).
        loops_per_return: loop closures that a robot makes there at most.
        odometry: covariance of an odometry step.
        closure: covariance of a closure, inside a map or between two.
        inliers: true closures between each two robots.
        reach: metres between two poses that can measure each other.
        **clutter: `aliased_groups`, `aliased_size`, `random` and `random_range` of `add_clutter`.

    Raises:
        InputError: robots that pass each other too seldom.
    """
    maps = []
    for path, name in zip(truth, letter_names(), strict=False):
        places = lie.translation(path)
        loops = revisits(generator, places, spot=spot, reach=reach, most=loops_per_return)
        noise = {"odometry": odometry, "closures": closure}
        maps.append(noisy_map(generator, path, loops, **noise, name=name))
    closures = true_closures(generator, truth, count=inliers, reach=reach, covariance=closure)
    return add_clutter(
        MultiRobotGraph(tuple(maps), closures),
        truth,
        seed=generator,
        inliers=None,
        reach=reach,
        information=np.linalg.inv(closure),
        **clutter,
    )


def true_closures(
    generator: np.random.Generator,
    truth: Sequence[Any],
    *,
    count: int,
    reach: float,
    covariance: Float[np.ndarray, "d d"],
) -> LoopClosures:
    """`count` measurements between each two robots, at random poses that are near each other.

    Raises:
        InputError: two robots' paths have fewer pose pairs within `reach`.
    """
    parts = [LoopClosures.empty(lie.group_of(truth[0]))]
    for a, b in combinations(range(len(truth)), 2):
        pairs = near_pairs(lie.translation(truth[a]), lie.translation(truth[b]), reach)
        if len(pairs) < count:
            raise InputError(
                f"inliers: {count} asked for, but robots {a} and {b} have only {len(pairs)} pairs "
                f"of poses within {reach:g} m; expected fewer inliers, more poses or a smaller map"
            )
        pose_a, pose_b = generator.choice(pairs, size=count, replace=False).T
        exact = lie.between(lie.take(truth[a], pose_a), lie.take(truth[b], pose_b))
        measurement = measure(generator, exact, covariance)
        information = np.broadcast_to(np.linalg.inv(covariance), (count, *covariance.shape))
        parts.append(_closures((a, b), (pose_a, pose_b), measurement, information))
    return LoopClosures.concatenate(parts)


def noisy_map(
    generator: np.random.Generator,
    truth: Any,
    loops: Int[np.ndarray, "l 2"],
    *,
    odometry: Float[np.ndarray, "d d"],
    closures: Float[np.ndarray, "d d"],
    name: str,
) -> PoseGraph:
    """A map with measured odometry and loop closures, its poses chained from the odometry alone.

    Args:
        generator: source of randomness.
        truth: true poses, NumPy-backed Lie `[n]`.
        loops: pose pairs with a loop closure.
        odometry: covariance of an odometry step.
        closures: covariance of a loop closure.
        name: the robot's name.
    """
    steps = np.arange(len(lie.parameters(truth)) - 1)
    tail, head = np.concatenate([np.stack([steps, steps + 1], axis=-1), loops]).T
    covariance = np.repeat([odometry, closures], [len(steps), len(loops)], axis=0)
    exact = lie.between(lie.take(truth, tail), lie.take(truth, head))
    return PoseGraph.from_arrays(
        tail=tail,
        head=head,
        measurement=measure(generator, exact, covariance),
        covariance=covariance,
        name=name,
    )


def require_at_least(least: float, **values: float) -> None:
    """Raises `InputError` naming the first argument that is below `least`."""
    for argument, value in values.items():
        if not value >= least:
            raise InputError(f"{argument}: {value} given, expected at least {least:g}")


def require_positive(**values: float) -> None:
    """Raises `InputError` naming the first argument that is not above zero."""
    for argument, value in values.items():
        if not value > 0:
            raise InputError(f"{argument}: {value} given, expected a number above 0")


def _closures(
    pair: tuple[int, int],
    poses: tuple[np.ndarray, np.ndarray],
    measurement: Any,
    information: np.ndarray,
) -> LoopClosures:
    return LoopClosures.from_arrays(
        robot_a=np.full(len(information), pair[0]),
        pose_a=poses[0],
        robot_b=np.full(len(information), pair[1]),
        pose_b=poses[1],
        measurement=measurement,
        information=information,
    )


def _choice(
    generator: np.random.Generator, available: int, count: int | None, pair: tuple[int, int]
) -> Int[np.ndarray, " c"]:
    if count is None:
        return np.arange(available)
    if not 0 <= count <= available:
        raise InputError(
            f"inliers: {count} asked for, expected 0 to {available}, the number of closures "
            f"between robots {pair[0]} and {pair[1]}"
        )
    return generator.choice(available, size=count, replace=False)


def _matching_truth(graph: MultiRobotGraph, truth: Sequence[Any]) -> tuple[Any, ...]:
    sizes = [len(lie.parameters(poses)) for poses in truth]
    expected = [robot.num_poses for robot in graph.maps]
    if sizes != expected:
        raise InputError(f"truth: {sizes} poses given, expected {expected} as in the maps")
    return tuple(lie.as_numpy(poses) for poses in truth)
