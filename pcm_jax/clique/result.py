"""A clique and how far it is proven to be the largest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool


@dataclass(frozen=True, eq=False, repr=False)
class Clique:
    """A clique of a graph with m nodes, with its certificate.

    Attributes:
        members: bool [m] (NumPy), True for the nodes of the clique.
        size: how many there are.
        optimal: whether it is proven that no clique is larger.
        upper_bound: no clique of the graph has more members than this; equals `size` if and only
            if `optimal`.
        seconds: wall-clock time of the search.
    """

    members: Bool[np.ndarray, " m"]
    size: int
    optimal: bool
    upper_bound: int
    seconds: float

    def __repr__(self) -> str:
        proof = "proven the largest" if self.optimal else f"none has more than {self.upper_bound}"
        named = ", ".join(map(str, np.flatnonzero(self.members)[:8].tolist()))
        return (
            f"Clique({self.size} of {len(self.members)} nodes)\n"
            f"  members      {named}{' …' if self.size > 8 else ''}\n"
            f"  certificate  {proof}, {self.seconds:.2g} s"
        )
