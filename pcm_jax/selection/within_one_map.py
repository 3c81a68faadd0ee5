"""`WithinSelection`: the loop closures inside one robot's own map to believe, and why."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax.graph import PoseGraph


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class WithinSelection:
    """The decision on the m loop closures among the e edges of one map.

    Attributes:
        graph: the map without the rejected edges; poses, ids, name and information are the given
            ones.
        kept: bool [e], false for rejected closures.
        odometry: bool [e], the edges that were taken as odometry; never rejected.
        closures: int64 [m], the indices of all other edges, ascending.
        squared: float64 [m, m], squared Mahalanobis distances of pairs, not symmetrised, with
            odometry's errors as large as `odometry_scale` says.
        own_squared: float64 [m], of each closure's loop with odometry alone, likewise.
        gate: γ², of either.
        accepted: bool [m], the largest set less what left it, and what came back.
        recalled: bool [m], those that the largest set leaves out and the map agrees with.
        dropped: bool [m], those of the largest set that the map contradicts.
        optimal: whether no larger pairwise consistent set exists (under `own_loop`: among the
            closures that agree with odometry); None if the method does not say.
        upper_bound: no such set has more members; None likewise.
        seconds: wall-clock time of `"consistency"`, `"clique"`, `"chance"`, `"recheck"` where it
            was asked for, and `"recall"`.
        odometry_scale: the factor on the standard deviations that odometry states under which it
            was tested; 1: as stated.
        verdict: why the closures found are accepted or not, see `integrity.Verdict`.
    """

    graph: PoseGraph
    kept: Bool[np.ndarray, " e"]
    odometry: Bool[np.ndarray, " e"]
    closures: Int[np.ndarray, " m"]
    squared: Float[np.ndarray, "m m"]
    own_squared: Float[np.ndarray, " m"]
    gate: float
    accepted: Bool[np.ndarray, " m"]
    recalled: Bool[np.ndarray, " m"]
    dropped: Bool[np.ndarray, " m"]
    optimal: bool | None
    upper_bound: int | None
    seconds: dict[str, float]
    odometry_scale: float = 1.0
    verdict: Any = None

    def __repr__(self) -> str:
        proof = {None: "not looked for", True: "proven", False: f"at most {self.upper_bound}"}
        count, less = int(self.recalled.sum()), int(self.dropped.sum())
        back = f"; {less} dropped by recheck" if less else ""
        back += f"; {count} more by recall" if count else ""
        why = f"\n  verdict      {self.verdict.why}" if self.verdict else ""
        return (
            f"WithinSelection({int(self.accepted.sum())} of {len(self.accepted)} closures accepted)"
            f"\n  map          {self.graph!r}\n"
            f"  largest set  {proof[self.optimal]}, gate {self.gate:.4g}{back}{why}"
        )

    @property
    def inliers(self) -> Bool[np.ndarray, " e"]:
        """The former name of `kept`."""
        return self.kept
