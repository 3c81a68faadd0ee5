"""What `select` returns: which closures of a graph to believe, and by what evidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax.consistency import PackedGraph
from pcm_jax.errors import InputError
from pcm_jax.graph import PoseGraph
from pcm_jax.selection._distances import consistent_pairs


@dataclass(frozen=True, eq=False)
class PairSelection:
    """What was decided of the k closures between two robots.

    Attributes:
        robot_a: index of the robot with the smaller index.
        robot_b: index of the other.
        closures: int64 [k], their indices among the graph's closures, ascending.
        evidence: what the method went by: float64 [k, k], squared Mahalanobis distances (paper, eq.
            4), not symmetrised; or, where these take more than the memory limit, their graph alone.
        gate: γ².
        accepted: bool [k].
        optimal: whether no larger pairwise consistent set exists; None if the method does not say.
        upper_bound: no pairwise consistent set has more members; None likewise.
    """

    robot_a: int
    robot_b: int
    closures: Int[np.ndarray, " k"]
    evidence: Float[np.ndarray, "k k"] | PackedGraph
    gate: float
    accepted: Bool[np.ndarray, " k"]
    optimal: bool | None
    upper_bound: int | None

    @property
    def squared(self) -> Float[np.ndarray, "k k"]:
        """The squared distances.

        Raises:
            InputError: if they were not kept.
        """
        if isinstance(self.evidence, PackedGraph):
            raise InputError(
                f"squared: not kept for the {len(self.closures)} closures between robots "
                f"{self.robot_a} and {self.robot_b}, expected a larger memory_limit for them"
            )
        return self.evidence

    def consistent(self) -> Bool[np.ndarray, "k k"]:
        """The consistency graph, k² bytes."""
        if isinstance(self.evidence, PackedGraph):
            return self.evidence.dense()
        return consistent_pairs(self.evidence, self.gate)


@dataclass(frozen=True, eq=False)
class Selection:
    """Which closures of a graph to believe.

    Attributes:
        accepted: bool [m], in the order of the graph's closures.
        pairs: one `PairSelection` per pair of robots that closures join, by robot index.
        method: as given.
        confidence: as given.
        gate: γ², of all pairs.
        maps: the optimised maps that the distances were measured in.
        seconds: wall-clock time of `"optimize"`, `"marginals"`, `"consistency"` and `"clique"`.
    """

    accepted: Bool[np.ndarray, " m"]
    pairs: tuple[PairSelection, ...]
    method: str
    confidence: float
    gate: float
    maps: tuple[PoseGraph, ...]
    seconds: dict[str, float]
