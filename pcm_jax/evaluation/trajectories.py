"""Absolute and relative errors of several robots' trajectories, as the program evo defines them.

The absolute error (ATE) of a pose is that of `true⁻¹ estimate` after a rigid motion, without scale,
that makes the sum of squared distances between positions least (Umeyama 1991): one for all robots
together, so that a robot that was tied in wrongly shows, or one for each. The relative error (RPE)
is that of `(true step)⁻¹ (estimated step)`; steps follow each other and do not overlap, and metres
are counted along the estimate. Lengths are norms in metres, rotations are angles in degrees.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.errors import InputError, check_choice, check_number
from pcm_jax.evaluation._pairing import Pairing, paired
from pcm_jax.evaluation.metrics import aligned

ALIGNMENTS = ("joint", "each", None)
SHORTEST = 1e-9  # metres of a step
OPEN = 1e-13  # a singular value beside the largest, below which positions leave a rotation open


class Statistics(NamedTuple):
    """Statistics of errors; NaN where there is none.

    Attributes:
        rmse: root mean square.
        mean: arithmetic mean.
        median: of an even number, the mean of the two in the middle.
        max: the largest.
    """

    rmse: float
    mean: float
    median: float
    max: float


class Errors(NamedTuple):
    """Errors of poses or of steps.

    Attributes:
        count: how many.
        translation: metres.
        rotation: degrees.
    """

    count: int
    translation: Statistics
    rotation: Statistics


class RobotErrors(NamedTuple):
    """One robot's errors.

    Attributes:
        robot: its name in the estimate.
        true_robot: its name in the truth.
        poses: how many the estimate has; `absolute.count` of them have a true one.
        matched_by: "time stamp" or "id".
        absolute: ATE, of poses.
        relative: RPE, of steps.
    """

    robot: str
    true_robot: str
    poses: int
    matched_by: str
    absolute: Errors
    relative: Errors


@dataclasses.dataclass(frozen=True, repr=False)
class TrajectoryErrors:
    """Errors of trajectories against the truth.

    Attributes:
        robots: each robot's, in the estimate's order.
        absolute: ATE over the poses of all robots.
        relative: RPE over the steps of all robots; none leads from one to another.
        align: "joint", "each" or None.
        delta: frames in a step.
        delta_metres: metres of a step along the estimate; None where frames count.
        robots_by: "name" or "order", by which robots were matched.
    """

    robots: tuple[RobotErrors, ...]
    absolute: Errors
    relative: Errors
    align: str | None
    delta: int
    delta_metres: float | None
    robots_by: str

    def __repr__(self) -> str:
        count, poses = len(self.robots), sum(one.poses for one in self.robots)
        lines = [
            f"TrajectoryErrors({count} robot{'s' * (count > 1)}, {self.absolute.count} of {poses}"
            f" poses matched, align={self.align!r})"
        ]
        for name, errors, over in (
            ("ATE", self.absolute, ""),
            ("RPE", self.relative, f" over {self.step}"),
        ):
            metres, degrees = errors.translation.rmse, errors.rotation.rmse
            lines.append(f"  {name} {metres:.4g} m, {degrees:.4g} deg (RMSE){over}")
        return "\n".join(lines)

    @property
    def step(self) -> str:
        """The length of a step in words: "1 frame", "5 m"."""
        if self.delta_metres is not None:
            return f"{self.delta_metres:g} m"
        return f"{self.delta} frame{'s' * (self.delta > 1)}"

    def as_dict(self) -> dict[str, Any]:
        """The same as JSON has it."""
        return {
            "align": self.align,
            "delta": self.delta if self.delta_metres is None else None,
            "delta_metres": self.delta_metres,
            "robots_matched_by": self.robots_by,
            "robots": [
                one._asdict() | _errors_as_dict(one.absolute, one.relative) for one in self.robots
            ],
            "all": _errors_as_dict(self.absolute, self.relative),
        }


def trajectory_errors(
    estimate: Any,
    truth: Any,
    *,
    align: str | None = "joint",
    delta: int = 1,
    delta_metres: float | None = None,
    max_difference: float = 0.01,
) -> TrajectoryErrors:
    """Errors of several robots' trajectories against the truth, per robot and of all.

    Robots are matched by name where the truth has all the estimate's, by order where it has none of
    them; poses by time stamp where both sides have stamps, else by id.

    Args:
        estimate: a `MultiRobotGraph`, a `PoseGraph` or a sequence of them, in one common frame.
        truth: likewise, in any frame; a graph's `truth` where it has one.
        align: "joint" for one rigid motion of all robots, "each" for one of each, None for none.
        delta: frames in a step of the relative error.
        delta_metres: metres in a step instead, along the estimate.
        max_difference: seconds by which the stamps of one pose may differ.

    Raises:
        InputError: for other robots, poses of another group, a robot of which no pose is matched,
            positions that leave the alignment's rotation open, a step that no robot is long enough
            for, and options out of range.

    Example:
        >>> from pcm_jax.simulation import simulate_city
        >>> world = simulate_city(seed=1, poses=50)
        >>> true = [one.with_poses(p) for one, p in zip(world.graph.maps, world.truth)]
        >>> trajectory_errors(true, true, align=None)
        TrajectoryErrors(2 robots, 100 of 100 poses matched, align=None)
          ATE 0 m, 0 deg (RMSE)
          RPE 0 m, 0 deg (RMSE) over 1 frame
    """
    _check_options(align, delta, delta_metres)
    pairs, by = paired(estimate, truth, max_difference)
    absolute = [
        _errors_between(pair.truth, moved)
        for pair, moved in zip(pairs, _aligned(pairs, align), strict=True)
    ]
    relative = [_step_errors(pair, delta, delta_metres) for pair in pairs]
    if not any(len(errors) for errors in relative):
        name, step = ("delta", delta) if delta_metres is None else ("delta_metres", delta_metres)
        raise InputError(f"{name}: {step:g} given, expected a step that some robot is longer than")
    robots = tuple(
        RobotErrors(*pair[:4], _summary(poses), _summary(steps))
        for pair, poses, steps in zip(pairs, absolute, relative, strict=True)
    )
    poses, steps = (_summary(np.concatenate(errors)) for errors in (absolute, relative))
    return TrajectoryErrors(robots, poses, steps, align, delta, delta_metres, by)


def _check_options(align: str | None, delta: int, delta_metres: float | None) -> None:
    check_choice("align", align, ALIGNMENTS)
    check_number("delta", delta, least=1, integer=True)
    if delta_metres is not None:
        check_number("delta_metres", delta_metres, least=SHORTEST)


def _aligned(pairs: Sequence[Pairing], align: str | None) -> Sequence[Any]:
    """The estimated poses in the truth's frame, a Lie batch for each robot."""
    if align is None:
        return [pair.estimate for pair in pairs]
    moved: list[Any] = []
    for group in [pairs] if align == "joint" else [[pair] for pair in pairs]:
        sides = [pair.estimate for pair in group], [pair.truth for pair in group]
        _check_spread(*sides, [pair.robot for pair in group])
        moved += aligned(*sides, align="umeyama")
    return moved


def _check_spread(estimate: list[Any], truth: list[Any], names: list[str]) -> None:
    """Raises `InputError` unless positions tell the rotation: no single point, no line in space."""
    places = [lie.translation(lie.concatenate(side)) for side in (estimate, truth)]
    source, target = (side - side.mean(axis=0) for side in places)
    spread = np.linalg.svd(target.T @ source, compute_uv=False)
    rounding = OPEN**2 * np.abs(places[0]).max() * np.abs(places[1]).max()
    if spread[-2] <= max(OPEN * spread[0], rounding):
        held = "one point" if source.shape[1] == 2 else "one line"
        raise InputError(
            f"align: the matched positions of {', '.join(names)} lie on {held}, which leaves the"
            " rotation open; align=None (--align none) compares them where they are"
        )


def _step_errors(pair: Pairing, delta: int, delta_metres: float | None) -> Float[np.ndarray, "k 2"]:
    """Errors of steps, each from where the last one ended."""
    if delta_metres is None:
        ends = np.arange(0, len(lie.parameters(pair.estimate)), delta)
    else:
        ends = _ends_along(lie.translation(pair.estimate), delta_metres)
    sides = (
        lie.between(lie.take(poses, ends[:-1]), lie.take(poses, ends[1:]))
        for poses in (pair.truth, pair.estimate)
    )
    return _errors_between(*sides)


def _ends_along(places: Float[np.ndarray, "n space"], metres: float) -> Int[np.ndarray, " k"]:
    """The first pose, and each that is the first so many metres of the way behind the last end."""
    ends, walked = [0], 0.0
    for index, length in enumerate(np.linalg.norm(np.diff(places, axis=0), axis=1).tolist(), 1):
        walked += length
        if walked >= metres:
            ends.append(index)
            walked = 0.0
    return np.array(ends)


def _errors_between(truth: Any, estimate: Any) -> Float[np.ndarray, "k 2"]:
    """Metres and degrees of each `true⁻¹ estimate`."""
    error = lie.between(truth, estimate)
    shift = lie.translation(error)
    turn = lie.log(error)[:, shift.shape[1] :]
    return np.stack(
        [np.linalg.norm(shift, axis=1), np.degrees(np.linalg.norm(turn, axis=1))], axis=1
    )


def _summary(errors: Float[np.ndarray, "k 2"]) -> Errors:
    return Errors(len(errors), *(_statistics(column) for column in errors.T))


def _statistics(errors: Float[np.ndarray, " k"]) -> Statistics:
    if not len(errors):
        return Statistics(np.nan, np.nan, np.nan, np.nan)
    values = np.sqrt(np.mean(errors**2)), np.mean(errors), np.median(errors), np.max(errors)
    return Statistics(*map(float, values))


def _errors_as_dict(absolute: Errors, relative: Errors) -> dict[str, Any]:
    return {
        name: {
            "count": errors.count,
            "translation": errors.translation._asdict(),
            "rotation": errors.rotation._asdict(),
        }
        for name, errors in (("absolute", absolute), ("relative", relative))
    }
