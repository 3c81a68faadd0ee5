"""The result of `select`: which closures of a graph to believe, and by what evidence."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax.consistency import (
    Evidence,
    JointConsistency,
    PairEvidence,
    joint_consistency,
)
from pcm_jax.graph import PoseGraph
from pcm_jax.selection.method import Choice
from pcm_jax.tables import NOTHING, ShownAsTable


@dataclass(frozen=True, eq=False, repr=False)
class PairSelection:
    """The decision on the k closures between two robots.

    Attributes:
        evidence: what the method went by.
        gate: γ².
        accepted: bool [k].
        optimal: whether no larger pairwise consistent set exists (where weights decided: no heavier
            one); None if the method does not say.
        upper_bound: no pairwise consistent set has more members; None likewise.
        found: how many members the method's set had, also where it was not accepted.
        weight: of the method's set, where the closures' weights decided; else None.
        weight_bound: no pairwise consistent set weighs more; None likewise.
        verdict: why it was accepted or not, see `integrity.Verdict`.
        members: bool [k], the method's set, whether it was accepted or not.
    """

    evidence: PairEvidence
    gate: float
    accepted: Bool[np.ndarray, " k"]
    optimal: bool | None
    upper_bound: int | None
    found: int
    weight: float | None = None
    weight_bound: float | None = None
    verdict: Any = None
    members: Bool[np.ndarray, " k"] | None = None

    @classmethod
    def of_choice(
        cls,
        evidence: PairEvidence,
        gate: float,
        choice: Choice,
        verdict: Any,
        joint: JointConsistency | None = None,
    ) -> PairSelection:
        """The decision on a method's choice, with its certificate.

        `joint` is the test of all members or of some, where it has been made already.
        """
        found = int(np.count_nonzero(choice.members))
        proof = choice.optimal, choice.upper_bound, found, choice.weight, choice.weight_bound
        accepted = choice.members & verdict.believed
        made = cls(evidence, gate, accepted, *proof, verdict, choice.members)
        if joint is not None and verdict.believed and joint.asked == found:
            made.__dict__["joint"] = joint  # where `cached_property` keeps it
        return made

    def __repr__(self) -> str:
        most = self.upper_bound if self.weight is None else f"weight {self.weight_bound:.6g}"
        proof = {None: "not looked for", True: "proven", False: f"at most {most}"}
        weight = "" if self.weight is None else f" of weight {self.weight:.6g},"
        why = self.verdict.why if self.verdict else f"{self.found} found"
        return (
            f"PairSelection(robots {self.robot_a} and {self.robot_b})\n"
            f"  accepted  {int(self.accepted.sum())} of {len(self.accepted)}; largest set"
            f"{weight} {proof[self.optimal]}, gate {self.gate:.4g}\n"
            f"  verdict   {why}"
        )

    def row(self, names: Sequence[str]) -> tuple[object, ...]:
        """The decision as a row of a table.

        Args:
            names: the robots'.
        """
        verdict = self.verdict
        chance = verdict.chance if verdict else None
        proof = {None: NOTHING, True: "proven", False: "not proven"}
        return (
            f"{names[self.robot_a]} – {names[self.robot_b]}",
            len(self.accepted),
            int(self.accepted.sum()),
            verdict.places if verdict and verdict.places is not None else NOTHING,
            f"{chance.p_value:.2g}" if chance else NOTHING,
            proof[self.optimal],
            verdict.why if verdict else NOTHING,
        )

    @property
    def robot_a(self) -> int:
        """The index of the robot with the smaller index."""
        return self.evidence.robot_a

    @property
    def robot_b(self) -> int:
        """The index of the other."""
        return self.evidence.robot_b

    @property
    def closures(self) -> Int[np.ndarray, " k"]:
        """The closures' indices among the graph's closures, ascending."""
        return self.evidence.closures

    @property
    def squared(self) -> Float[np.ndarray, "k k"]:
        """The squared distances; see `PairEvidence.squared`."""
        return self.evidence.squared

    @functools.cached_property
    def joint(self) -> JointConsistency | None:
        """The test of whether all accepted closures are right together; None where none is."""
        return joint_consistency(self.evidence, self.accepted) if self.accepted.any() else None

    def consistent(self) -> Bool[np.ndarray, "k k"]:
        """The consistency graph at the gate, k² bytes."""
        return self.evidence.consistent(self.gate)


@dataclass(frozen=True, eq=False, repr=False)
class Selection(ShownAsTable):
    """The closures of a graph to believe.

    Attributes:
        accepted: bool [m], in the order of the graph's closures.
        pairs: one `PairSelection` per pair of robots that closures join, by robot index.
        method: as given; of a function its name.
        confidence: as given.
        gate: γ², of all pairs.
        evidence: what `weigh` found, for further questions.
        seconds: wall-clock time of `"optimize"`, `"marginals"`, `"consistency"`, `"clique"` and
            `"chance"`; those of the evidence are what it took when it was made.
        team: the cycles of robots over believed pairs, see `integrity.Cycle`.
        waiting: closures that wait for poses that have not come yet, see `IncrementalPcm`.
    """

    accepted: Bool[np.ndarray, " m"]
    pairs: tuple[PairSelection, ...]
    method: str
    confidence: float
    gate: float
    evidence: Evidence
    seconds: dict[str, float]
    team: tuple[Any, ...] = ()
    waiting: int = 0

    def __repr__(self) -> str:
        names = self.evidence.graph.names
        told = [
            f"{names[p.robot_a]}-{names[p.robot_b]} {int(p.accepted.sum())} of {len(p.accepted)}"
            for p in self.pairs
        ]
        return (
            f"Selection({int(self.accepted.sum())} of {len(self.accepted)} closures accepted)\n"
            f"  pairs   {', '.join(told) or 'none'}\n"
            f"  method  {self.method}, confidence {self.confidence:g}, gate {self.gate:.4g}"
        )

    def _table(self) -> tuple[Sequence[str], Iterable[Sequence[object]]]:
        names = self.evidence.graph.names
        heads = ("robots", "measured", "accepted", "places", "chance p", "largest set", "why")
        return heads, (pair.row(names) for pair in self.pairs)

    @property
    def maps(self) -> tuple[PoseGraph, ...]:
        """The optimised maps that the distances were measured in."""
        return self.evidence.maps
