"""Recall: edges that were left out of a merged graph, but agree with it, come back.

A set of k right closures is pairwise consistent only if all k(k − 1)/2 pairs pass the gate, so the
larger a set of right ones, the more of them the largest clique leaves out. The merged map judges
each by itself, see `_innovation`.

Rounds: all that may come back and pass the gate, come back, and the map is solved again, until
nothing changes, at most `ROUNDS` times. Four conditions keep false ones from letting in more:

    scale       where the accepted edges fit far better than they state, the gate is as much
                narrower: stated errors three times too large would else let in what is off by nine
                true ones. With S the sum of the χ² of n accepted edges, each in the map of all the
                others, S / F⁻¹(1 − confidence) of n d degrees of freedom is the largest scale that
                `confidence` leaves; it counts below `OVERSTATED`, since what passed a gate fits a
                little too well by that alone.
    first map   the χ² of what comes back, in the map of the accepted set alone, is one that the
                largest of m right ones has: below the gate of confidence 1 − (1 − confidence)/m, m
                the edges that may come back. So a map that is bent bit by bit leads nowhere.
    each other  what came back has to pass the gate in the map of all the others too. Of those that
                do not, the worse half leaves, and does not come back.
    all         the joint χ² of the set, accepted and come back, is below the quantile of
                `confidence` of its degrees of freedom, or, where the accepted set's is not, no
                larger for each of these than in that set. While it is not, the worse half of what
                entered last leaves, and does not come back.

Host; each round is one solve, one factorisation and the joint covariances of what may come back, in
panels.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from pcm_jax.consistency import chi2_gate
from pcm_jax.graph import PoseGraph
from pcm_jax.mapping.optimization import problem_of
from pcm_jax.merging._innovation import squared_by_leaving
from pcm_jax.merging.refinement import JointTest

ROUNDS = 20
OVERSTATED = 0.7
"""Scale of the accepted edges' χ² below which their stated errors are taken to be too large."""
STEPS = 30
"""Evaluations of a round's solve, which begins at the round before."""


class Recall(NamedTuple):
    """The end of recalling.

    Attributes:
        used: bool `[e]`, the edges of the graph in the end.
        poses: Lie `[n]`, NumPy, solved with these.
        joint: the joint test of the set in the end.
        rounds: solves by other edges than those given.
        settled: whether the last round changed nothing.
    """

    used: Bool[np.ndarray, " e"]
    poses: object
    joint: JointTest
    rounds: int
    settled: bool


def recall(
    merged: PoseGraph,
    used: Bool[np.ndarray, " e"],
    eligible: Bool[np.ndarray, " e"],
    joint: JointTest,
    *,
    accepted: Bool[np.ndarray, " e"],
    confidence: float,
    engine: str = "blocks",
) -> Recall:
    """Lets edges come back that agree with the merged map.

    Args:
        merged: a merged graph with all edges, at the optimum of those used.
        used: edges that hold.
        eligible: those that may come back; none of them used.
        joint: of the accepted set.
        accepted: those of the used edges that are of the same kind as the eligible ones.
        confidence: of the gate, and of the joint test.
        engine: of the solves.
    """
    rounds = _Rounds(merged, used, eligible, joint, confidence, engine)
    if eligible.any():
        rounds.narrow(np.flatnonzero(accepted & used))
    return rounds.run()


class _State(NamedTuple):
    """A solved graph.

    Attributes:
        back: bool `[k]`, which of the eligible edges are in it.
        poses: Lie `[n]`.
        cost: 0.5 Σ rᵀΩr.
    """

    back: np.ndarray
    poses: object
    cost: float


class _Rounds:
    """The rounds on one graph; masks `[k]` are over the eligible edges."""

    def __init__(
        self,
        merged: PoseGraph,
        used: np.ndarray,
        eligible: np.ndarray,
        joint: JointTest,
        confidence: float,
        engine: str,
    ):
        self.merged, self.used, self.joint = merged, used, joint
        self.confidence, self.engine = confidence, engine
        self.eligible = np.flatnonzero(eligible)
        self.dim, self.solves = merged.tangent_dim, 0
        self.gate = float(chi2_gate(confidence, self.dim))
        self.scale = 1.0

    def narrow(self, accepted: Int[np.ndarray, " n"]) -> None:
        """Takes the scale of the accepted edges' errors for that of the eligible ones'."""
        squared = squared_by_leaving(self.merged, self.used, accepted)
        squared = squared[np.isfinite(squared)]
        if len(squared):
            least = float(chi2_gate(1.0 - self.confidence, self.dim * len(squared)))
            scale = squared.sum() / least
            self.scale = scale if scale < OVERSTATED else 1.0
        self.gate *= self.scale

    def run(self) -> Recall:
        nothing = np.zeros(len(self.eligible), bool)
        if not len(self.eligible):
            return Recall(self.used, self.merged.poses, self.joint, 0, True)
        first = state = self._solved(nothing, self.merged.poses)
        squared = self._squared(state)
        widest = 1.0 - (1.0 - self.confidence) / len(self.eligible)
        allowed = squared <= self.scale * float(chi2_gate(widest, self.dim))
        settled = False
        for _ in range(ROUNDS):
            wanted, left = self._wanted(state, squared, allowed)
            allowed &= ~left
            settled = bool((wanted == state.back).all())
            if settled:
                break
            entered = self._passing(wanted, squared, state, first)
            allowed &= ~(wanted & ~entered.back)
            state = entered
            squared = self._squared(state, allowed | state.back)
        return Recall(
            self._mask(state.back), state.poses, self._test(state, first), self.solves - 1, settled
        )

    def _wanted(
        self, state: _State, squared: np.ndarray, allowed: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Decides on what is in the map next, and what leaves it for good."""
        failing = state.back & (squared > self.gate)
        left = _worse_half(failing, squared)
        if left.any():
            return state.back & ~left, left
        return state.back | (allowed & (squared <= self.gate)), left

    def _passing(
        self, wanted: np.ndarray, squared: np.ndarray, before: _State, first: _State
    ) -> _State:
        """The wanted ones solved, less those that entered last while the joint test fails."""
        while True:
            state = self._solved(wanted, before.poses)
            entered = wanted & ~before.back
            if self._passes(self._test(state, first)) or not entered.any():
                return state
            wanted = wanted & ~_worse_half(entered, squared)

    def _test(self, state: _State, first: _State) -> JointTest:
        count = int(state.back.sum())
        rise = 2.0 * (state.cost - first.cost)
        return JointTest(self.joint.chi2 + rise, self.joint.dof + self.dim * count)

    def _passes(self, test: JointTest) -> bool:
        if not math.isfinite(test.chi2) or test.dof <= 0:
            return test.dof <= 0
        before = self.joint.chi2 / self.joint.dof if self.joint.dof > 0 else 0.0
        return test.chi2 <= max(float(chi2_gate(self.confidence, test.dof)), before * test.dof)

    def _mask(self, back: np.ndarray) -> np.ndarray:
        mask = self.used.copy()
        mask[self.eligible[back]] = True
        return mask

    def _solved(self, back: np.ndarray, poses: object) -> _State:
        self.solves += 1
        problem = problem_of(self.merged.with_edges(self._mask(back)))
        solved = problem.solve(poses, engine=self.engine, max_steps=STEPS)
        cost = solved.cost if solved.converged else math.inf
        return _State(back, solved.poses, cost)

    def _squared(self, state: _State, asked: np.ndarray | None = None) -> np.ndarray:
        """χ² `[k]` of those asked for, infinite for the others."""
        rows = np.arange(len(self.eligible)) if asked is None else np.flatnonzero(asked)
        squared = np.full(len(self.eligible), np.inf)
        graph, mask = self.merged.with_poses(state.poses), self._mask(state.back)
        squared[rows] = squared_by_leaving(graph, mask, self.eligible[rows])
        return squared


def _worse_half(those: np.ndarray, squared: np.ndarray) -> np.ndarray:
    """The half of a mask, rounded up, with the largest χ²; the later of equal ones."""
    rows = np.flatnonzero(those)
    worst = rows[np.argsort(squared[rows], kind="stable")[len(rows) // 2 :]]
    chosen = np.zeros_like(those)
    chosen[worst] = True
    return chosen
