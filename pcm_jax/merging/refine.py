"""Refine: the merged map judges every closure once more, and those inside the maps.

"recall"   what the selection left out comes back where it agrees with the merged map (`recall`).
"gnc"      before that, graduated non-convexity: truncated least squares over all closures of robots
           that are joined and over the loops inside their maps, from the merged map. Odometry is
           known to be right; an edge in doubt costs min(χ², γ²). H. Yang, P. Antonante, V. Tzoumas
           and L. Carlone, "Graduated non-convexity for robust spatial perception", RA-L 2020.

Graduated non-convexity finds no minimum for certain. Its answer is taken only if its truncated cost

    Σ χ² of odometry + Σ min(χ², γ²) of the edges in doubt

is below that of the merged map that it began with, and only if it leaves robots joined that are.
Which robots are joined is settled before: refining joins no others and parts none.
"""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from pcm_jax import lie
from pcm_jax.consistency import chi2_gate, odometry_edges
from pcm_jax.errors import ConvergenceWarning
from pcm_jax.graph import MultiRobotGraph, PoseGraph
from pcm_jax.graph.spanning_tree import connected_parts
from pcm_jax.mapping.least_squares import Framed, with_frame
from pcm_jax.mapping.optimization import host_arrays, problem_of
from pcm_jax.mapping.priors import held
from pcm_jax.merging.groups import closures_within
from pcm_jax.merging.joint import cut_apart, joint_graph
from pcm_jax.merging.merged import Merged, freedom_of
from pcm_jax.merging.recall import recall
from pcm_jax.merging.refinement import JointTest, Refinement
from pcm_jax.merging.robust.methods import from_here
from pcm_jax.merging.robust.solve import reweighted, squared_residuals

REFINEMENTS = ("recall", "gnc")


class Refined(NamedTuple):
    """The end of refining.

    Attributes:
        graph: the maps in their groups' frames, with the loops kept and no other; all closures.
        accepted: bool `[m]`.
        refinement: what it did.
    """

    graph: MultiRobotGraph
    accepted: Bool[np.ndarray, " m"]
    refinement: Refinement


def refine(
    own: MultiRobotGraph,
    merged: Merged,
    accepted: Bool[np.ndarray, " m"],
    *,
    mode: str,
    confidence: float,
    engine: str = "blocks",
    recalling: bool = True,
) -> Refined:
    """Refines every group of robots by itself.

    Args:
        own: maps at their own optima, all closures.
        merged: the same merged by the accepted ones.
        accepted: these.
        mode: "recall" or "gnc".
        confidence: of the gate, and of the joint test of what comes back.
        engine: of the solves.
        recalling: False for graduated non-convexity alone.

    Raises:
        InputError: with "gnc" for a map whose consecutive poses no edge joins.

    Warns:
        ConvergenceWarning: for weights that did not settle.
    """
    maps, chosen = list(merged.maps), accepted.copy()
    loops = [np.ones(one.num_edges, bool) for one in own.maps]
    weighed = np.asarray(own.closures.weight) > 0.0
    placed = MultiRobotGraph(merged.maps, own.closures)
    parts = []
    for members in merged.groups:
        if len(members) < 2:
            continue
        used = closures_within(members, own.closures, weighed | accepted)
        group = _Group.of(placed, own, members, used, accepted[used])
        start = group.by_gnc(confidence, engine) if mode == "gnc" else group
        end, part = start.with_recall(group.doubted(mode), confidence, engine, recalling)
        parts.append(part)
        chosen[used] = end.used[-len(used) :]
        first = 0
        for robot, poses in cut_apart(placed, members, end.joint.poses):
            rows = slice(first, first + own.maps[robot].num_edges)
            loops[robot], first = end.used[rows], rows.stop
            maps[robot] = merged.maps[robot].with_edges(loops[robot]).with_poses(poses)
    refinement = Refinement(
        mode=mode,
        recalled=chosen & ~accepted,
        dropped=accepted & ~chosen,
        loops=tuple(loops),
        rounds=sum(part.rounds for part in parts),
        settled=all(part.settled for part in parts),
        joint=JointTest(
            sum(part.joint.chi2 for part in parts), sum(part.joint.dof for part in parts)
        ),
    )
    return Refined(MultiRobotGraph(tuple(maps), own.closures), chosen, refinement)


class _Part(NamedTuple):
    """The account of a group."""

    joint: JointTest
    rounds: int
    settled: bool


@dataclasses.dataclass(frozen=True)
class _Group:
    """A group of robots as one pose graph.

    Attributes:
        joint: poses and all edges: the maps' own, then the closures.
        used: bool `[e]`, those that hold.
        known: bool `[e]`, odometry.
        maps: the robots' own maps.
        freedom: degrees of freedom that priors add to the merged map and not to the maps.
    """

    joint: PoseGraph
    used: Bool[np.ndarray, " e"]
    maps: tuple[PoseGraph, ...]
    placed: tuple[PoseGraph, ...]

    @classmethod
    def of(
        cls,
        placed: MultiRobotGraph,
        own: MultiRobotGraph,
        members: tuple[int, ...],
        closures: np.ndarray,
        accepted: np.ndarray,
    ) -> _Group:
        here = lie.identity(own.group, (len(own.maps),))
        joint = joint_graph(placed, members, closures, here)
        inside = np.ones(joint.num_edges - len(closures), bool)
        mine = tuple(own.maps[robot] for robot in members)
        there = tuple(placed.maps[robot] for robot in members)
        return cls(joint, np.concatenate([inside, accepted]), mine, there)

    def doubted(self, mode: str) -> Bool[np.ndarray, " e"]:
        """The edges that may be wrong: the closures; with "gnc" the loops inside the maps too."""
        doubt = np.ones(self.joint.num_edges, bool)
        first = 0
        for one in self.maps:
            rows = slice(first, first + one.num_edges)
            doubt[rows] = mode == "gnc"
            if mode == "gnc":
                doubt[first + odometry_edges(one)] = False
            first = rows.stop
        return doubt

    def by_gnc(self, confidence: float, engine: str) -> _Group:
        """The group by graduated non-convexity, or as it is, if that is no better."""
        doubt = self.doubted("gnc")
        gate = float(chi2_gate(confidence, self.joint.tangent_dim))
        turns = reweighted(
            self.joint,
            np.flatnonzero(doubt),
            from_here(gate),
            solver="levenberg-marquardt",
            engine=engine,
        )
        if not turns.converged:
            warnings.warn(
                f"merged map {self.joint.name!r}: the weights of the closures did not settle in "
                f"{turns.iterations} turns",
                ConvergenceWarning,
                stacklevel=4,
            )
        used = ~doubt
        used[np.flatnonzero(doubt)[turns.scale >= 0.5]] = True
        moved = dataclasses.replace(self, joint=self.joint.with_poses(turns.poses), used=used)
        better = moved._truncated(doubt, gate) < self._truncated(doubt, gate)
        return moved if turns.converged and better and moved._in_one_piece() else self

    def with_recall(
        self, doubt: np.ndarray, confidence: float, engine: str, recalling: bool
    ) -> tuple[_Group, _Part]:
        """The group with what comes back."""
        joint = self._joint_test()
        eligible = doubt & ~self.used & recalling
        found = recall(
            self.joint,
            self.used,
            eligible,
            joint,
            accepted=doubt & self.used,
            confidence=confidence,
            engine=engine,
        )
        moved = self.joint.with_poses(found.poses)
        part = _Part(found.joint, found.rounds, found.settled)
        return dataclasses.replace(self, joint=moved, used=found.used), part

    def _truncated(self, doubt: np.ndarray, gate: float) -> float:
        squared = _squared_of(self.joint)
        edges = squared[: len(doubt)]
        return float(squared.sum() - edges[doubt].sum() + np.minimum(edges[doubt], gate).sum())

    def _in_one_piece(self) -> bool:
        tail, head = (np.asarray(end)[self.used] for end in (self.joint.tail, self.joint.head))
        return connected_parts(tail, head, self.joint.num_poses)[0] == 1

    def _joint_test(self) -> JointTest:
        """The rise of χ² when the maps, with the loops that hold, are merged."""
        whole = self.joint.with_edges(self.used)
        chi2, dof = float(_squared_of(whole).sum()), freedom_of(whole)
        first = 0
        for mine, there in zip(self.maps, self.placed, strict=True):
            kept = self.used[first : first + mine.num_edges]
            first += mine.num_edges
            alone = dataclasses.replace(mine, priors=there.priors).with_edges(kept)
            if kept.all():
                chi2 -= float(_squared_of(alone).sum())
            else:
                chi2 -= 2.0 * problem_of(alone).solve(alone.poses).cost
            dof -= freedom_of(alone)
        return JointTest(chi2, int(dof))


def _squared_of(graph: PoseGraph) -> Float[np.ndarray, " e+k"]:
    """χ² of every edge, then of every prior, at a graph's own poses."""
    problem, priors = Framed(*host_arrays(graph), np.zeros(graph.num_poses, bool)), held(graph)
    problem = problem if priors is None else problem.with_priors(priors)
    poses: Any = with_frame(graph.poses, len(problem.fixed))
    return squared_residuals(poses, *problem[:4])
