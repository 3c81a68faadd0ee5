"""The loop closures inside one robot's own map to believe: the paper's steps ii and iii there.

Between two robots nothing says beforehand where one is from the other, and the largest consistent
set is all there is to go by. Inside one map odometry says it for every closure by itself. So a
closure must agree with odometry alone as well as with the others (`own_loop`): by the gate, that
costs right closures no more than one pair does, and it rejects groups of false ones that agree
among themselves, however large, as soon as they contradict odometry.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax.arrays import on_host
from pcm_jax.consistency import (
    PairEvidence,
    chi2_gate,
    odometry_edges,
    squared_mahalanobis,
    squared_own_loops,
    within_problem,
)
from pcm_jax.errors import InputError, check_class, check_number
from pcm_jax.graph import MultiRobotGraph, PoseGraph
from pcm_jax.selection.choose import Method, check_method, choose
from pcm_jax.selection.methods import METHODS

TIME_LIMIT = 60.0  # seconds


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class WithinSelection:
    """The decision on the m loop closures among the e edges of one map.

    Attributes:
        graph: the map without the rejected edges; poses, ids and name are the given ones.
        kept: bool [e], false for rejected closures.
        odometry: bool [e], the edges that were taken as odometry; never rejected.
        closures: int64 [m], the indices of all other edges, ascending.
        squared: float64 [m, m], squared Mahalanobis distances of pairs, not symmetrised.
        own_squared: float64 [m], of each closure's loop with odometry alone.
        gate: γ², of either.
        accepted: bool [m].
        optimal: whether no larger pairwise consistent set exists (under `own_loop`: among the
            closures that agree with odometry); None if the method does not say.
        upper_bound: no such set has more members; None likewise.
        seconds: wall-clock time of `"consistency"` and `"clique"`.
    """

    graph: PoseGraph
    kept: Bool[np.ndarray, " e"]
    odometry: Bool[np.ndarray, " e"]
    closures: Int[np.ndarray, " m"]
    squared: Float[np.ndarray, "m m"]
    own_squared: Float[np.ndarray, " m"]
    gate: float
    accepted: Bool[np.ndarray, " m"]
    optimal: bool | None
    upper_bound: int | None
    seconds: dict[str, float]

    def __repr__(self) -> str:
        proof = {None: "not looked for", True: "proven", False: f"at most {self.upper_bound}"}
        return (
            f"WithinSelection({int(self.accepted.sum())} of {len(self.accepted)} closures accepted)"
            f"\n  map          {self.graph!r}\n"
            f"  largest set  {proof[self.optimal]}, gate {self.gate:.4g}"
        )

    @property
    def inliers(self) -> Bool[np.ndarray, " e"]:
        """The former name of `kept`."""
        return self.kept


@on_host
def select_within(
    pose_graph: PoseGraph,
    *,
    confidence: float = 0.99,
    method: Method = "pcm-exact",
    own_loop: bool = True,
    minimum_inliers: int = 2,
    time_limit: float | None = None,
    **options: Any,
) -> WithinSelection:
    """Selects the loop closures to believe inside one map.

        cleaned = pcm_jax.select_within(graph.maps[0])
        cleaned.accepted, cleaned.graph

    Squared distances are measured in the map that odometry alone gives, with its covariance as the
    edges state it: where that is too small, true closures after a long way fail. Priors of the map
    are kept and play no part in this.

    Args:
        pose_graph: a chain of odometry, one edge from each pose to the next in either direction
            (the first of several; others are closures), and closures, which are all other edges.
        confidence: probability that the loop of two right closures passes the gate, and that of
            one with odometry.
        method: see `select_from`.
        own_loop: whether a closure must agree with odometry by itself too.
        minimum_inliers: a map that accepts fewer closures accepts none.
        time_limit: seconds for the method, if it has the option: 60 by default, `math.inf` for any
            time. Whether it sufficed is `optimal`.
        **options: the method's own, see `select_from`.

    Returns:
        the selection, with the cleaned map; float64 whatever the caller's `jax_enable_x64`.

    Raises:
        InputError: for consecutive poses that no edge joins, an unknown method or option, a
            confidence outside (0, 1), a negative minimum.
    """
    check_class("pose_graph", pose_graph, "a PoseGraph", PoseGraph)
    options = _with_time_limit(method, time_limit, options)
    check_number("minimum_inliers", minimum_inliers)
    if minimum_inliers < 0:
        raise InputError(f"minimum_inliers: {minimum_inliers}, expected at least 0")
    gate = float(chi2_gate(confidence, pose_graph.tangent_dim))
    start = time.perf_counter()
    odometry = np.zeros(pose_graph.num_edges, bool)
    odometry[odometry_edges(pose_graph)] = True
    closures = np.flatnonzero(~odometry)
    problem = within_problem(pose_graph)
    squared = np.asarray(squared_mahalanobis(problem))
    own_squared = np.asarray(squared_own_loops(problem))
    measured = time.perf_counter()
    candidates = np.flatnonzero((own_squared <= gate) | (not own_loop))
    evidence = PairEvidence.from_squared(squared[np.ix_(candidates, candidates)])
    choice = choose(evidence, gate, method=method, **options)
    accepted = np.zeros(len(closures), bool)
    accepted[candidates] = choice.members & (choice.members.sum() >= minimum_inliers)
    kept = odometry.copy()
    kept[closures] = accepted
    chosen = time.perf_counter()
    return WithinSelection(
        graph=pose_graph.with_edges(kept),
        kept=kept,
        odometry=odometry,
        closures=closures,
        squared=squared,
        own_squared=own_squared,
        gate=gate,
        accepted=accepted,
        optimal=choice.optimal,
        upper_bound=choice.upper_bound,
        seconds={"consistency": measured - start, "clique": chosen - measured},
    )


def clean_maps(
    graph: MultiRobotGraph, **options: Any
) -> tuple[MultiRobotGraph, tuple[WithinSelection | None, ...]]:
    """Cleans every robot's map by `select_within`; closures between robots stay as they are.

        graph, selections = pcm_jax.clean_maps(graph)

    Args:
        graph: the robots' maps.
        **options: of `select_within`.

    Returns:
        The graph of the cleaned maps, and each map's selection; None for a map without a loop,
        which is left alone.

    Raises:
        InputError: as `select_within`.
    """
    check_class("graph", graph, "a MultiRobotGraph", MultiRobotGraph)
    looped = [each.num_edges >= each.num_poses for each in graph.maps]
    for each, has_loops in zip(graph.maps, looped, strict=True):
        if has_loops:
            odometry_edges(each)  # raises for any map before the first one takes its time
    selections = tuple(
        select_within(each, **options) if has_loops else None
        for each, has_loops in zip(graph.maps, looped, strict=True)
    )
    maps = tuple(
        each if selection is None else selection.graph
        for each, selection in zip(graph.maps, selections, strict=True)
    )
    return MultiRobotGraph(maps, graph.closures), selections


def _with_time_limit(
    method: Method, time_limit: float | None, options: dict[str, Any]
) -> dict[str, Any]:
    """The method's options, checked; with the default limit if it takes one."""
    given = options if time_limit is None else {**options, "time_limit": time_limit}
    check_method(method, given)
    if isinstance(method, str) and "time_limit" in METHODS[method].options:
        return {"time_limit": TIME_LIMIT, **given}
    return given
