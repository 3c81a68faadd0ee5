"""SE(2), entry by entry.

An element is the tuple (cos θ, sin θ, x, y), a tangent vector (v_x, v_y, ω): jaxlie's orders. Every
entry is a NumPy or JAX array; the entries broadcast against each other, their shape is the batch.
"""

from __future__ import annotations

from typing import Any

from pcm_jax.arrays import namespace
from pcm_jax.lie import _angle as angle
from pcm_jax.lie import unrolled

PARAMETERS_DIM = 4
TANGENT_DIM = 3
MATRIX_DIM = 3

Element = tuple[Any, ...]
Tangent = tuple[Any, ...]
Entries = unrolled.Matrix


def identity() -> Element:
    """θ = 0, no translation."""
    return (1.0, 0.0, 0.0, 0.0)


def compose(a: Element, b: Element) -> Element:
    """The product a b."""
    cos, sin, x, y = a
    return (
        cos * b[0] - sin * b[1],
        sin * b[0] + cos * b[1],
        cos * b[2] - sin * b[3] + x,
        sin * b[2] + cos * b[3] + y,
    )


def inverse(a: Element) -> Element:
    """The inverse."""
    cos, sin, x, y = a
    return (cos, -sin, -(cos * x + sin * y), sin * x - cos * y)


def exp(tangent: Tangent) -> Element:
    """Rotation by ω, translation V v."""
    v_x, v_y, omega = tangent
    cos_half, sin_half = angle.half_angle(omega * omega)
    sinc = 2.0 * cos_half * sin_half
    versine = 2.0 * sin_half * sin_half * omega  # (1 − cos ω)/ω
    return (
        1.0 - versine * omega,
        sinc * omega,
        sinc * v_x - versine * v_y,
        versine * v_x + sinc * v_y,
    )


def log(a: Element) -> Tangent:
    """(V⁻¹ (x, y), θ), with θ in (−π, π]."""
    cos, sin, x, y = a
    theta = namespace(cos, sin).arctan2(sin, cos)
    cot, half = _half_cot(theta)[0], 0.5 * theta
    return (cot * x + half * y, cot * y - half * x, theta)


def _half_cot(omega: Any) -> tuple[Any, Any]:
    """(ω/2) cot(ω/2), and (1 − that)/ω²."""
    t = omega * omega
    cos_half, sin_half = angle.half_angle(t)
    cot = 0.5 * cos_half / sin_half
    return cot, angle.cot_remainder(t, cot)


def adjoint(a: Element) -> Entries:
    """Ad with a exp(δ) a⁻¹ = exp(Ad δ)."""
    cos, sin, x, y = a
    return ((cos, -sin, y), (sin, cos, -x), (0.0, 0.0, 1.0))


def adjoint_sandwich(a: Element, symmetric: Entries) -> Entries:
    """Ad S Adᵀ: a covariance of right perturbations of a as one of left perturbations."""
    return unrolled.sandwich(adjoint(a), symmetric)


def left_tangent(a: Element, velocity: Element) -> Tangent:
    """τ with exp(s τ) a = a + s `velocity` to first order in s.

    Takes a derivative of the parameters to one of the group. What leads off the group
    (along cos, sin) is dropped.
    """
    omega = a[0] * velocity[1] - a[1] * velocity[0]
    return (velocity[2] + omega * a[3], velocity[3] - omega * a[2], omega)


def bracket(a: Tangent, b: Tangent) -> Tangent:
    """[a, b]: the derivative of Ad(exp(s a)) b at s = 0."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], 0.0)


def right_jacobian(tangent: Tangent) -> Entries:
    """Jr with exp(τ + δ) = exp(τ) exp(Jr δ) to first order (Solà et al. 2018, eq. 163)."""
    v_x, v_y, omega = tangent
    t = omega * omega
    cos_half, sin_half = angle.half_angle(t)
    sinc, versine = 2.0 * cos_half * sin_half, 2.0 * sin_half * sin_half
    rest = angle.sin_remainder(t, sinc) * omega
    turn = versine * omega
    return (
        (sinc, turn, rest * v_x - versine * v_y),
        (-turn, sinc, versine * v_x + rest * v_y),
        (0.0, 0.0, 1.0),
    )


def right_jacobian_inverse(tangent: Tangent) -> Entries:
    """Jr⁻¹, the derivative of Log(exp(τ) exp(δ)) at δ = 0."""
    v_x, v_y, omega = tangent
    cot, remainder = _half_cot(omega)
    half, rest = 0.5 * omega, remainder * omega
    return (
        (cot, -half, rest * v_x + 0.5 * v_y),
        (half, cot, rest * v_y - 0.5 * v_x),
        (0.0, 0.0, 1.0),
    )


def normalize(a: Element) -> Element:
    """The rotation scaled to unit length."""
    cos, sin, x, y = a
    scale = 1.0 / namespace(cos, sin).sqrt(cos * cos + sin * sin)
    return (cos * scale, sin * scale, x, y)


def to_matrix(a: Element) -> Entries:
    """Homogeneous 3x3."""
    cos, sin, x, y = a
    return ((cos, -sin, x), (sin, cos, y), (0.0, 0.0, 1.0))


def from_matrix(matrix: Any) -> Element:
    """From the entries of a homogeneous 3x3 matrix; rounding of the rotation is removed."""
    cos = 0.5 * (matrix[0][0] + matrix[1][1])
    sin = 0.5 * (matrix[1][0] - matrix[0][1])
    return normalize((cos, sin, matrix[0][2], matrix[1][2]))
