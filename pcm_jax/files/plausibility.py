"""Doubts about how information was read, from the numbers alone, without a loop.

A standard deviation of more than a turn says nothing of a rotation, and one of more than a step's
length nothing of a step. Where the sigmas of a map's odometry are such, its file may hold
covariances, or the information's square root; a reading is proposed only where its sigmas would be
plausible, which none is that widens them further.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from pcm_jax import lie
from pcm_jax.files.coordinates import inverted
from pcm_jax.graph.loop_closures import LoopClosures
from pcm_jax.graph.pose_graph import PoseGraph

TURN = 2.0 * np.pi
SMALLEST_SHARE = 1e-6  # of a step: smaller sigmas are no measurement's
SEVERE = 2.0  # times a step or a turn: what a reader is warned of
ENOUGH = 5000  # measurements to take a median of
HALF_TURN = 2.5  # radians: what no odometry turns by from step to step
COLUMN_ORDER = "is the quaternion's order w x y z? Expected x y z w"
LONG, VERY_LONG = 10.0, 30.0  # times the maps' extent: closures are not that long
APART = 300.0  # times: between robots of one team whose sigmas are in one unit


class Sigmas(NamedTuple):
    """Medians over measurements: metres and radians."""

    translation: float
    rotation: float


class _Subject(NamedTuple):
    """A robot's odometry, or the closures, and the length that their sigmas must keep to.

    Attributes:
        name: "robot a", or "closures".
        what: the length's, for messages.
        information: `[k, d, d]`.
        group: of the poses.
        length: metres.
        turn: the median angle of rotations, radians; 0 in the plane.
        sigmas: medians, as the information was read.
    """

    name: str
    what: str
    information: Float[np.ndarray, "k d d"]
    group: type[Any]
    length: float
    turn: float
    sigmas: Sigmas


def doubts(
    maps: Sequence[PoseGraph], closures: LoopClosures, how: str
) -> Iterator[tuple[str, bool]]:
    """Lines on information that cannot be meant as it was read, and on units.

    Args:
        maps: the robots' maps.
        closures: what joins them.
        how: how the information was read: "as-written", "sqrt" or "covariance".

    Yields:
        each line, and whether it is worth a warning.
    """
    robots = [found for one in maps if (found := _odometry(one)) is not None]
    extent = max((_extent(one) for one in maps), default=0.0) or np.inf
    subjects = list(robots)
    if len(closures):
        information = np.asarray(closures.information)
        subjects.append(
            _Subject(
                "closures",
                "maps",
                information,
                closures.group,
                extent,
                0.0,
                _sigmas(information, closures.group),
            )
        )
    for one in subjects:
        if not _plausible(one.sigmas, one.length):
            severe = not _plausible(one.sigmas, SEVERE * one.length)
            yield f"{_doubt(one)}{_proposal(one, robots, how)}", severe
        if one.turn > HALF_TURN:
            yield f"{one.name}: its steps turn by {one.turn:.3g} rad; {COLUMN_ORDER}", True
    yield from _far_apart(robots)
    yield from _too_long(closures, extent)


def _far_apart(robots: Sequence[_Subject]) -> Iterator[tuple[str, bool]]:
    """Robots of one team whose numbers are in different units."""
    for what, unit, of in (
        ("sigmas", "m", lambda one: one.sigmas.translation),
        ("sigmas", "rad", lambda one: one.sigmas.rotation),
        ("steps", "m", lambda one: one.length),
    ):
        ordered = sorted((of(one), one.name) for one in robots if np.isfinite(of(one)))
        if len(ordered) > 1 and ordered[-1][0] > APART * ordered[0][0]:
            (small, one), (large, other) = ordered[0], ordered[-1]
            yield (
                f"{other}: its {what} of {large:.3g} {unit} are {large / small:.3g} times {one}'s;"
                " are both files in one unit?",
                True,
            )


def _too_long(closures: LoopClosures, extent: float) -> Iterator[tuple[str, bool]]:
    """Closures far longer than the maps that they join."""
    if not len(closures):
        return
    length = float(np.median(_lengths(closures.measurement)))
    if length > LONG * extent:
        yield (
            f"closures: their {length:.3g} m between maps of {extent:.3g} m cannot be meant; are"
            " they in another unit, as millimetres?",
            length > VERY_LONG * extent,
        )


def _odometry(one: PoseGraph) -> _Subject | None:
    """A robot's odometry, of many measurements some; None without measurements."""
    odometry = np.abs(np.asarray(one.tail) - np.asarray(one.head)) == 1
    information = np.asarray(one.information)[odometry if odometry.any() else slice(None)]
    information = information[:: 1 + len(information) // ENOUGH]
    if not len(information):
        return None
    step, turn = _step(one, odometry), _turn(one, odometry)
    sigmas = _sigmas(information, one.group)
    return _Subject(f"robot {one.name}", "a step", information, one.group, step, turn, sigmas)


def _extent(one: PoseGraph) -> float:
    places = np.asarray(lie.translation(lie.as_numpy(one.poses)))
    with np.errstate(over="ignore"):
        return float(np.linalg.norm(np.ptp(places, axis=0)))


def _turn(one: PoseGraph, odometry: np.ndarray) -> float:
    """The median angle of steps in space."""
    if lie.tangent_dim(one.group) != 6 or not odometry.any():
        return 0.0
    w = np.asarray(lie.parameters(lie.as_numpy(one.measurement)))[odometry, 0]
    return float(np.median(2.0 * np.arccos(np.minimum(np.abs(w), 1.0))))


def _step(one: PoseGraph, odometry: np.ndarray) -> float:
    length = _lengths(one.measurement)
    moving = length[odometry & (length > 0.0)]
    return float(np.median(moving)) if moving.size else np.inf


def _lengths(motions: Any) -> Float[np.ndarray, " e"]:
    shift = np.asarray(lie.translation(lie.as_numpy(motions)))
    with np.errstate(over="ignore"):
        return np.linalg.norm(shift, axis=-1)


def _sigmas(information: Float[np.ndarray, "e d d"], group: type[Any]) -> Sigmas:
    space = lie.module_of(group).MATRIX_DIM - 1
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        variances = np.abs(np.diagonal(_inverse(information), axis1=1, axis2=2))
    translation, rotation = variances[:, :space].mean(axis=1), variances[:, space:].mean(axis=1)
    return Sigmas(*(float(np.sqrt(np.median(part))) for part in (translation, rotation)))


def _inverse(matrices: Float[np.ndarray, "e d d"]) -> Float[np.ndarray, "e d d"]:
    try:
        return inverted(matrices)
    except np.linalg.LinAlgError:
        return np.linalg.pinv(matrices, hermitian=True)


def _plausible(sigmas: Sigmas, length: float) -> bool:
    return sigmas.translation <= length and sigmas.rotation <= TURN


def _doubt(one: _Subject) -> str:
    size = f" for {one.what} of {one.length:.3g} m" if np.isfinite(one.length) else ""
    sigmas = one.sigmas
    return (
        f"{one.name}: sigmas of {sigmas.translation:.3g} m and {sigmas.rotation:.3g} rad{size}"
        " cannot be meant"
    )


def _proposal(one: _Subject, robots: Sequence[_Subject], how: str) -> str:
    """The reading that would be plausible, if one is; all files are read so, or none."""
    for name, (words, read) in _READINGS.get(how, {}).items():
        sigmas = _sigmas(read(one.information), one.group)
        smallest = SMALLEST_SHARE * min(one.length, 1e6)
        if not _plausible(sigmas, one.length) or sigmas.translation <= smallest:
            continue
        told = (
            f"; read as {words} they are {sigmas.translation:.3g} m and {sigmas.rotation:.3g} rad"
        )
        worse = [
            other.name
            for other in robots
            if _plausible(other.sigmas, other.length)
            and not _plausible(_sigmas(read(other.information), other.group), other.length)
        ]
        if worse:
            names = "; a CSV may call its columns cov_11, cov_12, …" * (one.what == "maps")
            return (
                f"{told}, but so {worse[0]}'s cannot be meant: expected one reading for all"
                f" files{names}"
            )
        return f"{told} (--information {name})"
    return ""


def _squared(information: Float[np.ndarray, "e d d"]) -> Float[np.ndarray, "e d d"]:
    upper = np.triu(information)
    return np.swapaxes(upper, 1, 2) @ upper


_READINGS: dict[str, dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]]] = {
    "as-written": {
        "covariance": ("covariances", _inverse),
        "sqrt": ("the information's square root", _squared),
    },
    "covariance": {"as-written": ("information", _inverse)},
}
