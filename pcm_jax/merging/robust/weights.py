"""Weights of closures, given how badly they fit: the kernels of the robust merge.

Each turns squared residuals χ² = rᵀΩr into factors w of the information. Pure functions of arrays,
NumPy's or JAX's, of any shape; elementwise.

    dynamic covariance scaling   s = min(1, 2φ / (φ + χ²)),  w = s²
    switchable constraints       s = Ξ / (Ξ + χ²),           w = s²
    truncated least squares      0, 1 or between, by a control parameter μ that sharpens it
    max-mixture                  1, or a small constant beyond the mixture's crossover
"""

from __future__ import annotations

import math
from typing import Any

from jaxtyping import Float


def dcs_scale(squared: Float[Any, "*m"], phi: float) -> Float[Any, "*m"]:
    """The scale s of dynamic covariance scaling (Agarwal et al., ICRA 2013): min(1, 2φ/(φ + χ²)).

    The cost there, s²χ² + φ(1 − s)², is χ² up to φ and the constant φ beyond. The function whose
    reweighted least squares use w = s² goes on to rise: (3φχ² − φ²)/(φ + χ²), towards 3φ.

    Args:
        squared: χ².
        phi: φ, at and below which nothing is scaled.
    """
    xp = squared.__array_namespace__()
    return xp.minimum(2.0 * phi / (phi + squared), xp.ones_like(squared))


def switch(squared: Float[Any, "*m"], prior: float) -> Float[Any, "*m"]:
    """The best switch of a switchable constraint (Sünderhauf and Protzel, IROS 2012).

    Eliminated in closed form: s²χ² + Ξ(1 − s)² is least at s = Ξ/(Ξ + χ²), where it is
    Ξχ²/(Ξ + χ²).

    Args:
        squared: χ².
        prior: Ξ, information of the switch about 1.
    """
    return prior / (prior + squared)


def truncated_weight(squared: Float[Any, "*m"], gate: float, control: float) -> Float[Any, "*m"]:
    """The factor w of graduated truncated least squares (Yang et al., RA-L 2020).

    1 up to μ/(μ + 1) γ², 0 from (μ + 1)/μ γ², between them `γ/χ √(μ(μ + 1)) − μ`. μ → ∞ gives the
    truncated least squares min(χ², γ²) themselves.

    Args:
        squared: χ².
        gate: γ², the squared residual beyond which a closure is false.
        control: μ, positive.
    """
    xp = squared.__array_namespace__()
    no_less = xp.maximum(squared, xp.full_like(squared, gate * control / (control + 1.0)))
    between = xp.sqrt(gate * control * (control + 1.0) / no_less) - control
    return xp.clip(between, 0.0, 1.0)


def null_crossover(null_scale: float, null_weight: float, dof: int) -> float:
    """χ² beyond which the null hypothesis of a max-mixture is the likelier component.

    Equates χ² − 2 log(1 − w₀) with κχ² − 2 log w₀ − d log κ.

    Args:
        null_scale: κ, the null hypothesis has information κΩ.
        null_weight: w₀, its weight in the mixture.
        dof: d.
    """
    odds = math.log1p(-null_weight) - math.log(null_weight)
    return max(0.0, (2.0 * odds - dof * math.log(null_scale)) / (1.0 - null_scale))


def max_mixture_weight(
    squared: Float[Any, "*m"], crossover: float, null_scale: float
) -> Float[Any, "*m"]:
    """The factor w of the likelier component (Olson and Agarwal, IJRR 2013): 1, or κ.

    Args:
        squared: χ².
        crossover: χ² beyond which it is the null hypothesis, see `null_crossover`.
        null_scale: κ.
    """
    xp = squared.__array_namespace__()
    return xp.where(squared <= crossover, 1.0, null_scale)
