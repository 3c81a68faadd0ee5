"""Maps that grow: new poses and edges, checked, and joined to those that are there."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.arrays import as_real
from pcm_jax.errors import InputError
from pcm_jax.graph import PoseGraph, checked
from pcm_jax.graph.spanning_tree import check_connected
from pcm_jax.graph.validation import argument_fault, as_indices, check_self_loops, raise_first
from pcm_jax.mapping import MapCovariance
from pcm_jax.mapping.first_order import first_step
from pcm_jax.mapping.least_squares import RTOL
from pcm_jax.mapping.optimization import problem_of
from pcm_jax.online._room import Room
from pcm_jax.pipeline.weigh import optimized_maps

SHARE = 0.1
"""Of the tolerance at which `optimize` stops: what a last step may still change."""


@dataclasses.dataclass(frozen=True)
class NewPart:
    """Poses and edges to be joined to a map of n poses.

    Attributes:
        count: new poses, n … n + count − 1.
        poses: Lie `[count]` as given, or None: where the edges put them.
        tail: int32 `[e]`.
        head: int32 `[e]`.
        measurement: NumPy-backed Lie `[e]`.
        information: `[e, d, d]`.
        ids: int64 `[count]`.
        stamps: float64 `[count]`, NaN without times.
    """

    count: int
    poses: Any
    tail: Int[np.ndarray, " e"]
    head: Int[np.ndarray, " e"]
    measurement: Any
    information: Float[np.ndarray, "e d d"]
    ids: Int[np.ndarray, " count"]
    stamps: Float[np.ndarray, " count"]

    def is_odometry(self, size: int) -> bool:
        """True for one edge from each pose of a map of that size to the next new one."""
        low, high = np.minimum(self.tail, self.head), np.maximum(self.tail, self.head)
        steps = size + np.arange(self.count)
        return np.array_equal(high, steps) and np.array_equal(low, steps - 1)


def robot_index(robot: Any, names: Sequence[str]) -> int:
    """The index of a robot by index or name; `InputError` for one that does not exist."""
    if isinstance(robot, str) and robot in names:
        return names.index(robot)
    whole: Any = isinstance(robot, int | np.integer) and not isinstance(robot, bool)
    index = int(robot) if whole else -1
    if not 0 <= index < len(names):
        raise InputError(
            f"robot: {robot!r} given, expected 0 … {len(names) - 1} or one of {', '.join(names)}"
        )
    return index


def check_name(index: int, name: Any, names: Sequence[str]) -> None:
    """Raises `InputError` for a robot's new name that is empty, none, or another robot's."""
    taken = [one for robot, one in enumerate(names) if robot != index]
    if not isinstance(name, str) or not name or name in taken:
        raise InputError(f"name: {name!r} given, expected one that no other robot has")


def checked_part(
    pose_graph: PoseGraph,
    poses: Any,
    *,
    measurement: Any,
    information: Any = None,
    covariance: Any = None,
    tail: Any = None,
    head: Any = None,
    ids: Any = None,
    stamps: Any = None,
    tangent_order: str = "translation-rotation",
) -> NewPart:
    """Checks poses and edges that are to be joined to a map; see `IncrementalPcm.extend`.

    Raises:
        InputError: as `PoseGraph.from_arrays`; for a pose that no edge joins to the map, an id that
            is taken, a stamp before the one before it.
    """
    size = pose_graph.num_poses
    edges: Any = checked.as_transforms(measurement, "measurement")
    _check_group(pose_graph, edges, "measurement")
    rows = len(lie.parameters(edges))
    given = None if poses is None else checked.as_transforms(poses, "poses")
    if given is not None:
        _check_group(pose_graph, given, "poses")
    if (tail is None) != (head is None):
        raise InputError("tail, head: give both, or neither for odometry from the last pose on")
    if tail is None:
        tail, head = size - 1 + np.arange(rows), size + np.arange(rows)
    known = None if given is None else size + len(lie.parameters(given))
    tail, head = (
        as_indices(ends, known, name, "poses") for name, ends in (("tail", tail), ("head", head))
    )
    for name, ends in (("tail", tail), ("head", head)):
        if len(ends) != rows:
            raise InputError(
                f"{name}: {len(ends)} entries given, expected {rows}, one per measurement"
            )
    check_self_loops(tail, head, argument_fault("head"))
    count = max(0, int(max(tail.max(initial=0), head.max(initial=0))) + 1 - size)
    count = count if known is None else known - size
    part = NewPart(
        count=count,
        poses=given,
        tail=tail,
        head=head,
        measurement=edges,
        information=checked.as_information(information, covariance, edges, tangent_order),
        ids=_ids(pose_graph, ids, count),
        stamps=_stamps(pose_graph, stamps, count),
    )
    if not part.is_odometry(size):
        tails, heads = (np.concatenate(ends) for ends in _ends(pose_graph, part))
        check_connected(tails, heads, size + count, ids=np.concatenate([pose_graph.ids, part.ids]))
    return part


def joined(pose_graph: PoseGraph, part: NewPart, room: Room, poses: Any = None) -> PoseGraph:
    """The map with a new part.

    Args:
        pose_graph: the map.
        part: new poses and edges.
        room: for its arrays to grow in.
        poses: where edges put the new ones, Lie, where that is known and they are not given.
    """
    stamps = pose_graph.stamps
    if stamps is not None or np.isfinite(part.stamps).any():
        before = np.full(pose_graph.num_poses, np.nan) if stamps is None else stamps
        stamps = room.behind("stamps", before, part.stamps)
    if part.poses is not None:
        poses = part.poses
    elif poses is None:
        (poses,) = _placed([pose_graph.poses], part)
    measured = room.transforms_behind("measurement", pose_graph.measurement, part.measurement)
    return dataclasses.replace(
        pose_graph,
        poses=room.transforms_behind("poses", pose_graph.poses, poses),
        tail=room.behind("tail", pose_graph.tail, part.tail),
        head=room.behind("head", pose_graph.head, part.head),
        measurement=measured,
        information=room.behind("information", pose_graph.information, part.information),
        ids=room.behind("ids", pose_graph.ids, part.ids),
        source=room.behind("source", pose_graph.source, np.full(len(part.tail), "", object)),
        stamps=stamps,
    )


def grown_by(
    given: PoseGraph, covariance: MapCovariance, new: NewPart, room: Room, *, settled: bool
) -> tuple[PoseGraph, MapCovariance, bool]:
    """Joins a new part to a map and to its optimum.

    Args:
        given: the map.
        covariance: of its optimum.
        new: the part.
        room: for the map's arrays to grow in.
        settled: whether maps are given at their optimum.

    Returns:
        the map, its covariance, and whether the part is odometry that moves nothing.

    Warns:
        ConvergenceWarning: where optimising the map stops before it converges.
    """
    old = covariance.pose_graph.poses
    behind, behind_given = _placed([old, given.poses], new)
    grown = joined(given, new, room, behind_given)
    placed = grown.with_poses(room.transforms_behind("placed", old, behind))
    odometry = new.is_odometry(given.num_poses) and not (settled and new.poses is not None)
    if odometry:
        return grown, covariance.extend(placed), True
    if settled:
        return grown, MapCovariance(grown, origin=covariance.origin), False
    optimum = _at_optimum(covariance, given.num_edges, placed)
    return grown, covariance.followed_by(optimum), False


def _at_optimum(covariance: MapCovariance, before: int, placed: PoseGraph) -> PoseGraph:
    """A map at its optimum, from where it is.

    By three steps and one factorisation: the first step with the factor of before, one of
    Gauss-Newton, and another with its factor, if the cost that this is to take away is well within
    the tolerance at which `optimize` stops. Otherwise `optimize` goes on from there.
    """
    with contextlib.suppress(InputError, np.linalg.LinAlgError):  # told when covariances are asked
        step = first_step(covariance.known, before, placed)
        if step is not None:
            problem = problem_of(placed)
            found = problem.step_twice(step)
            if 0.0 <= found.left <= SHARE * RTOL * found.cost:
                return placed.with_poses(found.poses)
            if found.cost < problem.cost(placed.poses):
                placed = placed.with_poses(found.halfway)
    return optimized_maps((placed,), False, initial="given")[0]


def _placed(old: Sequence[Any], part: NewPart) -> list[Any]:
    """The new poses where edges put them, each by the first edge that reaches it.

    Args:
        old: the map's poses, Lie `[n]` each, for any number of places that they have.
        part: what comes behind them.

    Returns:
        Lie `[count]` for each.
    """
    size = len(lie.parameters(old[0]))
    at: dict[int, Any] = {}

    def pose(index: int) -> Any:
        if index >= size:
            return at.get(index)
        return lie.as_numpy(lie.concatenate([lie.take(each, np.array([index])) for each in old]))

    left = list(range(len(part.tail)))
    while len(at) < part.count:
        waiting = []
        for row in left:
            tail, head = int(part.tail[row]), int(part.head[row])
            start, end = pose(tail), pose(head)
            step = lie.take(part.measurement, np.array([row]))
            if start is not None and end is None:
                at[head] = lie.compose(start, step)
            elif start is None and end is not None:
                at[tail] = lie.compose(end, lie.inverse(step))
            elif start is None:
                waiting.append(row)
        left = waiting
    if not at:
        return [lie.take(each, np.zeros(0, np.int64)) for each in old]
    placed = lie.normalize(lie.concatenate([at[size + k] for k in range(part.count)]))
    return [lie.take(placed, slice(place, None, len(old))) for place in range(len(old))]


def _ends(pose_graph: PoseGraph, part: NewPart) -> list[tuple[np.ndarray, np.ndarray]]:
    return [
        (np.asarray(pose_graph.tail), part.tail),
        (np.asarray(pose_graph.head), part.head),
    ]


def _check_group(pose_graph: PoseGraph, given: Any, argument: str) -> None:
    if lie.group_of(given) is not pose_graph.group:
        raise InputError(
            f"{argument}: {lie.group_of(given).__name__} given,"
            f" expected {pose_graph.group.__name__} like the map"
        )


def _ids(pose_graph: PoseGraph, ids: Any, count: int) -> Int[np.ndarray, " count"]:
    if ids is None:
        return int(pose_graph.ids.max()) + 1 + np.arange(count, dtype=np.int64)
    found = checked.as_ids(ids, count)
    taken = np.flatnonzero(np.isin(found, pose_graph.ids))
    if len(taken):
        raise InputError(f"ids[{taken[0]}]: {found[taken[0]]} is taken, expected a new id")
    return found


def _stamps(pose_graph: PoseGraph, stamps: Any, count: int) -> Float[np.ndarray, " count"]:
    if stamps is None:
        return np.full(count, np.nan)
    found = as_real(stamps, "stamps")
    if found.shape != (count,):
        raise InputError(f"stamps: shape {found.shape} given, expected ({count},), one per pose")
    known = pose_graph.stamps
    before = np.nan if known is None or not np.isfinite(known).any() else np.nanmax(known)
    earlier = np.fmax.accumulate(np.concatenate([[before], found]))[:-1]
    raise_first(
        found < earlier,
        argument_fault("stamps"),
        lambda row: f"{found[row]:.9g} s after {earlier[row]:.9g} s, expected them in order",
    )
    return found
