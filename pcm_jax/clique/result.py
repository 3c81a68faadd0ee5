"""A clique and how far it is proven to be the largest, or the heaviest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool


class CliqueInterrupt(KeyboardInterrupt):
    """An interrupt, as by Ctrl-C, of a search for a clique, with the best answer so far.

        try:
            clique = pcm_jax.maximum_clique(consistent)
        except pcm_jax.clique.CliqueInterrupt as interrupt:
            clique = interrupt.clique

    Attributes:
        clique: the best one found until then; its bounds are those of the degrees.
    """

    def __init__(self, clique: Clique):
        super().__init__(f"a clique of {clique.size} was found, none has {clique.upper_bound + 1}")
        self.clique = clique


@dataclass(frozen=True, eq=False, repr=False)
class Clique:
    """A clique of a graph with m nodes, with its certificate.

    Attributes:
        members: bool [m] (NumPy), True for the nodes of the clique.
        size: how many there are.
        optimal: whether it is proven that no clique is larger; with weights, that none is heavier
            (floats: by more than a 10^12th).
        upper_bound: no clique of the graph has more members than this; equals `size` if and only
            if `optimal`. With weights, the heaviest clique is not one of most members, and this is
            a bound on any clique's members by degrees alone: it says nothing of the weight.
        seconds: wall-clock time of the search.
        weight: of the clique, in the unit of the weights, an int where they are integers; without
            weights `size`.
        weight_bound: no clique of the graph weighs more than this; equals `weight` if and only if
            `optimal`. Without weights `upper_bound`.
    """

    members: Bool[np.ndarray, " m"]
    size: int
    optimal: bool
    upper_bound: int
    seconds: float
    weight: float
    weight_bound: float

    def __repr__(self) -> str:
        weighted = (self.weight, self.weight_bound) != (self.size, self.upper_bound)
        if weighted:
            proof = f"none weighs more than {self.weight_bound:.6g}"
            proof = "proven the heaviest" if self.optimal else proof
        else:
            proof = f"none has more than {self.upper_bound}"
            proof = "proven the largest" if self.optimal else proof
        weight = f", weight {self.weight:.6g}" if weighted else ""
        named = ", ".join(map(str, np.flatnonzero(self.members)[:8].tolist()))
        return (
            f"Clique({self.size} of {len(self.members)} nodes{weight})\n"
            f"  members      {named}{' …' if self.size > 8 else ''}\n"
            f"  certificate  {proof}, {self.seconds:.2g} s"
        )
