"""Consensus: the map as it grows judges each closure of a set.

Two closures far apart agree by any standard where odometry between them says little, and so a set
that agrees pair by pair may hold false ones: in space, where stated errors add up to the size of
the map, nearly all. The map that right closures make knows better. As Olivastri and Pretto have it
(IPC, "Robust incremental pose graph optimization", ICRA 2024), closures are taken along the way, in
the order in which the later of their poses comes; here some dozens at a time, and of those first
the ones that the map so far predicts best:

    width     of the closures of a stretch those are judged whose test is at most `WIDE` wide, or
              twice as wide as that of the best predicted one; then the map is solved with those
              that pass, and what is left is judged by that.
    gate      χ² of each against the map so far, by the covariance of both, see `_innovation`.
    scale     where those that pass fit far better than stated, the gate is narrower, see
              `consistency.overstated`: public graphs state errors up to a hundred times too large.
    joint     the χ² of the map rises by less than the quantile of its degrees of freedom. Where it
              does not, or the solve does not end, it is solved from another start; then the worst
              leave, of those taken before as well if their own residuals are beyond the gate, and
              the map is solved again.

Unlike there nothing is decided for good. In the end every closure of the set is judged in the map
of all the others, until none enters or leaves (`fitting_edges`).

Host; a stretch is a few solves of the map up to its last pose.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from pcm_jax import lie
from pcm_jax.consistency import chi2_gate
from pcm_jax.consistency.overstated import narrowing
from pcm_jax.graph import PoseGraph
from pcm_jax.graph.split import stretch
from pcm_jax.mapping import Solution, optimize
from pcm_jax.mapping.optimization import host_arrays, optimize_from
from pcm_jax.merging._innovation import innovation, squared_by_leaving
from pcm_jax.merging.joint import gone_on
from pcm_jax.merging.robust.solve import squared_residuals

STRETCH = 150
"""Closures that a stretch of the way has about."""
WIDE = 16.0
"""Width of a test that is made at once, see `_innovation`."""
LOOSE = 1e-3
"""Relative fall of the cost at which a solve on the way ends."""
STEPS = 20
"""Evaluations of a solve on the way, after which the closures are taken not to fit."""
WORST = 0.5
"""Of the largest χ², that of closures which leave along with the one that has it."""
SOLVES = 5
"""Of the whole map, each with the closures that fitted the one before, at most."""
HALF = 0.5
"""Of a set, the least that must fit its own map."""


def consensus(
    chain: PoseGraph,
    odometry: Bool[np.ndarray, " e"],
    candidates: Bool[np.ndarray, " e"],
    *,
    confidence: float,
) -> tuple[Bool[np.ndarray, " e"], PoseGraph]:
    """Takes the closures of a set into the map one stretch after another, as far as they fit.

    Args:
        chain: a map with all edges, at the poses that odometry alone gives; priors play no part.
        odometry: edges that are not in doubt, one from each pose to the next.
        candidates: the set, none of them odometry.
        confidence: of the gate, and of the joint test.

    Returns:
        Marks of odometry and of what was taken in, and the graph at poses solved with these.
    """
    way = _Way(chain, odometry, candidates, confidence)
    late = np.maximum(chain.tail, chain.head)[candidates]
    for upto in _stretches(late, chain.num_poses):
        way.go(upto)
    return way.used, chain.with_poses(way.poses)


def fitting_edges(
    whole: PoseGraph,
    held: Bool[np.ndarray, " e"],
    asked: Int[np.ndarray, " k"],
    gate: float,
    *,
    initial: str = "given",
    narrow: bool = False,
) -> Bool[np.ndarray, " e"]:
    """Marks the edges that fit the map of all the others, until none enters or leaves.

    Args:
        whole: a map with all edges, at poses to begin with.
        held: edges that make the first map; those that are not asked for stay.
        asked: edges to be judged one by one, held or not.
        gate: γ² that each must pass.
        initial: where each map is solved from, as for `optimize`.
        narrow: whether the gate is narrower where those held fit far better than stated.
    """
    first, poses = held[asked], whole.poses
    for _ in range(SOLVES):
        solved = optimize(whole.with_poses(poses).with_edges(held), initial=initial)
        if not solved.converged:
            break
        poses = solved.graph.poses
        squared = squared_by_leaving(whole.with_poses(poses), held, asked)
        factor = narrowing(squared[held[asked]], gate, whole.tangent_dim) if narrow else 1.0
        fits = squared <= factor * gate
        if (fits & first).sum() < HALF * first.sum():
            break
        settled = bool((fits == held[asked]).all())
        held = held.copy()
        held[asked] = fits
        if settled:
            break
    return held


class _Here(NamedTuple):
    """The map up to some pose.

    Attributes:
        graph: its poses and all edges among them.
        rows: int `[r]`, these in the whole map.
        used: bool `[r]`, those that hold.
        cost: 0.5 Σ rᵀΩr of these.
    """

    graph: PoseGraph
    rows: Int[np.ndarray, " r"]
    used: Bool[np.ndarray, " r"]
    cost: float


class _Way:
    """The map as far as it has come."""

    def __init__(
        self, chain: PoseGraph, odometry: np.ndarray, candidates: np.ndarray, confidence: float
    ):
        self.chain, self.odometry, self.confidence = chain, odometry, confidence
        self.used, self.open = odometry.copy(), candidates.copy()
        self.poses, self.cost = lie.take(lie.as_numpy(chain.poses), slice(0, 1)), 0.0
        self.dim = chain.tangent_dim
        self.gate, self.scale = float(chi2_gate(confidence, self.dim)), 1.0
        self.passed = np.zeros(0)  # the χ² of those that have, when they were judged

    def go(self, upto: int) -> None:
        """Goes on to a pose: judges the closures among those up to it."""
        here = self._up_to(upto)
        asked = np.flatnonzero(self.open[here.rows])
        while len(asked):
            judged = innovation(here.graph, here.used, asked)
            near = judged.width <= max(WIDE, 2.0 * judged.width.min())
            seen = np.concatenate([self.passed, judged.squared[near]])
            self.scale = narrowing(seen, self.gate, self.dim)
            passes = near & (judged.squared <= self.scale * self.gate)
            self.passed = np.concatenate([self.passed, judged.squared[passes]])
            here = self._with(here, asked[passes])
            asked = asked[~near]
        self.open[here.rows], self.used[here.rows] = False, here.used
        self.poses, self.cost = lie.as_numpy(here.graph.poses), here.cost

    def _up_to(self, count: int) -> _Here:
        """The map up to a pose, the new poses where odometry puts them from the last one solved."""
        part = stretch(self.chain, 0, count)
        part = part.with_poses(gone_on(self.poses, part.poses))
        rows = np.flatnonzero(np.maximum(self.chain.tail, self.chain.head) < count)
        return _Here(part, rows, self.used[rows], self.cost)

    def _with(self, here: _Here, entering: np.ndarray) -> _Here:
        """The map with closures that enter, less those that it cannot hold together."""
        used = here.used.copy()
        used[entering] = True
        while (used != here.used).any():
            freedom = self.dim * max(1, int(used.sum()) - int(here.used.sum()))
            most = here.cost + 0.5 * self.scale * float(chi2_gate(self.confidence, freedom))
            solved = _solved(here.graph, used, "given")
            if not solved.converged or solved.cost > most:
                others = solved, _solved(here.graph, used, "chordal")
                solved = min(others, key=lambda one: (not one.converged, one.cost))
            fits = solved.converged and solved.cost <= most
            worst = [] if fits else self._worst(here, used, solved, entering)
            if not len(worst):
                return _Here(
                    here.graph.with_poses(solved.graph.poses), here.rows, used, solved.cost
                )
            used[worst] = False
        return here

    def _worst(
        self, here: _Here, used: np.ndarray, solved: Solution, entering: np.ndarray
    ) -> Int[np.ndarray, " k"]:
        """The closures that fit worst, of those that entered and those that are strained."""
        doubted = used & ~self.odometry[here.rows]
        graph = here.graph.with_poses(solved.graph.poses)
        own = squared_residuals(graph.poses, *host_arrays(graph))
        new = np.isin(np.arange(len(used)), entering)
        rows = np.flatnonzero(doubted & (new | (own > self.scale * self.gate)))
        squared = squared_by_leaving(graph, used, rows) if solved.converged else own[rows]
        squared = np.where(np.isfinite(squared) & (squared >= 0.0), squared, np.inf)
        most = squared.max(initial=0.0)
        least = self.scale * self.gate if solved.converged else 0.0
        return rows[(squared > least) & (squared >= WORST * most)]


def _stretches(late: Int[np.ndarray, " k"], poses: int) -> list[int]:
    """The numbers of poses at which stretches end, about equally many closures in each."""
    parts = max(1, round(len(late) / STRETCH))
    ends = np.sort(late)[np.linspace(0, len(late), parts + 1).astype(int)[1:-1] - 1] + 1
    return [*np.unique(ends).tolist(), poses]


def _solved(graph: PoseGraph, used: np.ndarray, initial: str) -> Solution:
    return optimize_from(initial, graph.with_edges(used), rtol=LOOSE, max_steps=STEPS)
