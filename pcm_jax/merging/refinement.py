"""`Refinement`: the changes that refining made to a selection, and the joint test of the rest."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from pcm_jax.consistency.joint import survival
from pcm_jax.graph import PoseGraph


class JointTest(NamedTuple):
    """The joint χ² of a set of closures, and its degrees of freedom.

    Attributes:
        chi2: by how much the χ² of the maps rises when they are merged by the set.
        dof: its degrees of freedom.
    """

    chi2: float
    dof: int

    @property
    def p(self) -> float:
        """Probability that right closures have a χ² at least as large."""
        return survival(self.chi2, max(0, self.dof))


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Refinement:
    """The changes that refining made to a selection, see `merge(refine=)`.

    Attributes:
        mode: "recall" or "gnc".
        recalled: bool `[m]`, closures that were left out and are accepted now.
        dropped: bool `[m]`, closures that were accepted and are not any more; none by "recall".
        loops: bool `[e]` of each robot's map: its edges that hold; all of them by "recall".
        rounds: solves while closures came back.
        settled: whether the last one changed nothing.
        joint: the joint test of the accepted closures in the end, all groups.
    """

    mode: str
    recalled: Bool[np.ndarray, " m"]
    dropped: Bool[np.ndarray, " m"]
    loops: tuple[Bool[np.ndarray, " e"], ...]
    rounds: int
    settled: bool
    joint: JointTest

    def __repr__(self) -> str:
        joint = self.joint
        return (
            f"Refinement(by {self.mode}: {int(self.recalled.sum())} closures came back)\n"
            f"  dropped  {int(self.dropped.sum())} closures, {self.loops_dropped} loops in maps\n"
            f"  joint    chi2 {joint.chi2:.4g}, {joint.dof} degrees of freedom, p = {joint.p:.3g}"
        )

    @property
    def loops_dropped(self) -> int:
        """The number of edges inside the maps that do not hold any more."""
        return sum(int((~kept).sum()) for kept in self.loops)

    def report(self, maps: tuple[PoseGraph, ...]) -> dict[str, Any]:
        """Returns the same as plain data; the robots' own maps name the poses of loops."""
        return {
            "mode": self.mode,
            "recalled": np.flatnonzero(self.recalled).tolist(),
            "dropped": np.flatnonzero(self.dropped).tolist(),
            "loops_dropped": [
                {"a": one.pose_name(int(one.tail[edge])), "b": one.pose_name(int(one.head[edge]))}
                for one, kept in zip(maps, self.loops, strict=True)
                for edge in np.flatnonzero(~kept)
            ],
            "rounds": self.rounds,
            "settled": self.settled,
            "joint": {"chi2": self.joint.chi2, "dof": self.joint.dof, "p": self.joint.p},
        }
