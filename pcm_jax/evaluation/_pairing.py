"""Estimated poses and their true ones: robots by name or order, poses by time stamp or id."""

from __future__ import annotations

from typing import Any, NamedTuple

import jaxlie
import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.errors import InputError, check_number
from pcm_jax.graph import MultiRobotGraph, PoseGraph, symbols

FLAT = 1e-9  # metres, and parts of a unit quaternion, by which poses in a plane may leave it
Rows = Int[np.ndarray, " k"]


class Pairing(NamedTuple):
    """One robot's poses that have true ones.

    Attributes:
        robot: its name in the estimate.
        true_robot: its name in the truth.
        poses: how many the estimate has.
        by: "time stamp" or "id".
        estimate: NumPy-backed Lie `[k]`, in the order of the stamps or of the estimate.
        truth: likewise, row by row the true ones.
    """

    robot: str
    true_robot: str
    poses: int
    by: str
    estimate: Any
    truth: Any


def paired(estimate: Any, truth: Any, max_difference: float) -> tuple[tuple[Pairing, ...], str]:
    """Finds the true pose of each estimated one, and says by what robots were matched.

    Args:
        estimate: a `MultiRobotGraph`, a `PoseGraph` or a sequence of them.
        truth: likewise; of a graph that states true poses (`MultiRobotGraph.truth`), those.
        max_difference: seconds by which the stamps of one pose may differ.

    Returns:
        A pairing for each robot of the estimate; and "name" or "order".

    Raises:
        InputError: for other robots, poses of another group, or a robot without a matched pose.
    """
    check_number("max_difference", max_difference, least=0.0)
    given, true = _as_graph(estimate, "estimate"), _as_graph(truth, "truth")
    places, by = _places(given.names, true.names)
    sides = _of_one_group(_poses_of(given, ()), _poses_of(true, true.truth or ()))
    return tuple(
        _pairing(own, given.maps[robot], sides[1][place], true.maps[place], max_difference)
        for robot, (own, place) in enumerate(zip(sides[0], places, strict=True))
    ), by


def _as_graph(given: Any, argument: str) -> MultiRobotGraph:
    if isinstance(given, MultiRobotGraph):
        return given
    maps = (given,) if isinstance(given, PoseGraph) else given
    if not isinstance(maps, list | tuple) or not all(isinstance(one, PoseGraph) for one in maps):
        raise InputError(
            f"{argument}: {type(given).__name__} given, expected pose graphs, one for each robot"
        )
    return MultiRobotGraph(tuple(maps))


def _places(estimate: tuple[str, ...], truth: tuple[str, ...]) -> tuple[list[int], str]:
    """The true robot of each estimated one, and by what they were matched."""
    if set(estimate) <= set(truth):
        return [truth.index(name) for name in estimate], "name"
    if len(estimate) == len(truth) and not set(estimate) & set(truth):
        return list(range(len(truth))), "order"
    raise InputError(
        f"truth: {_counted(truth)} given, expected {_counted(estimate)} like the estimate"
    )


def _counted(names: tuple[str, ...]) -> str:
    return f"{len(names)} robot{'s' * (len(names) > 1)} ({', '.join(names)})"


def _poses_of(graph: MultiRobotGraph, stated: tuple[Any, ...]) -> list[Any]:
    """Each robot's poses: those stated to be true, else its map's."""
    known = [*stated, *[None] * (len(graph.maps) - len(stated))]
    return [
        lie.as_numpy(one.poses if true is None else true)
        for one, true in zip(graph.maps, known, strict=True)
    ]


def _of_one_group(estimate: list[Any], truth: list[Any]) -> tuple[list[Any], list[Any]]:
    """Both sides; SE(3) poses that all lie in a plane z = const become SE(2) beside SE(2)'s.

    Trajectory files know no plane: TUM's and KITTI's poses are in space.
    """
    groups = [lie.group_of(side[0]) for side in (estimate, truth)]
    if groups[0] is groups[1]:
        return estimate, truth
    sides = (
        _flattened(side, argument) if group is jaxlie.SE3 else side
        for side, group, argument in zip(
            (estimate, truth), groups, ("estimate", "truth"), strict=True
        )
    )
    first, second = sides
    return first, second


def _flattened(side: list[Any], argument: str) -> list[Any]:
    parameters = [np.asarray(lie.parameters(poses)) for poses in side]
    tilt = max(float(np.abs(one[:, 1:3]).max(initial=0.0)) for one in parameters)
    rise = max(float(np.ptp(one[:, 6])) for one in parameters)
    if tilt > FLAT or rise > FLAT:
        raise InputError(
            f"{argument}: SE3 poses that leave the plane given, expected SE2 like the other side's"
        )
    return [
        lie.from_components(jaxlie.SE2, (w * w - z * z, 2.0 * w * z, x, y))
        for w, _, _, z, x, y, _ in (one.T for one in parameters)
    ]


def _pairing(
    estimate: Any, one: PoseGraph, truth: Any, true: PoseGraph, max_difference: float
) -> Pairing:
    timed = all(side.stamps is not None and np.isfinite(side.stamps).any() for side in (one, true))
    if timed:
        own, other = _by_stamp(np.asarray(one.stamps), np.asarray(true.stamps), max_difference)
    else:
        own, other = _by_id(one.ids, true.ids)
    if not len(own):
        found = _spans(one.stamps, true.stamps) if timed else _spans(one.ids, true.ids)
        raise InputError(
            f"truth: no pose of robot {one.name!r} matches one of {true.name!r}, {found};"
            f" expected {f'stamps within {max_difference:g} s' if timed else 'equal ids'}"
        )
    rows = lie.take(estimate, own), lie.take(truth, other)
    return Pairing(one.name, true.name, one.num_poses, "time stamp" if timed else "id", *rows)


def _by_stamp(
    estimate: Float[np.ndarray, " n"], truth: Float[np.ndarray, " m"], max_difference: float
) -> tuple[Rows, Rows]:
    """Rows whose stamps are each other's nearest, at most so many seconds apart, as time goes."""
    own, other = (
        np.argsort(side, kind="stable")[: np.isfinite(side).sum()] for side in (estimate, truth)
    )
    there = _nearest(estimate[own], truth[other])
    back = _nearest(truth[other], estimate[own])
    mutual = back[there] == np.arange(len(own))
    close = np.abs(estimate[own] - truth[other][there]) <= max_difference
    return own[mutual & close], other[there[mutual & close]]


def _nearest(values: Float[np.ndarray, " n"], among: Float[np.ndarray, " m"]) -> Rows:
    """For each value the place of the nearest in an ascending array, of two the earlier."""
    after = np.clip(np.searchsorted(among, values), 0, len(among) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(values - among[before]) <= np.abs(among[after] - values), before, after)


def _by_id(estimate: Rows, truth: Rows) -> tuple[Rows, Rows]:
    """Rows of equal ids, in the estimate's order; of symbol keys the indices count, if need be."""
    if not np.isin(estimate, truth).any():
        estimate, truth = symbols.indices_of(estimate), symbols.indices_of(truth)
    _, own, other = np.intersect1d(estimate, truth, return_indices=True)
    order = np.argsort(own)
    return own[order], other[order]


def _spans(estimate: Any, truth: Any) -> str:
    """Both ranges in words."""
    stamps = np.asarray(estimate).dtype.kind == "f"
    values = [
        side if stamps else symbols.indices_of(np.asarray(side)) for side in (estimate, truth)
    ]
    low_high = [f"{np.nanmin(side)} to {np.nanmax(side)}" for side in values]
    return f"{'stamps' if stamps else 'ids'} {low_high[0]} against {low_high[1]}"
