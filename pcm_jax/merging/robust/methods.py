"""The robust methods by name: published weights, their parameters and what accepts a closure.

Each is a function of the gate γ², the degrees of freedom d and its own options, and returns how
weights follow from squared residuals (`Reweighting`). All need an initial guess.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from pcm_jax.errors import InputError
from pcm_jax.merging.robust.weights import (
    dcs_scale,
    max_mixture_weight,
    null_crossover,
    switch,
    truncated_weight,
)

ACCEPTED_SCALE = 0.5
ONE_STEP = 2
"""Evaluations: of the start, and of where the step led."""
TO_THE_END = 30
GRADUALLY = 10
"""Evaluations where the next turn's weights are others anyway; the last turns need fewer."""
GROWTH = 1.4
"""Of μ from turn to turn (Yang et al. 2020)."""
START_OPTIONS = ("initial", "anchors")

Weights = Float[np.ndarray, " m"]


class Reweighting(NamedTuple):
    """A robust method, once its options are known.

    Attributes:
        update: from χ² and the state to the weights and the next state; None at first.
        evaluations: of the cost, at most, in each turn's solve.
        binary: whether it is only over when every weight is 0 or 1.
    """

    update: Callable[[Weights, Any], tuple[Weights, Any]]
    evaluations: int = ONE_STEP
    binary: bool = False


def dcs(gate: float, dof: int, *, phi: float = 5.0) -> Reweighting:
    """Dynamic covariance scaling.

    P. Agarwal, G. D. Tipaldi, L. Spinello, C. Stachniss and W. Burgard, "Robust map optimization
    using dynamic covariance scaling", ICRA 2013.

    Args:
        gate, dof: not used.
        phi: φ; accepted are closures with χ² ≤ 3φ.
    """
    del gate, dof
    _require_positive("phi", phi)
    return Reweighting(lambda squared, state: (dcs_scale(squared, phi) ** 2, state))


def switchable(gate: float, dof: int, *, prior: float | None = None) -> Reweighting:
    """Switchable constraints, the switches eliminated in closed form.

    N. Sünderhauf and P. Protzel, "Switchable constraints for robust pose graph SLAM", IROS 2012.

    Args:
        gate: γ².
        dof: not used.
        prior: Ξ, by default γ², so that closures with χ² ≤ γ² are accepted. Published is 1: of
            right closures in 2D, one in five has χ² ≤ 1.
    """
    del dof
    prior = gate if prior is None else prior
    _require_positive("prior", prior)
    return Reweighting(lambda squared, state: (switch(squared, prior) ** 2, state))


def max_mixture(
    gate: float, dof: int, *, null_scale: float = 1e-9, null_weight: float = 0.5
) -> Reweighting:
    """Max-mixture with a null hypothesis.

    E. Olson and P. Agarwal, "Inference on networks of mixtures for robust robot mapping", IJRR
    2013.

    Args:
        gate: not used.
        dof: d.
        null_scale: κ, the null hypothesis has information κΩ.
        null_weight: its weight, the inlier's being one minus it. By default the null hypothesis is
            the likelier from χ² = 62 on in 2D, 124 in 3D. A crossover as tight as the 99 % gate
            gives up right closures at once where the maps' own drift strains them.
    """
    del gate
    if not 0.0 < null_scale < ACCEPTED_SCALE**2:
        raise InputError(f"null_scale: {null_scale}, expected above 0 and below 0.25")
    if not 0.0 < null_weight < 1.0:
        raise InputError(f"null_weight: {null_weight}, expected above 0 and below 1")
    crossover = null_crossover(null_scale, null_weight, dof)
    return Reweighting(
        lambda squared, state: (max_mixture_weight(squared, crossover, null_scale), state),
        TO_THE_END,
    )


def gnc(gate: float, dof: int) -> Reweighting:
    """Graduated non-convexity with truncated least squares.

    H. Yang, P. Antonante, V. Tzoumas and L. Carlone, "Graduated non-convexity for robust spatial
    perception", RA-L 2020.

    The edges inside the maps are the known inliers. First all closures count in full; the largest
    χ² at the start and at that solution sets μ, which then grows until every weight is 0 or 1. At
    that solution alone it would be too small: maps that all closures bend spring back as soon as
    these count less, and leave every one of them beyond the reach of μ.

    Args:
        gate: γ².
        dof: not used.
    """
    del dof

    def update(squared: Weights, state: _Schedule | None) -> tuple[Weights, _Schedule]:
        everything = np.ones_like(squared)
        if state is None:
            return everything, _Schedule(float(squared.max()))
        if state.control is None and 2.0 * squared.max() <= gate:  # all fit as they are
            return everything, state
        largest = max(state.largest, float(squared.max()))
        control = GROWTH * state.control if state.control else gate / (2.0 * largest - gate)
        return truncated_weight(squared, gate, control), _Schedule(state.largest, control)

    return Reweighting(update, GRADUALLY, binary=True)


def from_here(gate: float) -> Reweighting:
    """Graduated non-convexity from poses that are believed already.

    As `gnc`, but the first weights are those of the residuals where it starts: not all one, which
    would let every false closure pull at once and forget the start.

    Args:
        gate: γ².
    """

    def update(squared: Weights, control: float | None) -> tuple[Weights, float]:
        if control is not None:
            control = GROWTH * control
        else:
            largest = 2.0 * float(squared.max())
            control = gate / (largest - gate) if largest > gate else math.inf
        if math.isinf(control):
            return (squared <= gate).astype(float), control
        return truncated_weight(squared, gate, control), control

    return Reweighting(update, GRADUALLY, binary=True)


class _Schedule(NamedTuple):
    largest: float  # χ² at the start
    control: float | None = None  # μ


ROBUST_METHODS: dict[str, Callable[..., Reweighting]] = {
    "dcs": dcs,
    "gnc": gnc,
    "switchable": switchable,
    "max-mixture": max_mixture,
}


def check_robust_options(method: str, options: dict[str, Any]) -> None:
    """Raises `InputError` for an option that a robust method does not have."""
    own = inspect.signature(ROBUST_METHODS[method]).parameters.values()
    known = [*START_OPTIONS, *(p.name for p in own if p.kind is p.KEYWORD_ONLY)]
    for option in options:
        if option not in known:
            raise InputError(
                f"{option}: not an option of method {method!r}, expected one of {', '.join(known)}"
            )


def _require_positive(name: str, value: float) -> None:
    if not value > 0.0:
        raise InputError(f"{name}: {value}, expected above 0")
