"""Rates of chosen closures, and errors of an estimate against the truth.

Trajectories are compared in one frame: `align="first"` moves the whole estimate, as one rigid body,
so that its first pose is the true first pose (the gauge); `align="umeyama"` so that the sum of
squared distances between positions is least (Umeyama 1991, without scale); None leaves it alone.

An estimate or a truth is a `jaxlie.SE2` or `SE3` batch `[n]`, a `PoseGraph`, or a sequence of them,
one for each robot, all in one common frame; several robots are moved together. Arrays are computed
on the host in NumPy float64; tracers are followed, so that every function here can be jitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from pcm_jax import lie
from pcm_jax.arrays import as_array, namespace
from pcm_jax.errors import InputError

Scalar = Float[Array, ""]


class PoseError(NamedTuple):
    """Errors of a set of poses.

    Attributes:
        translation_mse: mean squared length of the translation errors, m².
        rotation_mse: mean Frobenius norm of the rotation errors' matrix logarithms: √2 times the
            mean angle, rad. (The paper's name; nothing in it is squared.)
    """

    translation_mse: Scalar
    rotation_mse: Scalar


def true_positive_rate(
    accepted: Bool[Array, "*batch m"], is_true: Bool[Array, "*batch m"]
) -> Float[Array, "*batch"]:
    """Fraction of the true closures that were accepted; NaN where none is true."""
    return _fraction(accepted, is_true)


def false_positive_rate(
    accepted: Bool[Array, "*batch m"], is_true: Bool[Array, "*batch m"]
) -> Float[Array, "*batch"]:
    """Fraction of the false closures that were accepted; NaN where none is false."""
    return _fraction(accepted, ~_mask(is_true))


def precision(
    accepted: Bool[Array, "*batch m"], is_true: Bool[Array, "*batch m"]
) -> Float[Array, "*batch"]:
    """Fraction of the accepted closures that are true; NaN where none was accepted."""
    return _fraction(is_true, accepted)


def translation_mse(estimate: Any, truth: Any, *, align: str | None = "first") -> Scalar:
    """Mean squared distance between estimated and true positions, m²; frames as `align` says."""
    return pose_error(estimate, truth, align=align).translation_mse


def rotation_mse(estimate: Any, truth: Any, *, align: str | None = "first") -> Scalar:
    """`(1/n) Σ ‖log(R_trueᵀ R_est)‖_F`, rad; frames as `align` says."""
    return pose_error(estimate, truth, align=align).rotation_mse


def ate_rmse(estimate: Any, truth: Any, *, align: str | None = "first") -> Scalar:
    """Absolute trajectory error: root mean square distance between positions, m."""
    return translation_mse(estimate, truth, align=align) ** 0.5


def pose_error(estimate: Any, truth: Any, *, align: str | None = "first") -> PoseError:
    """Both errors of the absolute poses, in the frame that `align` chooses.

    Raises:
        InputError: different numbers of poses or groups, or an unknown `align`.
    """
    moved, (_, truths) = aligned(estimate, truth, align=align), _matched(estimate, truth)
    return _error_of(lie.between(lie.concatenate(truths), lie.concatenate(moved)))


def relative_pose_error(estimate: Any, truth: Any, *, delta: int = 1) -> PoseError:
    """Both errors of the pose `delta` steps later seen from each pose (RPE); needs no alignment.

    Steps from one robot to the next are none: each robot's trajectory stands alone.

    Raises:
        InputError: different numbers of poses or groups, or no robot with more than `delta` poses.
    """
    estimates, truths = _matched(estimate, truth)
    if delta < 1 or all(len(lie.parameters(poses)) <= delta for poses in truths):
        raise InputError(f"delta: {delta} given, expected at least 1 and fewer than the poses")
    true, estimated = (
        lie.concatenate([_steps(poses, delta) for poses in side]) for side in (truths, estimates)
    )
    return _error_of(lie.between(true, estimated))


def relative_map_pose_error(estimate: Sequence[Any], truth: Sequence[Any]) -> PoseError:
    """Both errors of each map's first pose seen from the first map's: how well maps are tied.

    Args:
        estimate: one entry for each robot, two at least, in one common frame.
        truth: likewise.

    Raises:
        InputError: fewer than two robots, or poses of another number than the truth's.
    """
    estimates, truths = _matched(estimate, truth)
    if len(truths) < 2:
        raise InputError(f"truth: {len(truths)} robots given, expected at least 2")
    firsts = (lie.stack([lie.take(p, 0) for p in side]) for side in (truths, estimates))
    true, estimated = (lie.between(lie.take(p, 0), lie.take(p, np.s_[1:])) for p in firsts)
    return _error_of(lie.between(true, estimated))


def aligned(estimate: Any, truth: Any, *, align: str | None = "first") -> tuple[Any, ...]:
    """The estimate moved as one rigid body into the truth's frame: one Lie batch for each robot.

    Raises:
        InputError: different numbers of poses or groups, or an unknown `align`.
    """
    estimates, truths = _matched(estimate, truth)
    if align is None:
        return tuple(estimates)
    if align not in _ALIGNMENTS:
        raise InputError(f"align: {align!r} given, expected 'first', 'umeyama' or None")
    motion = _ALIGNMENTS[align](lie.concatenate(estimates), lie.concatenate(truths))
    return tuple(lie.compose(motion, poses) for poses in estimates)


def normalized_chi2(residual: Any, rows: int, columns: int) -> Any:
    """`Σ rᵀΩr / (rows − columns)`: about 1 where the noise is as stated.

    Args:
        residual: `Σ rᵀΩr`, twice the cost.
        rows: scalar measurements: d for every edge and closure.
        columns: scalar unknowns: d for every pose that is not fixed.

    Returns:
        NaN where no degree of freedom is left.
    """
    return residual / (rows - columns) if rows > columns else residual * np.nan


def host_poses(poses: Any) -> Any:
    """Poses (of a `PoseGraph` too) as a NumPy-backed transform; tracers as they are."""
    transform = getattr(poses, "poses", poses)
    traced = isinstance(lie.parameters(transform), Tracer)
    return transform if traced else lie.as_numpy(transform)


def _fraction(part: Any, whole: Any) -> Any:
    part, whole = _mask(part), _mask(whole)
    if np.shape(part)[-1:] != np.shape(whole)[-1:]:
        raise InputError(f"masks: shapes {np.shape(part)} and {np.shape(whole)}, expected one [m]")
    xp = namespace(part, whole)
    count = xp.sum(whole, axis=-1)
    share = xp.sum(part & whole, axis=-1) / xp.maximum(count, 1)
    return xp.where(count > 0, share, xp.nan)


def _mask(values: Any) -> Any:
    if isinstance(values, Tracer):
        return values
    mask = as_array(values, "mask")
    if mask.dtype.kind not in "biuf" or not mask.ndim:
        raise InputError(f"mask: {mask.dtype} {mask.shape} given, expected bool [m]")
    return mask.astype(bool)


def _matched(estimate: Any, truth: Any) -> tuple[list[Any], list[Any]]:
    """Both as lists with one Lie batch for each robot, of the same sizes."""
    sides = [
        [host_poses(poses) for poses in (side if isinstance(side, list | tuple) else [side])]
        for side in (estimate, truth)
    ]
    kinds = [
        [(lie.group_of(p).__name__, lie.translation(p).shape[0]) for p in side] for side in sides
    ]
    if kinds[0] != kinds[1] or not kinds[0] or any(count == 0 for _, count in kinds[0]):
        raise InputError(f"estimate: {kinds[0]} given, expected {kinds[1]} like the truth")
    return sides[0], sides[1]


def _steps(poses: Any, delta: int) -> Any:
    return lie.between(lie.take(poses, np.s_[:-delta]), lie.take(poses, np.s_[delta:]))


def _error_of(error: Any) -> PoseError:
    """Both means over a batch `[n]` of error transforms `true⁻¹ estimate`."""
    shift = lie.translation(error)
    turn = lie.log(error)[..., shift.shape[-1] :]
    xp = namespace(shift)
    squared_turn = xp.sum(turn**2, axis=-1)
    return PoseError(xp.mean(xp.sum(shift**2, axis=-1)), xp.mean(xp.sqrt(2.0 * squared_turn)))


def _first_pose(estimate: Any, truth: Any) -> Any:
    return lie.compose(lie.take(truth, 0), lie.inverse(lie.take(estimate, 0)))


def _umeyama(estimate: Any, truth: Any) -> Any:
    """The motion of least squared distances between positions (Umeyama 1991, eqs. 40-43, c = 1)."""
    source, target = lie.translation(estimate), lie.translation(truth)
    xp = namespace(source, target)
    center, goal = xp.mean(source, axis=0), xp.mean(target, axis=0)
    left, _, right = xp.linalg.svd((target - goal).T @ (source - center))
    mirrored = xp.sign(xp.linalg.det(left @ right))
    signs = xp.concatenate([xp.ones(source.shape[1] - 1), mirrored[None]])
    rotation = (left * signs) @ right
    top = xp.concatenate([rotation, (goal - rotation @ center)[:, None]], axis=1)
    return lie.from_matrix(xp.concatenate([top, xp.eye(top.shape[1], dtype=top.dtype)[-1:]]))


_ALIGNMENTS = {"first": _first_pose, "umeyama": _umeyama}
