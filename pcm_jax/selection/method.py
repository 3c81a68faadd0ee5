"""A selection method, and what it returns."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from pcm_jax.errors import InputError


@dataclass(frozen=True, eq=False)
class Choice:
    """The measurements a method keeps of m.

    Attributes:
        members: bool [m] (NumPy).
        optimal: whether it is proven that no larger pairwise consistent set exists (with weights:
            no heavier one; of a jointly consistent set: no larger one that passes jointly); None
            for a method that looks for something else.
        upper_bound: no pairwise (jointly) consistent set has more members; None likewise.
        weight: of the members, where weights decided; else None.
        weight_bound: no pairwise consistent set weighs more; None likewise.
    """

    members: Bool[np.ndarray, " m"]
    optimal: bool | None = None
    upper_bound: int | None = None
    weight: float | None = None
    weight_bound: float | None = None


def _square(m: int) -> int:
    return m * m


class SelectionMethod(NamedTuple):
    """A method by its name, on the host and as a kernel.

    Attributes:
        name: as users give it.
        choose: from squared distances [m, m] and γ², with its options as keyword-only arguments,
            to a `Choice`; NumPy, any m. None for a method that needs the maps too.
        choose_in: the same from the consistency graph alone, bool [m, m], with the options but
            for `tie_break`; None for a method that needs the distances.
        kernel: the same as a pure function of one matrix and the gate, to bool [m]; None for a
            method of the host alone.
        entries: of the largest array within the kernel, by m, from which `select_batched` sizes
            its blocks of worlds; None for a kernel that shares out all worlds by itself.
        choose_from: for a method without `choose`: the same from a pair's whole `PairEvidence`,
            which has the maps, and γ²; None else.
    """

    name: str
    choose: Callable[..., Choice] | None = None
    choose_in: Callable[..., Choice] | None = None
    kernel: Callable[..., Any] | None = None
    entries: Callable[[int], int] | None = _square
    choose_from: Callable[..., Choice] | None = None

    @property
    def options(self) -> tuple[str, ...]:
        """The names of the method's own options."""
        chosen_by: Any = self.choose or self.choose_from
        parameters = inspect.signature(chosen_by).parameters.values()
        return tuple(p.name for p in parameters if p.kind is p.KEYWORD_ONLY)


def at_most(limit: int, squared: Any, method: str) -> int:
    """The number of measurements; `InputError` for more than a kernel takes."""
    m = squared.shape[-1]
    if m > limit:
        raise InputError(
            f"squared: {m} measurements, expected at most {limit} for batched method {method!r}"
        )
    return m
