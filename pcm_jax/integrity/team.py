"""Teams: around a cycle of robots, the alignments of their maps must compose to the identity.

With T_ab where the closures between a and b put map b's frame in map a's, and errors on the right,

    C = T_ab T_bc … T_za,      C exp(ε),  ε = Σ Ad(rest of the cycle)⁻¹ δ,
    χ² = Log(C)ᵀ Σ_ε⁻¹ Log(C)

has d degrees of freedom. The maps' own errors are shared by neighbouring alignments and partly
cancel in C; they are taken as independent, which makes Σ_ε too large rather than too small.

A pair of robots is dropped if more of the cycles through it fail than through any other pair, none
through it closes, and the robots hang together without it: then it is in the minority. Where
several pairs explain what fails as well (three robots: one cycle), it is told and none is dropped.
A cycle that closes proves nothing of three pairs that are wrong together.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.consistency import JointConsistency, PairEvidence, joint_consistency
from pcm_jax.consistency.joint import survival, thinned
from pcm_jax.graph.spanning_tree import connected_parts
from pcm_jax.integrity.chance import SIGNIFICANCE
from pcm_jax.integrity.rivals import JOINT
from pcm_jax.integrity.verdict import Verdict

Pair = tuple[int, int]


@dataclass(frozen=True, eq=False, repr=False)
class Cycle:
    """A cycle of robots and how well it closes.

    Attributes:
        robots: indices, in the order of the cycle.
        error: `[d]`, Log of the composed alignments: metres and radians.
        chi2: its squared Mahalanobis length.
        dof: d.
        p: probability that right alignments miss the identity by as much.
    """

    robots: tuple[int, ...]
    error: Float[np.ndarray, " d"]
    chi2: float
    dof: int
    p: float

    @property
    def pairs(self) -> tuple[Pair, ...]:
        """The pairs of robots that it leads over, each with the smaller index first."""
        return _pairs_of(self.robots)

    def __repr__(self) -> str:
        way = " → ".join(map(str, (*self.robots, self.robots[0])))
        return f"Cycle({way}, chi2 {self.chi2:.4g} with {self.dof} degrees, p {self.p:.2g})"


@on_host
def cycles_of(alignments: Mapping[Pair, JointConsistency]) -> list[Cycle]:
    """Closes the cycles of a team: all triangles, and shortest cycles for what no triangle has.

    Args:
        alignments: of pairs of robots, the smaller index first: where map b's frame lies in a's.

    Returns:
        Each cycle once, from its smallest robot on.
    """
    pairs = sorted(alignments)
    later = {a: {c for first, c in pairs if first == a} for a, _ in pairs}
    found = [(a, b, c) for a, b in pairs for c in sorted(later[a] & later.get(b, set()))]
    if _independent(found, pairs) < _independent_cycles(pairs):
        found += _longer_cycles(pairs)
    return [_closed(robots, alignments) for robots in sorted(found)]


def _pairs_of(cycle: tuple[int, ...]) -> tuple[Pair, ...]:
    following = (*cycle[1:], cycle[0])
    return tuple((min(pair), max(pair)) for pair in zip(cycle, following, strict=True))


def _independent_cycles(pairs: Sequence[Pair]) -> int:
    """E - V + C, the dimension of the space of cycles."""
    if not pairs:
        return 0
    robots, ends = np.unique(np.array(pairs), return_inverse=True)
    first, second = ends.reshape(-1, 2).T
    parts, _ = connected_parts(first, second, len(robots))
    return len(pairs) - len(robots) + parts


def _independent(cycles: Sequence[tuple[int, ...]], pairs: Sequence[Pair]) -> int:
    """The dimension of the space of cycles that these span: a rank over two elements."""
    bit = {pair: 1 << place for place, pair in enumerate(pairs)}
    reduced: list[int] = []
    for cycle in cycles:
        left = sum(bit[pair] for pair in _pairs_of(cycle))
        for other in reduced:
            left = min(left, left ^ other)
        if left:
            reduced.append(left)
    return len(reduced)


def _longer_cycles(pairs: Sequence[Pair]) -> list[tuple[int, ...]]:
    """Shortest cycles of more than three robots that what triangles span leaves out.

    Where triangles span all cycles there are none, and networkx is not imported: that takes a third
    of the time that importing JAX does.
    """
    import networkx as nx

    graph: nx.Graph[int] = nx.Graph(list(pairs))
    return [_from_smallest(cycle) for cycle in nx.minimum_cycle_basis(graph) if len(cycle) > 3]


def minority(cycles: Sequence[Cycle], significance: float = SIGNIFICANCE) -> list[Pair]:
    """Names the pairs of robots that the others outvote, one after another.

    Args:
        cycles: of the team.
        significance: probability that any right cycle fails, shared among them.

    Returns:
        The pairs to drop.
    """
    level = significance / max(1, len(cycles))
    left, dropped = list(cycles), []
    while True:
        failing = [cycle for cycle in left if cycle.p < level]
        votes = {pair: sum(pair in c.pairs for c in failing) for c in failing for pair in c.pairs}
        stands = {pair for c in left if c.p >= level for pair in c.pairs}
        most = max(votes.values(), default=0)
        worst = [pair for pair, count in votes.items() if count == most]
        rivals = {pair for c in failing for pair in c.pairs if len(set(c.pairs) & set(worst)) > 1}
        clear = [
            pair
            for pair in sorted(worst)
            if pair not in stands | rivals and _hangs_together(left, pair)
        ]
        if not clear:
            return dropped
        dropped.append(clear[0])
        left = [cycle for cycle in left if clear[0] not in cycle.pairs]


def alignments_of(
    pairs: Sequence[tuple[PairEvidence, Bool[np.ndarray, " k"]]], verdicts: Sequence[Verdict]
) -> dict[Pair, JointConsistency]:
    """Aligns the maps of every believed pair of a team that has cycles; none of one without.

    Args:
        pairs: the evidence of each pair of robots, and the members of its set, of which 60 count.
        verdicts: on each by itself.
    """
    believed = [
        (pair.robot_a, pair.robot_b)
        for (pair, _), verdict in zip(pairs, verdicts, strict=True)
        if verdict.believed
    ]
    if _independent_cycles(believed) == 0:
        return {}
    return {
        (pair.robot_a, pair.robot_b): joint_consistency(
            pair, thinned(np.flatnonzero(members), JOINT)
        )
        for (pair, members), verdict in zip(pairs, verdicts, strict=True)
        if verdict.believed
    }


def judge_team(
    pairs: Sequence[tuple[PairEvidence, Bool[np.ndarray, " k"]]],
    verdicts: Sequence[Verdict],
    *,
    significance: float = SIGNIFICANCE,
    alignments: Mapping[Pair, JointConsistency] | None = None,
) -> tuple[list[Verdict], tuple[Cycle, ...]]:
    """Holds the believed pairs of a team against each other.

    Args:
        pairs: the evidence of each pair of robots, and the members of its set.
        verdicts: on each by itself.
        significance: probability that a right pair is dropped.
        alignments: see `alignments_of`, where they are known.

    Returns:
        The verdicts, in which pairs that the others outvote are refused, and the team's cycles.
    """
    cycles = cycles_of(alignments_of(pairs, verdicts) if alignments is None else alignments)
    dropped = minority(cycles, significance)
    judged = []
    for (pair, _), verdict in zip(pairs, verdicts, strict=True):
        own = (pair.robot_a, pair.robot_b)
        if own in dropped:
            failing = [cycle for cycle in cycles if own in cycle.pairs]
            why = f"{verdict.why}; but the team contradicts it in all {len(failing)} cycles"
            judged.append(dataclasses.replace(verdict, believed=False, why=why))
        else:
            judged.append(verdict)
    return judged, tuple(cycles)


def _hangs_together(cycles: Sequence[Cycle], without: Pair) -> bool:
    """True if other cycles, or the rest of its own, still join the two robots."""
    import networkx as nx

    graph: nx.Graph[int] = nx.Graph([pair for cycle in cycles for pair in cycle.pairs])
    graph.remove_edge(*without)
    return nx.has_path(graph, *without)


def _from_smallest(cycle: Sequence[int]) -> tuple[int, ...]:
    start = int(np.argmin(cycle))
    turned = (*cycle[start:], *cycle[:start])
    return turned if turned[1] < turned[-1] else (turned[0], *turned[:0:-1])


def _closed(robots: tuple[int, ...], alignments: Mapping[Pair, JointConsistency]) -> Cycle:
    group = lie.group_of(next(iter(alignments.values())).alignment)
    d = lie.tangent_dim(group)
    total, covariance = lie.identity(group), np.zeros((d, d))
    for a, b in zip(robots, (*robots[1:], robots[0]), strict=True):
        step, own = _from_to(a, b, alignments)
        # T exp(δ) S exp(ε) = T S exp(Ad(S⁻¹) δ + ε)
        back = np.asarray(lie.adjoint(lie.inverse(step)))
        total, covariance = lie.compose(total, step), back @ covariance @ back.T + own
    error = np.asarray(lie.log(total))
    chi2 = float(error @ np.linalg.solve(covariance, error))
    return Cycle(tuple(map(int, robots)), error, chi2, d, survival(chi2, d))


def _from_to(a: int, b: int, alignments: Mapping[Pair, JointConsistency]) -> tuple[Any, np.ndarray]:
    """The place of map b's frame in a's with its covariance, errors on the right."""
    if a < b:
        found = alignments[a, b]
        return found.alignment, found.covariance
    found = alignments[b, a]
    adjoint = np.asarray(lie.adjoint(found.alignment))  # (T exp(δ))⁻¹ = T⁻¹ exp(−Ad(T) δ)
    return lie.inverse(found.alignment), adjoint @ found.covariance @ adjoint.T
