"""SE(3), entry by entry.

An element is the tuple (q_w, q_x, q_y, q_z, x, y, z), a tangent vector (v_x, v_y, v_z, ω_x, ω_y,
ω_z): jaxlie's orders. Every entry is a NumPy or JAX array; the entries broadcast against each
other, their shape is the batch. q and −q are the same rotation.

The 6x6 Jacobians are those of SO(3) at the dual number ω + εv: their off-diagonal block is the
directional derivative along v of the 3x3 one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pcm_jax.arrays import namespace
from pcm_jax.lie import _angle as angle
from pcm_jax.lie import unrolled
from pcm_jax.lie.unrolled import cross

PARAMETERS_DIM = 7
TANGENT_DIM = 6
MATRIX_DIM = 4

Element = tuple[Any, ...]
Tangent = tuple[Any, ...]
Entries = unrolled.Matrix

# atan(n/w)/(n/w) as a series in (n/w)²: at n² < 0.01 the terms left out are below 1e-17.
_ATAN_BELOW = 0.01
_ATAN = [(-1) ** k / (2 * k + 1) for k in range(9)]


def identity() -> Element:
    """No rotation, no translation."""
    return (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def _rotate(q: Sequence[Any], v: Sequence[Any]) -> tuple[Any, Any, Any]:
    """The rotation of unit quaternion q applied to v."""
    w, axis = q[0], q[1:4]
    twice = [2.0 * c for c in cross(axis, v)]
    again = cross(axis, twice)
    return (
        v[0] + w * twice[0] + again[0],
        v[1] + w * twice[1] + again[1],
        v[2] + w * twice[2] + again[2],
    )


def _multiply_quaternions(a: Sequence[Any], b: Sequence[Any]) -> tuple[Any, Any, Any, Any]:
    aw, ax, ay, az = a[:4]
    bw, bx, by, bz = b[:4]
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def compose(a: Element, b: Element) -> Element:
    """The product a b."""
    moved = _rotate(a, b[4:])
    shifted = (moved[0] + a[4], moved[1] + a[5], moved[2] + a[6])
    return (*_multiply_quaternions(a, b), *shifted)


def inverse(a: Element) -> Element:
    """The inverse."""
    back = (a[0], -a[1], -a[2], -a[3])
    x, y, z = _rotate(back, a[4:])
    return (*back, -x, -y, -z)


def _twist(v: Sequence[Any], omega: Sequence[Any], first: Any, second: Any) -> tuple[Any, ...]:
    """(I + first [ω] + second [ω]²) v."""
    once = cross(omega, v)
    twice = cross(omega, once)
    return tuple(v[i] + first * once[i] + second * twice[i] for i in range(3))


def exp(tangent: Tangent) -> Element:
    """Rotation by the vector ω, translation V v."""
    v, omega = tangent[:3], tangent[3:]
    t = unrolled.dot(omega, omega)
    cos_half, sin_half = angle.half_angle(t)
    versine = 2.0 * sin_half * sin_half
    rest = angle.sin_remainder(t, 2.0 * cos_half * sin_half)
    x, y, z = _twist(v, omega, versine, rest)
    return (cos_half, *(sin_half * w for w in omega), x, y, z)


def _angle_over_sine(w: Any, squared_sine: Any) -> Any:
    """θ / sin(θ/2) for the half angle with cosine w ≥ 0 and squared sine given."""
    xp = namespace(w, squared_sine)
    small = squared_sine < _ATAN_BELOW
    squared_tan = xp.where(small, squared_sine, 0.0) / xp.where(small, w * w, 1.0)
    near = angle.polynomial(_ATAN, squared_tan) / xp.where(small, w, 1.0)
    sine = xp.sqrt(xp.where(small, 1.0, squared_sine))
    return 2.0 * xp.where(small, near, xp.arctan2(sine, w) / sine)


def log(a: Element) -> Tangent:
    """(V⁻¹ (x, y, z), ω), with |ω| ≤ π."""
    xp = namespace(*a[:4])
    negative = a[0] < 0.0  # q and −q are one rotation
    w = xp.where(negative, -a[0], a[0])
    squared_sine = unrolled.dot(a[1:4], a[1:4])
    ratio = _angle_over_sine(w, squared_sine)
    signed = xp.where(negative, -ratio, ratio)
    omega = tuple(signed * q for q in a[1:4])
    rest = angle.cot_remainder(ratio * ratio * squared_sine, 0.5 * ratio * w)
    return (*_twist(a[4:], omega, -0.5, rest), *omega)


def rotation_matrix(a: Element) -> Entries:
    """The 3x3 rotation of the unit quaternion."""
    w, x, y, z = a[:4]
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


def adjoint(a: Element) -> Entries:
    """Ad with a exp(δ) a⁻¹ = exp(Ad δ): [[R, [t] R], [0, R]]."""
    rotation = rotation_matrix(a)
    lever = unrolled.multiply(unrolled.skew(a[4:]), rotation)
    return _dual(rotation, lever)


def adjoint_sandwich(a: Element, symmetric: Entries) -> Entries:
    """Ad S Adᵀ: a covariance of right perturbations of a as one of left perturbations.

    Rotation first, lever arm second: a quarter fewer products than with the 6x6 adjoint.
    """
    rotation, zero, one = rotation_matrix(a), ((0.0,) * 3,) * 3, unrolled.identity(3)
    turn = unrolled.block([[rotation, zero], [zero, rotation]])
    lever = unrolled.block([[one, unrolled.skew(a[4:])], [zero, one]])
    return unrolled.sandwich(lever, unrolled.sandwich(turn, symmetric))


def left_tangent(a: Element, velocity: Element) -> Tangent:
    """τ with exp(s τ) a = a + s `velocity` to first order in s.

    Takes a derivative of the parameters to one of the group. What leads off the group
    (along the quaternion) is dropped.
    """
    rate = _multiply_quaternions(velocity, (a[0], -a[1], -a[2], -a[3]))
    omega = tuple(2.0 * r for r in rate[1:])
    lever = cross(omega, a[4:])
    return (*(velocity[4 + i] - lever[i] for i in range(3)), *omega)


def bracket(a: Tangent, b: Tangent) -> Tangent:
    """[a, b]: the derivative of Ad(exp(s a)) b at s = 0."""
    by_turn, by_shift = cross(a[3:], b[:3]), cross(a[:3], b[3:])
    return (*(by_turn[i] + by_shift[i] for i in range(3)), *cross(a[3:], b[3:]))


def _dual(diagonal: Entries, corner: Entries) -> Entries:
    zero = ((0.0,) * 3,) * 3
    return unrolled.block([[diagonal, corner], [zero, diagonal]])


def _series_with_slope(
    tangent: Tangent, first: Any, second: Any, first_slope: Any, second_slope: Any
) -> Entries:
    """I + f [ω] + s [ω]² and its derivative along v, where f and s are functions of θ².

    Products of skew matrices are written as outer products:
    [ω]² = ω ωᵀ − θ² I, [ω][v] + [v][ω] = ω vᵀ + v ωᵀ − 2 (ω·v) I.
    """
    v, w = tangent[:3], tangent[3:]
    t, along = unrolled.dot(w, w), unrolled.dot(w, v)
    twice = 2.0 * along
    turn = unrolled.skew([first * w[i] for i in range(3)])
    lever = unrolled.skew([first * v[i] + twice * first_slope * w[i] for i in range(3)])
    diagonal = tuple(tuple(second * w[i] * w[j] + turn[i][j] for j in range(3)) for i in range(3))
    corner = tuple(
        tuple(
            second * (w[i] * v[j] + v[i] * w[j]) + twice * second_slope * w[i] * w[j] + lever[i][j]
            for j in range(3)
        )
        for i in range(3)
    )
    return _dual(
        _plus_diagonal(diagonal, 1.0 - second * t),
        _plus_diagonal(corner, -twice * (second + second_slope * t)),
    )


def _plus_diagonal(matrix: Entries, value: Any) -> Entries:
    return tuple(
        tuple(entry + value if i == j else entry for j, entry in enumerate(row))
        for i, row in enumerate(matrix)
    )


def right_jacobian(tangent: Tangent) -> Entries:
    """Jr with exp(τ + δ) = exp(τ) exp(Jr δ) to first order."""
    t = unrolled.dot(tangent[3:], tangent[3:])
    cos_half, sin_half = angle.half_angle(t)
    sinc, versine = 2.0 * cos_half * sin_half, 2.0 * sin_half * sin_half
    rest = angle.sin_remainder(t, sinc)
    versine_slope = angle.cos_remainder_slope(t, sinc, versine)
    rest_slope = angle.sin_remainder_slope(t, versine, rest)
    return _series_with_slope(tangent, -versine, rest, -versine_slope, rest_slope)


def right_jacobian_inverse(tangent: Tangent) -> Entries:
    """Jr⁻¹, the derivative of Log(exp(τ) exp(δ)) at δ = 0."""
    t = unrolled.dot(tangent[3:], tangent[3:])
    cos_half, sin_half = angle.half_angle(t)
    cot = 0.5 * cos_half / sin_half
    rest = angle.cot_remainder(t, cot)
    slope = angle.cot_remainder_slope(t, cot, rest)
    return _series_with_slope(tangent, 0.5, rest, 0.0, slope)


def normalize(a: Element) -> Element:
    """The quaternion scaled to unit length."""
    scale = 1.0 / namespace(*a).sqrt(unrolled.dot(a[:4], a[:4]))
    return (*(scale * q for q in a[:4]), *a[4:])


def to_matrix(a: Element) -> Entries:
    """Homogeneous 4x4."""
    rotation = rotation_matrix(a)
    rows = tuple((*rotation[i], a[4 + i]) for i in range(3))
    return (*rows, (0.0, 0.0, 0.0, 1.0))


def from_matrix(matrix: Any) -> Element:
    """From the entries of a homogeneous 4x4 matrix; rounding of the rotation is removed.

    Four expressions are multiples of the quaternion, by q_w, q_x, q_y and q_z (Shepperd 1978); the
    one with the largest factor is scaled to unit length.
    """
    r = matrix
    xp = namespace(r[0][0])
    sums = (r[2][1] + r[1][2], r[0][2] + r[2][0], r[1][0] + r[0][1])
    turns = (r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1])
    x, y, z = r[0][0], r[1][1], r[2][2]
    multiples = (
        (1.0 + x + y + z, turns[0], turns[1], turns[2]),
        (turns[0], 1.0 + x - y - z, sums[2], sums[1]),
        (turns[1], sums[2], 1.0 - x + y - z, sums[0]),
        (turns[2], sums[1], sums[0], 1.0 - x - y + z),
    )
    best, factor = multiples[0], multiples[0][0]
    for k in (1, 2, 3):
        larger = multiples[k][k] > factor
        factor = xp.where(larger, multiples[k][k], factor)
        best = tuple(xp.where(larger, n, o) for n, o in zip(multiples[k], best, strict=True))
    return normalize((*best, r[0][3], r[1][3], r[2][3]))
