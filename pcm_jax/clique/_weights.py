"""Weights of vertices, checked once at the entrance, and as whole numbers for the search.

Sums of whole numbers are exact in any order, so that equal weights are recognised. Floats become
multiples of a unit 2^-62 of the largest; of their totals, those that agree to 12 digits are equal,
as for squared distances.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int, Num

from pcm_jax.arrays import as_array
from pcm_jax.errors import InputError

_DIGITS = 10**12
_UNIT_BITS = 62
# Float64 adds whole numbers up to 2^53 exactly: 2^20 vertices of coarse weights up to 2^32.
_COARSE_BITS = 32


class Weights(NamedTuple):
    """Weights as given and as multiples of a unit.

    Attributes:
        given: float64 or integers [m], finite, at least 0.
        units: per vertex, a whole number; 0 only where the weight is.
        tolerance: totals in units that differ by less than a 10^12th are equal, if 1; if 0, none
            but equal ones are.
    """

    given: Num[np.ndarray, " m"]
    units: list[int]
    tolerance: int

    @property
    def equal(self) -> bool:
        """True where all weights are the same, and not 0."""
        return len(set(self.units)) < 2 and 0 not in self.units

    def total(self, vertices: Int[np.ndarray, " k"]) -> float:
        """The weight of a set, an int where the weights are."""
        values = self.given[vertices].tolist()
        return math.fsum(values) if self.given.dtype.kind == "f" else sum(values)

    def slack(self, total: int) -> int:
        """The amount, in units, by which a lighter sum is still equal to `total`."""
        return self.tolerance * total // _DIGITS

    def certificate(
        self, vertices: Int[np.ndarray, " k"], most: int, bound: float = math.inf
    ) -> tuple[float, float]:
        """The weight of a clique, and what no clique weighs more than.

        Args:
            vertices: of the clique.
            most: no clique has more members.
            bound: no clique weighs more units.

        Returns:
            the two; the same number twice if the clique is as heavy as any.
        """
        weight = self.total(vertices)
        units = sum(self.units[vertex] for vertex in vertices)
        bound = min(bound, sum(sorted(self.units, reverse=True)[:most]))
        if bound <= units + self.slack(units):
            return weight, weight
        return weight, self._of_units(int(bound))

    def _of_units(self, total: int) -> float:
        """The weight for a sum of units, rounded up."""
        if self.given.dtype.kind != "f":
            return total
        largest = int(np.argmax(self.given))
        ratio = total / self.units[largest]
        return math.nextafter(float(self.given[largest]) * ratio * (1 + 1e-15), math.inf)

    def coarse(self) -> tuple[Float[np.ndarray, " m"], int]:
        """Whole numbers that float64 adds up exactly: units over a power of two, rounded up.

        Returns:
            float64 [m], and the exponent of the power of two.
        """
        shift = max(0, max(self.units).bit_length() - _COARSE_BITS)
        return np.array([-(-unit >> shift) for unit in self.units], np.float64), shift


def checked_weights(weights: Num[np.ndarray, " m"] | Num[Array, " m"], size: int) -> Weights:
    """The weights of `size` vertices.

    Raises:
        InputError: another shape, not real numbers, negative, not finite, or an infinite sum.
    """
    given = as_array(weights, "weights")
    if given.shape != (size,):
        raise InputError(f"weights: shape {given.shape}, expected one a node, ({size},)")
    if size and given.dtype.kind not in "iuf":
        raise InputError(f"weights: dtype {given.dtype}, expected real numbers")
    if given.dtype.kind not in "iu":
        given = given.astype(np.float64)
    wrong = ~(np.isfinite(given) & (given >= 0))
    if wrong.any():
        index = int(wrong.argmax())
        raise InputError(
            f"weights: [{index}] is {given[index]}, expected a finite number, at least 0"
        )
    with np.errstate(over="ignore"):
        if given.dtype.kind == "f" and not np.isfinite(given.sum()):
            raise InputError("weights: their sum is infinite, expected a finite one")
    return Weights(given, *_units(given))


def _units(given: np.ndarray) -> tuple[list[int], int]:
    if given.dtype.kind != "f" or (given.sum() < _DIGITS and (given % 1 == 0).all()):
        return [int(weight) for weight in given.tolist()], 0
    exponent = _UNIT_BITS - math.frexp(given.max())[1]
    return [_rounded(weight, exponent) for weight in given.tolist()], 1


def _rounded(weight: float, exponent: int) -> int:
    return max(1, round(math.ldexp(weight, exponent))) if weight else 0
