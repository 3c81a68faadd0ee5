"""The chance level inside one map: how often closures of which none is right agree with odometry.

Two ways of being wrong, and a test of each; a place counts once (`places`).

*The wrong poses.* What a front end takes for the same place has nothing to do with where the robot
was. Measurements in hand, put between poses drawn at random (no closer in time than the shortest
loop in hand), agree with odometry in a share p₀ of cases; that T of n places do,

    p = P( Binomial(n, p₀) ≥ T ),

needs no shuffle, and tells three closures of three. It says nothing where the factor on odometry's
errors was fitted to these very closures.

*The wrong measurements.* They say nothing of the poses that they are attached to, so that shuffled
among the closures they make maps of the same law, as in `chance`. With the factor fitted anew to
each shuffle (`odometry`) the level is exact, whatever the fit does:

    p = (1 + shuffles that reach T places) / (1 + shuffles).

A shuffle counts by the largest set that agrees with odometry and among itself; where so few agree
with odometry that T is out of reach, by these.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import bdtrc

from pcm_jax.arrays import on_host
from pcm_jax.clique import maximum_clique
from pcm_jax.consistency import (
    WithinProblem,
    consistency_graph,
    odometry_edges,
    own_loops,
    reordered,
    squared_mahalanobis,
    with_odometry_errors,
    within_problem,
)
from pcm_jax.consistency.within import OwnLoops
from pcm_jax.graph import PoseGraph
from pcm_jax.integrity.chance import ENOUGH, MOST_SHUFFLES, SEARCH, SHOWN, ChanceLevel
from pcm_jax.integrity.odometry import odometry_scale
from pcm_jax.integrity.places import Places

DRAWN = 2000
"""Pairs of poses, for p₀."""


class Loops(NamedTuple):
    """The closures inside one map, as the tests need them.

    Attributes:
        graph: the map.
        problem: of its m closures.
        places: where they lie.
        extent: of the map, metres along each axis.
    """

    graph: PoseGraph
    problem: WithinProblem
    places: Places
    extent: Float[np.ndarray, " s"]


def squared_errors(loops: OwnLoops, factor: float) -> Float[np.ndarray, " m"]:
    """q² of each closure with odometry alone, whose standard deviations are multiplied."""
    total = factor**2 * loops.odometry + loops.measured
    weighed = np.linalg.solve(total, loops.error[..., None])[..., 0]
    return np.einsum("ui,ui->u", loops.error, weighed)


@on_host
def level_of_poses(
    loops: Loops, gate: float, accepted: Bool[np.ndarray, " m"], *, factor: float, seed: int
) -> ChanceLevel:
    """Tests how often closures between poses that have nothing to do with them agree as well.

    Args:
        loops: the closures.
        gate: γ².
        accepted: bool [m], those that agree.
        factor: on odometry's standard deviations, not fitted to these closures.
        seed: of the draws.
    """
    places, total = loops.places.count(accepted), loops.places.count()
    anywhere = own_loops(within_problem(_anywhere(loops.graph, np.random.default_rng(seed))))
    agree = np.count_nonzero(squared_errors(anywhere, factor) <= gate)
    share = (1.0 + agree) / (1.0 + DRAWN)
    p = float(bdtrc(places - 1, total, share)) if places >= 2 else 1.0
    least = float(bdtrc(total - 1, total, share)) if total >= 2 else 1.0
    return ChanceLevel(places, p, least, 0, np.zeros(0, np.int64), total)


@on_host
def level_of_measurements(
    loops: Loops,
    gate: float,
    accepted: Bool[np.ndarray, " m"],
    *,
    factor: float | None,
    significance: float,
    seed: int,
) -> ChanceLevel:
    """Tests how often closures whose measurements are shuffled agree as well.

    Args:
        loops: the closures.
        gate: γ².
        accepted: bool [m], those that agree.
        factor: on odometry's standard deviations; None: fitted to each shuffle.
        significance: the level that p is to be compared with.
        seed: of the shuffles.
    """
    places, count = loops.places.count(accepted), len(accepted)
    null: list[int] = []
    reached, wanted = 0, min(MOST_SHUFFLES, math.ceil(1.0 / significance) - 1)
    generator = np.random.default_rng(seed)
    while places >= 2 and len(null) < wanted and reached < ENOUGH:
        null.append(_reached(loops, gate, generator.permutation(count), places, factor))
        reached += null[-1] >= places
    made = len(null)
    p = 1.0 if places < 2 else reached / made if reached == ENOUGH else (1 + reached) / (1 + made)
    least = 1.0 / (1.0 + wanted) if places >= 2 else 1.0
    return ChanceLevel(places, p, least, made, np.array(null[:SHOWN], np.int64), count)


def _reached(
    loops: Loops, gate: float, order: Int[np.ndarray, " m"], wanted: int, factor: float | None
) -> int:
    """Places of a shuffle's largest set; where that is below `wanted`, a bound on them."""
    own = own_loops(loops.problem, order)
    if factor is None:
        scale = odometry_scale(own, loops.extent)
        if not scale.found:
            return 0
        factor = scale.factor
    agreeing = squared_errors(own, factor) <= gate
    most = int(np.count_nonzero(agreeing))
    if most >= wanted:
        most = loops.places.count(agreeing)
    if most < wanted:
        return most
    problem = with_odometry_errors(reordered(loops.problem, order), factor)
    rows = np.flatnonzero(agreeing)
    squared = np.asarray(squared_mahalanobis(problem))[np.ix_(rows, rows)]
    graph = np.asarray(consistency_graph(squared, gate))  # type: ignore[arg-type]
    largest = maximum_clique(graph, time_limit=SEARCH)
    members = np.zeros(len(order), bool)
    members[rows[largest.members]] = True
    return loops.places.count(members)


def _anywhere(graph: PoseGraph, generator: np.random.Generator) -> PoseGraph:
    """The map's odometry, with closures' measurements between poses drawn at random."""
    odometry = odometry_edges(graph)
    closures = np.setdiff1d(np.arange(graph.num_edges), odometry)
    tail, head = np.asarray(graph.tail), np.asarray(graph.head)
    gap = int(np.abs(tail - head)[closures].min())
    length = graph.num_poses - gap
    ends = generator.integers(0, length, (2, DRAWN))
    early, late = ends.min(axis=0), ends.max(axis=0) + gap
    drawn = generator.choice(closures, DRAWN)
    backward = (tail > head)[drawn]
    rows = np.concatenate([odometry, drawn])
    made = graph.with_edges(rows)
    starts, stops = np.where(backward, late, early), np.where(backward, early, late)
    return dataclasses.replace(
        made,
        tail=np.concatenate([tail[odometry], starts]).astype(np.int32),
        head=np.concatenate([head[odometry], stops]).astype(np.int32),
    )
