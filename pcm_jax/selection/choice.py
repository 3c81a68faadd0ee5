"""What every selection method returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool


@dataclass(frozen=True, eq=False)
class Choice:
    """The measurements a method keeps of m.

    Attributes:
        members: bool [m] (NumPy).
        optimal: whether it is proven that no larger pairwise consistent set exists; None for a
            method that looks for something else.
        upper_bound: no pairwise consistent set has more members; None likewise.
    """

    members: Bool[np.ndarray, " m"]
    optimal: bool | None = None
    upper_bound: int | None = None
