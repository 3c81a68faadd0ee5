"""The usual mistakes in candidate closures, undone: each gives the closures as they may be meant.

Only what was made of the closures is doubted, not the maps: a map in the same wrong convention is
wrong by itself, before any closure. A mistake is undone for closures that all run from map a to map
b; those that it would attach to a pose that is not there are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from pcm_jax import lie
from pcm_jax.graph import LoopClosures, PoseGraph
from pcm_jax.graph.symbols import indices_of

FARTHEST = 10
"""Poses by which ids, or time stamps, are tried to be shifted."""
Maps = tuple[PoseGraph, PoseGraph]


class Mistake(NamedTuple):
    """A way in which closures may have been written or read.

    Attributes:
        name: short.
        words: what the closures' authors may have meant, to be read after "if".
        undo: the closures as they are meant then.
    """

    name: str
    words: str
    undo: Callable[[Maps, LoopClosures], LoopClosures]


def mistakes(group: type[Any]) -> Iterator[Mistake]:
    """The mistakes that need nothing to be solved for, the most usual ones first."""
    yield Mistake("inverted", "each measurement is the pose of a seen from b", _inverted)
    yield Mistake("robots swapped", "the two robots are swapped", _robots_swapped)
    yield Mistake("ids swapped", "the ids of the two robots are swapped", _ids_swapped)
    yield Mistake("rotation inverted", "rotations turn the other way", _rotation_inverted)
    if lie.tangent_dim(group) == 6:
        for name, shift in (("w x y z", -1), ("x y z w", 1)):
            yield Mistake("quaternion order", f"quaternions are written {name}", _quaternion(shift))
    yield Mistake("tangent order", "information has rotation before translation", _rotation_before)
    yield from _shifts()


def _shifts() -> Iterator[Mistake]:
    ones = [(i, k) for i in (0, -1, 1) for k in (0, -1, 1) if i or k]
    for by_a, by_b in ones:
        yield Mistake("ids off by one", f"{_by(by_a, by_b)}", _shifted(by_a, by_b))
    for far in range(2, FARTHEST + 1):
        for by in (far, -far):
            for by_a, by_b in ((by, 0), (0, by), (by, by)):
                words = f"{_by(by_a, by_b)} (are time stamps shifted?)"
                yield Mistake("shifted", words, _shifted(by_a, by_b))


def _by(by_a: int, by_b: int) -> str:
    told = [f"{name}'s ids are meant {by:+d}" for name, by in (("a", by_a), ("b", by_b)) if by]
    return " and ".join(told)


def _inverted(_: Maps, closures: LoopClosures) -> LoopClosures:
    ends = closures.robot_b, closures.pose_b, closures.robot_a, closures.pose_a
    return _turned_back(closures, _with(closures, ends=ends))


def _robots_swapped(maps: Maps, closures: LoopClosures) -> LoopClosures:
    known, in_b, in_a = _exchanged(maps, closures)
    kept = closures[known]
    return _turned_back(kept, _with(kept, ends=(kept.robot_b, in_b, kept.robot_a, in_a)))


def _ids_swapped(maps: Maps, closures: LoopClosures) -> LoopClosures:
    known, in_b, in_a = _exchanged(maps, closures)
    kept = closures[known]
    return _with(kept, ends=(kept.robot_a, in_a, kept.robot_b, in_b))


def _exchanged(
    maps: Maps, closures: LoopClosures
) -> tuple[Int[np.ndarray, " r"], Int[np.ndarray, " r"], Int[np.ndarray, " r"]]:
    """The closures whose ids the other robot has too: rows, a's poses in map b, b's in map a."""
    numbers = [indices_of(one.ids) for one in maps]
    place = [{int(number): at for at, number in enumerate(own)} for own in numbers]
    of_a = numbers[0][np.asarray(closures.pose_a)].tolist()
    of_b = numbers[1][np.asarray(closures.pose_b)].tolist()
    both = [(place[1].get(i, -1), place[0].get(k, -1)) for i, k in zip(of_a, of_b, strict=True)]
    found = np.array(both, np.int64).reshape(-1, 2)
    known = np.flatnonzero((found >= 0).all(axis=1))
    return known, found[known, 0], found[known, 1]


def _rotation_inverted(_: Maps, closures: LoopClosures) -> LoopClosures:
    values = np.array(lie.parameters(lie.as_numpy(closures.measurement)))
    turn = slice(1, 2) if values.shape[1] == 4 else slice(1, 4)
    values[:, turn] *= -1.0
    return _with(closures, measurement=closures.group(values))


def _quaternion(shift: int) -> Callable[[Maps, LoopClosures], LoopClosures]:
    def undo(_: Maps, closures: LoopClosures) -> LoopClosures:
        values = np.array(lie.parameters(lie.as_numpy(closures.measurement)))
        values[:, :4] = np.roll(values[:, :4], shift, axis=1)
        return _with(closures, measurement=closures.group(values))

    return undo


def _rotation_before(_: Maps, closures: LoopClosures) -> LoopClosures:
    information = np.asarray(closures.information)
    order = np.roll(np.arange(information.shape[1]), 2 if information.shape[1] == 3 else 3)
    return _with(closures, information=information[:, order][:, :, order])


def _shifted(by_a: int, by_b: int) -> Callable[[Maps, LoopClosures], LoopClosures]:
    def undo(maps: Maps, closures: LoopClosures) -> LoopClosures:
        pose_a, pose_b = np.asarray(closures.pose_a) + by_a, np.asarray(closures.pose_b) + by_b
        known = (pose_a >= 0) & (pose_a < maps[0].num_poses)
        known &= (pose_b >= 0) & (pose_b < maps[1].num_poses)
        kept = closures[np.flatnonzero(known)]
        return _with(kept, ends=(kept.robot_a, pose_a[known], kept.robot_b, pose_b[known]))

    return undo


def with_measurement(closures: LoopClosures, measurement: Any) -> LoopClosures:
    """The same closures with other measurements."""
    return _with(closures, measurement=measurement)


def _with(
    closures: LoopClosures, ends: Any = None, measurement: Any = None, information: Any = None
) -> LoopClosures:
    own = closures.robot_a, closures.pose_a, closures.robot_b, closures.pose_b
    return LoopClosures.from_checked(
        tuple(np.asarray(end, np.int32) for end in (own if ends is None else ends)),
        lie.as_numpy(closures.measurement if measurement is None else measurement),
        np.asarray(closures.information if information is None else information),
        closures.source,
        closures.weight,
        closures.is_true,
    )


def _turned_back(given: LoopClosures, meant: LoopClosures) -> LoopClosures:
    """Closures that run from b to a as they run from a to b."""
    if not len(given):
        return given
    return meant.between(int(given.robot_a[0]), int(given.robot_b[0]))[0]
