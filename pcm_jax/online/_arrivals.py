"""Closures that come: those that state an earlier one again, and those whose poses are not there.

A closure's identity is its unordered pair of poses and its measurement up to inversion
(`graph.copies`): a repeated one counts once, however it is turned. One that touches a pose that has
not come yet waits in a queue of bounded length, and enters when it has.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from pcm_jax import lie
from pcm_jax.arrays import as_array
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures, PoseGraph
from pcm_jax.graph.copies import first_copies
from pcm_jax.graph.validation import argument_fault, raise_first

Key = tuple[int, int, int, int]
NEW = -2
"""A closure that was not met before."""
WAITS = -1
"""The name of closures that wait."""
PARTS = 256
"""Parts that are kept apart: few enough to be forgotten soon, many enough to be joined rarely."""


def ends_of(closures: LoopClosures) -> Int[np.ndarray, "m 4"]:
    """Robot and pose that each starts at, robot and pose that it ends at."""
    ends = closures.robot_a, closures.pose_a, closures.robot_b, closures.pose_b
    return np.stack([np.asarray(end, np.int64) for end in ends], axis=1)


def check_arrivals(maps: Sequence[PoseGraph], closures: LoopClosures) -> Bool[np.ndarray, " m"]:
    """Marks the closures whose poses are all there.

    Raises:
        InputError: for another group than the maps', a robot that does not exist, a closure from a
            robot to itself, a negative pose.
    """
    if closures.group is not maps[0].group:
        raise InputError(
            f"closures: {closures.group.__name__} given,"
            f" expected {maps[0].group.__name__} like the maps"
        )
    ends = ends_of(closures)
    for end, column in (("a", 0), ("b", 2)):
        robot, pose = ends[:, column], ends[:, column + 1]
        raise_first(
            (robot < 0) | (robot >= len(maps)),
            argument_fault(f"closures.robot_{end}"),
            lambda row, robot=robot: f"robot {robot[row]} of {len(maps)} does not exist",
        )
        raise_first(
            pose < 0,
            argument_fault(f"closures.pose_{end}"),
            lambda row, pose=pose: f"pose {pose[row]} given, expected at least 0",
        )
    raise_first(
        ends[:, 0] == ends[:, 2],
        argument_fault("closures.robot_b"),
        lambda row: f"closure from robot {ends[row, 0]} to itself, expected two robots",
    )
    return has_poses(maps, closures)


def has_poses(maps: Sequence[PoseGraph], closures: LoopClosures) -> Bool[np.ndarray, " m"]:
    """Marks the closures that touch no pose beyond the end of a map."""
    sizes, ends = np.array([one.num_poses for one in maps]), ends_of(closures)
    return (ends[:, 1] < sizes[ends[:, 0]]) & (ends[:, 3] < sizes[ends[:, 2]])


def check_queue(waiting: int, most: int) -> None:
    """Raises `InputError` for more closures that wait for poses than may."""
    if waiting > most:
        raise InputError(
            f"closures: {waiting} would wait for poses that have not come, expected at most {most}"
        )


def as_rows(indices: Any, count: int) -> Bool[np.ndarray, " m"]:
    """The mask of closures by index, each once, or by a mask.

    Raises:
        InputError: for an index that is not there or is given twice, a mask of another length.
    """
    chosen = as_array(indices, "indices")
    if chosen.dtype == bool:
        if chosen.shape != (count,):
            raise InputError(f"indices: shape {chosen.shape}, expected ({count},), one a closure")
        return chosen
    if chosen.ndim > 1 or (chosen.size and chosen.dtype.kind not in "iu"):
        raise InputError(f"indices: {chosen.dtype} {chosen.shape}, expected integers [r]")
    rows = np.atleast_1d(chosen).astype(np.int64)
    outside = rows[(rows < 0) | (rows >= count)]
    if outside.size:
        there = f"0 … {count - 1}" if count else "none, for there is no closure"
        raise InputError(f"indices: {outside[0]} given, expected {there}")
    values, times = np.unique(rows, return_counts=True)
    if (times > 1).any():
        raise InputError(f"indices: {values[times > 1][0]} given twice, expected each once")
    mask = np.zeros(count, bool)
    mask[rows] = True
    return mask


class Arrived:
    """Closures in the order in which they came, joined when they are asked for.

    Args:
        first: those to begin with.
    """

    def __init__(self, first: LoopClosures) -> None:
        self._parts, self._count = (first,), len(first)

    def __len__(self) -> int:
        return self._count

    @property
    def closures(self) -> LoopClosures:
        """All of them."""
        if len(self._parts) > 1:
            self._parts = (LoopClosures.concatenate(self._parts),)
        return self._parts[0]

    def with_more(self, closures: LoopClosures) -> Arrived:
        """These and further ones; these stay as they are."""
        more = Arrived(closures)
        more._parts, more._count = (*self._parts, closures), len(self) + len(closures)
        return more if len(more._parts) < PARTS else Arrived(more.closures)


class Identities:
    """The closures met so far by the poses they join, which tells whether one is stated again."""

    def __init__(self) -> None:
        self._at: dict[Key, list[tuple[int, LoopClosures, int]]] = {}

    def meet(self, closures: LoopClosures, name: Callable[[int], int]) -> Int[np.ndarray, " m"]:
        """Meets closures one after another: for each the row of the first that says the same.

        Args:
            closures: to be met.
            name: how a new one will be called, by its row here.

        Returns:
            `[m]`: `NEW`, or the name of the one that it states again.
        """
        found = np.full(len(closures), NEW)
        for row, key in enumerate(_keys(closures)):
            known = self._at.setdefault(key, [])
            if known:
                found[row] = _first(known, closures[[row]])
            if found[row] == NEW:
                known.append((name(row), closures, row))
        return found


class Named(NamedTuple):
    """Closures that come, by the names they get.

    Attributes:
        names: int64 `[m]`, of each; of one that is stated again that of the first.
        new: marks those that were not met before.
        met: all that are known now.
    """

    names: Int[np.ndarray, " m"]
    new: Bool[np.ndarray, " m"]
    met: Identities


def named(
    closures: LoopClosures,
    there: Bool[np.ndarray, " m"],
    held: int,
    known: Identities | None,
    met: Callable[[], Identities],
) -> Named:
    """Names closures that come: those that are new and whose poses are there from `held` on.

    Args:
        closures: that come.
        there: marks those whose poses are there; the others wait.
        held: how many there are.
        known: those met so far, which is used up; None where it is not at hand.
        met: finds those anew.
    """
    known = known or met()
    future = np.where(there, held + np.cumsum(there) - 1, WAITS)
    again = known.meet(closures, lambda row: int(future[row]))
    new = again == NEW
    if not new.all():  # those behind a repeated one get other names
        known = met()
        future[new & there] = held + np.arange(int((new & there).sum()))
        again = known.meet(closures, lambda row: int(future[row]))
    return Named(np.where(new, future, again), new, known)


def _first(known: list[tuple[int, LoopClosures, int]], one: LoopClosures) -> int:
    together = LoopClosures.concatenate([*(part[[at]] for _, part, at in known), one])
    found = first_copies(
        ends_of(together), lie.as_numpy(together.measurement), np.asarray(together.information)
    )
    return NEW if found[-1] == len(known) else known[int(found[-1])][0]


def _keys(closures: LoopClosures) -> list[Key]:
    ends = ends_of(closures)
    turned = (ends[:, 0] > ends[:, 2]) | ((ends[:, 0] == ends[:, 2]) & (ends[:, 1] > ends[:, 3]))
    return list(map(tuple, np.where(turned[:, None], ends[:, [2, 3, 0, 1]], ends).tolist()))
