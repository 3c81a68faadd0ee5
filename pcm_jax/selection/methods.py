"""Selection methods by name, on a matrix of squared distances."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float

from pcm_jax.errors import InputError
from pcm_jax.selection.choice import Choice
from pcm_jax.selection.clipper import clipper
from pcm_jax.selection.combinatorial import combinatorial
from pcm_jax.selection.pcm import pcm_exact, pcm_exact_in, pcm_heuristic, pcm_heuristic_in
from pcm_jax.selection.ransac import ransac
from pcm_jax.selection.scgp import scgp

METHODS: dict[str, Callable[..., Choice]] = {
    "pcm-exact": pcm_exact,
    "pcm-heuristic": pcm_heuristic,
    "combinatorial": combinatorial,
    "ransac": ransac,
    "scgp": scgp,
}
"""The paper's; `selection.batched` has each for many small problems at once."""
BEYOND_THE_PAPER: dict[str, Callable[..., Choice]] = {"clipper": clipper}
ALL_METHODS = METHODS | BEYOND_THE_PAPER
OF_A_GRAPH: dict[str, Callable[..., Choice]] = {
    "pcm-exact": pcm_exact_in,
    "pcm-heuristic": pcm_heuristic_in,
}
"""Those that can do with the consistency graph alone."""


def select_from(
    squared: Float[np.ndarray, "m m"] | Float[Array, "m m"],
    gate: Any,
    *,
    method: str = "pcm-exact",
    **options: Any,
) -> Bool[np.ndarray, " m"]:
    """The measurements that a method keeps, given the squared distances of all pairs.

    Args:
        squared: [m, m], `[u, v]` is q²_uv, not necessarily symmetric; the diagonal is ignored and
            NaN agrees with nothing. `squared_mahalanobis`, or one's own.
        gate: γ², the largest squared distance of two that agree, see `chi2_gate`.
        method: `"pcm-exact"`, `"pcm-heuristic"`, `"combinatorial"`, `"ransac"`, `"scgp"` or
            `"clipper"`.
        **options: the method's own: `time_limit` and `tie_break` of `"pcm-exact"`, `time_limit`
            of `"pcm-heuristic"`, `affinity` of `"scgp"`.

    Returns:
        bool [m] (NumPy).

    Raises:
        InputError: for an unknown method or option, distances that are not a square matrix of
            numbers, a gate that is not a number of at least 0.
    """
    return choose(squared, gate, method=method, **options).members


def choose(squared: Any, gate: Any, *, method: str = "pcm-exact", **options: Any) -> Choice:
    """`select_from`, with the method's certificate."""
    check_method(method, options)
    distances = np.asarray(squared)
    if distances.ndim != 2 or distances.shape[0] != distances.shape[1]:
        raise InputError(f"squared: shape {distances.shape}, expected [m, m]")
    if distances.dtype.kind not in "iuf":
        raise InputError(f"squared: dtype {distances.dtype}, expected numbers")
    if np.ndim(gate) != 0 or not float(gate) >= 0.0:
        raise InputError(f"gate: {gate}, expected one number of at least 0")
    return ALL_METHODS[method](distances.astype(np.float64), float(gate), **options)


def check_method(method: str, options: dict[str, Any]) -> None:
    """Raises `InputError` for a method, or an option of it, that does not exist."""
    if method not in ALL_METHODS:
        raise InputError(f"method: {method!r}, expected one of {', '.join(ALL_METHODS)}")
    parameters = inspect.signature(ALL_METHODS[method]).parameters.values()
    known = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]
    for option in options:
        if option not in known:
            expected = f"expected one of {', '.join(known)}" if known else "it has none"
            raise InputError(f"{option}: not an option of method {method!r}, {expected}")
