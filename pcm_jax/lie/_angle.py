"""Scalar functions of the squared rotation angle t = θ², accurate at every angle.

exp, log and the Jacobians of SE(2) and SE(3) are built from these. Each has the form
(something that tends to zero with t) / t, which cancels for small angles; below one radian it is
therefore summed as a power series in t. The unused branch of each `where` is evaluated at a
harmless argument, so first and second derivatives are finite at zero as well.

All functions take and return NumPy or JAX arrays of any shape and keep their dtype.
"""

from __future__ import annotations

from fractions import Fraction
from math import factorial
from typing import Any

from pcm_jax.arrays import namespace

# At θ < 1 the series below reach 1e-17; at θ ≥ 1 the quotients lose less than one digit.
SERIES_BELOW = 1.0


def _alternating(offset: int, terms: int = 10) -> list[float]:
    """(-1)^k / (2k + offset)!"""
    return [(-1) ** k / factorial(2 * k + offset) for k in range(terms)]


def _bernoulli(count: int) -> list[Fraction]:
    numbers = [Fraction(1)]
    for n in range(1, count):
        choose = Fraction(1)
        total = Fraction(0)
        for k in range(n):
            total += choose * numbers[k]
            choose = choose * (n + 1 - k) / (k + 1)
        numbers.append(-total / (n + 1))
    return numbers


def _derivative(coefficients: list[float]) -> list[float]:
    return [k * c for k, c in enumerate(coefficients)][1:]


_COS_HALF = [(-1) ** k / (4**k * factorial(2 * k)) for k in range(10)]
_SIN_HALF = [(-1) ** k / (2 * 4**k * factorial(2 * k + 1)) for k in range(10)]
_COS_REMAINDER = _alternating(2, 11)
_SIN_REMAINDER = _alternating(3, 11)
# x cot x = 1 - Σ 2^(2k) |B_2k| x^(2k) / (2k)! at x = θ/2.
_COT_REMAINDER = [float(abs(b)) / factorial(2 * k) for k, b in enumerate(_bernoulli(26)[::2])][1:]


def polynomial(coefficients: list[float], t: Any) -> Any:
    """Σ cₖ tᵏ by Horner's rule."""
    total = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        total = total * t + coefficient
    return total


def _quotient(numerator: Any, t: Any, series: list[float]) -> Any:
    """`numerator / t`, by its power series where t is small."""
    xp = namespace(t)
    small = t < SERIES_BELOW
    return xp.where(
        small,
        polynomial(series, xp.where(small, t, 0.0)),
        numerator / xp.where(small, 1.0, t),
    )


def half_angle(t: Any) -> tuple[Any, Any]:
    """cos(θ/2) and sin(θ/2)/θ: everything else follows from them without trigonometry.

    With C and σ for the two: sin θ/θ = 2 C σ, (1 − cos θ)/θ² = 2 σ², (θ/2) cot(θ/2) = C / 2σ.
    """
    xp = namespace(t)
    small = t < SERIES_BELOW
    near = xp.where(small, t, 0.0)
    theta = xp.sqrt(xp.where(small, 1.0, t))
    cos_half = xp.where(small, polynomial(_COS_HALF, near), xp.cos(0.5 * theta))
    sin_half = xp.where(small, polynomial(_SIN_HALF, near), xp.sin(0.5 * theta) / theta)
    return cos_half, sin_half


def sin_remainder(t: Any, sinc: Any) -> Any:
    """(θ − sin θ)/θ³, given `sinc` = sin θ/θ."""
    return _quotient(1.0 - sinc, t, _SIN_REMAINDER)


def cot_remainder(t: Any, cot: Any) -> Any:
    """(1 − (θ/2) cot(θ/2))/θ², given `cot` = (θ/2) cot(θ/2)."""
    return _quotient(1.0 - cot, t, _COT_REMAINDER)


def cos_remainder_slope(t: Any, sinc: Any, cos_remainder: Any) -> Any:
    """d/dt of (1 − cos θ)/θ², given sin θ/θ and the function itself."""
    return _quotient(0.5 * sinc - cos_remainder, t, _derivative(_COS_REMAINDER))


def sin_remainder_slope(t: Any, cos_remainder: Any, sin_remainder: Any) -> Any:
    """d/dt of (θ − sin θ)/θ³, given (1 − cos θ)/θ² and the function itself."""
    return _quotient(0.5 * (cos_remainder - 3.0 * sin_remainder), t, _derivative(_SIN_REMAINDER))


def cot_remainder_slope(t: Any, cot: Any, cot_remainder: Any) -> Any:
    """d/dt of `cot_remainder`, given (θ/2) cot(θ/2) and the function itself."""
    return _quotient(0.125 - cot_remainder * (1.0 + 0.5 * cot), t, _derivative(_COT_REMAINDER))
