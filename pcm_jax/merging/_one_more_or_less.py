"""The shift of the anchors if one closure more, or one less, had been used; to first order.

At the optimum of a merged map with information H, JᵀΩr of a closure is balanced by all else. Taken
out, it leaves H − JᵀΩJ behind and its pull −JᵀΩr unbalanced; put in, it adds both. By Woodbury's
identity, with C = H⁻¹ the covariance of the merged poses,

    out   δ =   C Jᵀ (Ω⁻¹ − J C Jᵀ)⁻¹ r
    in    δ = − C Jᵀ (Ω⁻¹ + J C Jᵀ)⁻¹ r

which asks C of the closure's two poses and each map's first one only: no solve. For right
perturbations P exp(δ), and r = Log(z⁻¹ P⁻¹ Q),

    dr = Jr⁻¹(r) (δ_Q − Ad(Q⁻¹ P) δ_P),       T = P X⁻¹:  T exp(ε),  ε = Ad(X) δ
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph.unsaid import held

BALANCED = 1e-9
"""Share of a closure's covariance that is left to all else, below which nothing else holds it."""


def anchor_shift(result: Any, index: int) -> Float[np.ndarray, "robots d"]:
    """The shift of the anchors; see `MergeResult.anchor_shift`."""
    count = len(result.candidates)
    if not 0 <= index < count:
        raise InputError(f"index: {index}, expected 0 … {count - 1}")
    closure = result.candidates[np.array([index])]
    robots = int(closure.robot_a[0]), int(closure.robot_b[0])
    members = next(group for group in result.groups if robots[0] in group)
    if robots[1] not in members:
        a, b = (result.graph.names[robot] for robot in robots)
        raise InputError(f"index: closure {index} is between {a!r} and {b!r}, which are not merged")
    firsts = np.array([result._covariance_of[robot][1] for robot in members])
    place = dict(zip(members, firsts.tolist(), strict=True))
    ends = np.array([place[robots[0]] + closure.pose_a[0], place[robots[1]] + closure.pose_b[0]])
    of_firsts, of_ends = _covariances(result._covariance_of[members[0]][0], firsts, ends)
    residual, slope = _linear(result.graph, closure)
    own = np.linalg.inv(held(np.asarray(closure.information, np.float64))[0])
    taken_out = bool(result.accepted[index])
    left = own + (-1.0 if taken_out else 1.0) * slope @ of_ends @ slope.T
    shift = np.zeros((len(result.maps), len(residual)))
    if np.linalg.eigvals(left @ np.linalg.inv(own)).real.min() < BALANCED:
        shift[list(members)] = np.nan
        return shift
    moved = of_firsts @ slope.T @ np.linalg.solve(left, residual)
    for robot, delta in zip(members, moved if taken_out else -moved, strict=True):
        start = lie.take(lie.as_numpy(result.maps[robot].poses), 0)
        shift[robot] = np.asarray(lie.adjoint(start)) @ delta
    return shift


def _covariances(
    joint: Any, firsts: Int[np.ndarray, " r"], ends: Int[np.ndarray, "2"]
) -> tuple[Float[np.ndarray, "r d 2*d"], Float[np.ndarray, "2*d 2*d"]]:
    """The covariance of first poses with a closure's ends, and of these ends."""
    poses = np.unique(np.concatenate([firsts, ends]))
    d = joint.pose_graph.tangent_dim
    blocks = joint.joint(poses).reshape(len(poses), d, len(poses), d)
    own, first = np.searchsorted(poses, ends), np.searchsorted(poses, firsts)
    with_ends = blocks[:, :, own].reshape(len(poses), d, 2 * d)
    return with_ends[first], with_ends[own].reshape(2 * d, 2 * d)


def _linear(graph: Any, closure: Any) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, "d 2*d"]]:
    """The residual of a closure in the merged maps, and its derivative by either end's δ."""
    p, q = (
        lie.take(lie.as_numpy(graph.maps[int(robot[0])].poses), int(pose[0]))
        for robot, pose in (
            (closure.robot_a, closure.pose_a),
            (closure.robot_b, closure.pose_b),
        )
    )
    between, measured = lie.between(p, q), lie.take(lie.as_numpy(closure.measurement), 0)
    residual = np.asarray(lie.log(lie.compose(lie.inverse(measured), between)))
    tangent: Any = residual
    inverse = np.asarray(lie.right_jacobian_inverse(lie.group_of(between), tangent))
    back = np.asarray(lie.adjoint(lie.inverse(between)))
    return residual, np.concatenate([-inverse @ back, inverse], axis=1)
