"""One method, by name or as a function, on the evidence of one pair of robots."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float

from pcm_jax.arrays import as_array, as_real
from pcm_jax.consistency import PairEvidence
from pcm_jax.errors import InputError, InputWarning
from pcm_jax.selection.method import Choice
from pcm_jax.selection.methods import METHODS

A_CONFIDENCE = 0.9
"""From here to 1 a gate is more likely meant to be a confidence."""
Method = str | Callable[[PairEvidence, float], Bool[np.ndarray, " k"]]
"""A name of `METHODS`, or a function of one's own: bool [k] from the evidence and γ²."""


def select_from(
    squared: Float[np.ndarray, "m m"] | Float[Array, "m m"],
    gate: Any,
    *,
    method: Method = "pcm-exact",
    with_certificate: bool = False,
    **options: Any,
) -> Any:
    """Selects the measurements to keep, given the squared distances of all pairs.

        squared = pcm_jax.squared_mahalanobis(problem)
        accepted = pcm_jax.select_from(squared, pcm_jax.chi2_gate(0.99, dof=3))

    Args:
        squared: [m, m], `[u, v]` is q²_uv, not necessarily symmetric; the diagonal is ignored and
            NaN agrees with nothing. `squared_mahalanobis`, or one's own.
        gate: γ², the largest squared distance of two that agree, see `chi2_gate`.
        method: `"pcm-exact"`, `"pcm-heuristic"`, `"combinatorial"`, `"ransac"`, `"scgp"` or
            `"clipper"`; or a function `(evidence, gate) -> bool [m]`, whose evidence has `squared`
            and `consistent(gate)`. `"jcbb"` needs the maps too, which `select` has.
        with_certificate: whether to return the `Choice`: `members`, and the method's certificate.
        **options: the method's own: `weights`, `time_limit` and `tie_break` of `"pcm-exact"`,
            `weights` and `time_limit` of `"pcm-heuristic"`, `affinity` of `"scgp"`.

    Returns:
        bool [m] (NumPy), or the `Choice`.

    Raises:
        InputError: for an unknown method or option, distances that are not a square matrix of
            numbers, a gate that is not a number of at least 0, a method that needs the maps.

    Warns:
        InputWarning: for a gate between 0.9 and 1, which is a confidence by the look of it.
    """
    check_method(method, options)
    squared = as_array(squared, "squared")
    check_gate(gate)
    if A_CONFIDENCE <= float(gate) < 1.0:
        warnings.warn(
            f"gate: {float(gate):g}, expected a squared distance γ²: for a confidence of"
            f" {float(gate):g} it is chi2_gate({float(gate):g}, dof)",
            InputWarning,
            stacklevel=2,
        )
    choice = choose(PairEvidence.from_squared(squared), gate, method=method, **options)
    return choice if with_certificate else choice.members


def choose(
    evidence: PairEvidence, gate: Any, *, method: Method = "pcm-exact", **options: Any
) -> Choice:
    """Lets a method choose among the closures between two robots; see `select_from`.

    Raises:
        InputError: as `select_from`; for `"jcbb"` only where the evidence is of distances alone.
    """
    check_method(method, options)
    gate = check_gate(gate)
    if not isinstance(method, str):
        return Choice(_checked_mask(method(evidence, gate), len(evidence), name_of(method)))
    if METHODS[method].choose is None:
        if evidence.covariances is None:
            raise InputError(
                f"method: {method!r} needs the maps' covariances, expected the evidence of two maps"
                " that `weigh` gives, as in select(graph, method=…)"
            )
        return METHODS[method].choose_from(evidence, gate, **options)  # type: ignore[misc]
    if evidence.is_streamed and not needs_distances(method, options):
        own = {name: value for name, value in options.items() if name != "tie_break"}
        return METHODS[method].choose_in(evidence.consistent(gate), **own)  # type: ignore[misc]
    return METHODS[method].choose(evidence.comparable, gate, **options)  # type: ignore[misc]


def check_gate(gate: Any) -> float:
    """One number of at least 0; `InputError` for anything else."""
    value = as_real(gate, "gate")
    if value.ndim or not value >= 0.0:
        raise InputError(f"gate: {gate}, expected one number of at least 0")
    return float(value)


def needs_distances(method: Method, options: dict[str, Any]) -> bool:
    """True for a method that cannot do with the consistency graph alone."""
    if not isinstance(method, str):
        return False  # a function asks the evidence for what it needs
    by_distance = options.get("tie_break", "index") != "index"
    of_graph = METHODS[method].choose_in or METHODS[method].choose_from
    return of_graph is None or by_distance


def name_of(method: Method) -> str:
    """The method's name; of a function its own."""
    return method if isinstance(method, str) else getattr(method, "__name__", "function")


def check_method(method: Method, options: dict[str, Any], also: Iterable[str] = ()) -> None:
    """Raises `InputError` for a method, or an option of it, that does not exist.

    Args:
        method: a name, or a function, which has no options.
        options: by name.
        also: further names that the caller knows.
    """
    if callable(method):
        known: tuple[str, ...] = ()
    elif isinstance(method, str) and method in METHODS:
        known = METHODS[method].options
    else:
        names = ", ".join((*METHODS, *also))
        raise InputError(f"method: {method!r}, expected one of {names}, or a function")
    for option in options:
        if option not in known:
            expected = f"expected one of {', '.join(known)}" if known else "it has none"
            name = name_of(method)
            raise InputError(f"{option}: not an option of method {name!r}, {expected}")


def _checked_mask(members: Any, count: int, name: str) -> Bool[np.ndarray, " k"]:
    mask = np.asarray(members)
    if mask.dtype != bool or mask.shape != (count,):
        raise InputError(
            f"method: {name!r} returned {mask.dtype} {list(mask.shape)}, expected bool [{count}]"
        )
    return mask.copy()
