"""Between a file's columns and transforms with their information over the tangent.

Each format weights errors of its own coordinates. To first order these are linear in the right
perturbation δ = (translation, rotation) of the measurement z, so Ω = Jᵀ Ω_file J with:

- g2o, 2D: the coordinates of z⁻¹ X_i⁻¹ X_j, in the edge's end frame: J = I.
- g2o, 3D: likewise. g2o's own program takes the quaternion's vector part, half the rotation
  vector: J = blkdiag(I, ½ I) ("quaternion"). GTSAM and SE-Sync do not rescale: J = I ("tangent").
- TORO and iSAM: differences of x, y, z as the start of the edge sees them, so translation errors
  are turned by the measured rotation: J = blkdiag(R_z, I). Roll, pitch and yaw are taken as
  rotations about the end frame's axes, as in GTSAM; they are that at small roll and pitch.

iSAM defines its numbers as R in Ω = Rᵀ R, upper triangular, row by row. Many files do not mean
it; which is meant is the reader's decision ("as-written", "sqrt"; "covariance" for files that hold
the inverse).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.graph.validation import (
    Fault,
    check_information,
    positive_definite,
    unit_rotations,
)

TURN = 2.0 * np.pi * (1.0 + 1e-4)  # radians, as a file may round them
FIRST_ANGLE = {"angle": 2, "euler": 3}
"""The first column that is an angle, by the kind of coordinates."""
TORO_ORDER = ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))


def parameters(
    coordinates: str, values: Float[np.ndarray, "n k"], fault: Fault
) -> Float[np.ndarray, "n p"]:
    """The parameters, as jaxlie orders them, `[n, 4]` or `[n, 7]` from a file's columns.

    Args:
        coordinates: "angle", "quaternion" or "euler".
        values: `[n, 3]`, `[n, 7]` or `[n, 6]`; metres and radians.
        fault: names a culprit.

    Raises:
        InputError: through `fault`, for a quaternion whose norm is zero or more than 1 % from one.
    """
    if coordinates == "angle":
        x, y, theta = values.T
        return np.stack([np.cos(theta), np.sin(theta), x, y], axis=1)
    if coordinates == "euler":
        return np.concatenate([_quaternion(values[:, 3:]), values[:, :3]], axis=1)
    order = "x y z qx qy qz qw"
    return unit_rotations(values[:, [6, 3, 4, 5, 0, 1, 2]], 4, fault, columns=order)


def angle_doubt(
    coordinates: str, angles: Float[np.ndarray, "n k"], line: Int[np.ndarray, " n"]
) -> str | None:
    """Says that measured angles are no radians, if they lie beyond a turn; else None.

    Args:
        coordinates: "angle", "quaternion" or "euler".
        angles: `[n, 1]` or `[n, 3]`, the columns from `FIRST_ANGLE` on.
        line: where each stands.
    """
    if coordinates not in FIRST_ANGLE or not len(angles):
        return None
    largest = np.abs(angles).max(axis=1)
    row = int(np.argmax(largest))
    if largest[row] <= TURN:
        return None
    value = angles[row, int(np.argmax(np.abs(angles[row])))]
    name = "theta" if coordinates == "angle" else "roll, pitch or yaw"
    return f"line {line[row]}: {name} {value:g} is more than a turn, expected radians (degrees?)"


def _quaternion(angles: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 4"]:
    """(w, x, y, z) `[n, 4]` of Rz(yaw) Ry(pitch) Rx(roll), angles `[n, 3]` in that file's order."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles.T / 2), np.sin(angles.T / 2)
    return np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=1,
    )


def columns(transforms: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "n k"]:
    """g2o's columns, `[n, 3]` or `[n, 7]`, from jaxlie's parameters."""
    if transforms.shape[1] == 4:
        cos, sin, x, y = transforms.T
        return np.stack([x, y, np.arctan2(sin, cos)], axis=1)
    return transforms[:, [4, 5, 6, 1, 2, 3, 0]]


def symmetric(triangle: Float[np.ndarray, "e t"]) -> Float[np.ndarray, "e d d"]:
    """`[e, d, d]` from upper triangles `[e, d (d + 1) / 2]`, row by row."""
    upper = triangular(triangle)
    diagonal = np.arange(upper.shape[-1])
    full = upper + np.swapaxes(upper, 1, 2)
    full[:, diagonal, diagonal] = upper[:, diagonal, diagonal]
    return full


def triangular(triangle: Float[np.ndarray, "e t"]) -> Float[np.ndarray, "e d d"]:
    """Upper triangular `[e, d, d]` from `[e, d (d + 1) / 2]`, row by row."""
    d = int((2 * triangle.shape[1]) ** 0.5)
    upper = np.zeros((len(triangle), d, d))
    upper[(slice(None), *np.triu_indices(d))] = triangle
    return upper


def upper_triangle(matrices: Float[np.ndarray, "e d d"]) -> Float[np.ndarray, "e t"]:
    """`[e, d (d + 1) / 2]`, row by row, of symmetric `[e, d, d]`."""
    return matrices[(slice(None), *np.triu_indices(matrices.shape[-1]))]


def from_toro_order(triangle: Float[np.ndarray, "e 6"]) -> Float[np.ndarray, "e 6"]:
    """2D triangles `[e, 6]` row by row, from TORO's order I11 I12 I22 I33 I13 I23."""
    slot = {entry: k for k, entry in enumerate(TORO_ORDER)}
    return triangle[:, [slot[int(i), int(j)] for i, j in zip(*np.triu_indices(3), strict=True)]]


def looks_like_toro(triangle: Float[np.ndarray, "e 6"], *, expected: bool) -> bool:
    """Finds the order of 2D triangles `[e, 6]` by which reading is positive definite.

    Args:
        triangle: the numbers of TORO's or iSAM's lines.
        expected: the answer where both readings are, or neither is.
    """
    as_toro = positive_definite(symmetric(from_toro_order(triangle))).sum()
    as_rows = positive_definite(symmetric(triangle)).sum()
    return expected if as_toro == as_rows else bool(as_toro > as_rows)


def information(
    triangle: Float[np.ndarray, "e t"], *, how: str, fault: Fault
) -> Float[np.ndarray, "e d d"]:
    """Information `[e, d, d]` over the file's coordinates, from its numbers.

    Args:
        triangle: `[e, d (d + 1) / 2]`, row by row.
        how: the numbers are Ω ("as-written"), R in Ω = Rᵀ R ("sqrt"), or Ω⁻¹ ("covariance").
        fault: names a culprit.

    Raises:
        InputError: through `fault`, for a covariance that is not positive definite.
    """
    if how == "covariance":
        return inverted(check_information(symmetric(triangle), fault, "covariance"))
    if how != "sqrt":
        return symmetric(triangle)
    root = triangular(triangle)
    return np.swapaxes(root, 1, 2) @ root


def inverted(covariance: Float[np.ndarray, "e d d"]) -> Float[np.ndarray, "e d d"]:
    """The inverses, exactly symmetric."""
    half = 0.5 * np.linalg.inv(covariance)  # halved first, as a sum may be too large for a float
    return half + np.swapaxes(half, 1, 2)


def from_quaternion_vector(matrices: Float[np.ndarray, "e 6 6"]) -> Float[np.ndarray, "e 6 6"]:
    """Over the tangent, from `[e, 6, 6]` over (x, y, z, qx, qy, qz) near the measurement."""
    scale = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
    return matrices * scale[:, None] * scale


def from_start_frame(
    matrices: Float[np.ndarray, "e d d"], measurement: Any
) -> Float[np.ndarray, "e d d"]:
    """Over the tangent, from information whose translation part is in the edge's start frame.

    Args:
        matrices: `[e, d, d]`.
        measurement: NumPy-backed Lie `[e]`.
    """
    rotation = np.asarray(lie.as_matrix(measurement))[:, :-1, :-1]
    space = rotation.shape[-1]
    turn = np.array(np.broadcast_to(np.eye(matrices.shape[-1]), matrices.shape))
    turn[:, :space, :space] = rotation
    with np.errstate(over="ignore", invalid="ignore"):  # what is too large is refused later
        turned = np.swapaxes(turn, 1, 2) @ matrices @ turn
        return 0.5 * (turned + np.swapaxes(turned, 1, 2))
