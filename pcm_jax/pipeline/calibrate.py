"""`calibrate`: from a graph or its evidence to factors on its information.

Loops inside maps and accepted closures between robots are judged together, each group of robots as
one graph. Maps whose loops contradict each other are cleaned before (`pipeline.within`). Closures
that are selected here, there or between robots, are selected again under the factors found, until
both stay (`_calibration_set`): what agrees with far too large deviations need not be right, and the
largest set that agrees has too small errors.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from pcm_jax.arrays import on_host
from pcm_jax.consistency import Evidence, chi2_gate
from pcm_jax.errors import InputError
from pcm_jax.graph import MultiRobotGraph, PoseGraph
from pcm_jax.integrity.calibration import (
    Calibration,
    Factor,
    Factors,
    closing_edges,
    scaled_graph,
)
from pcm_jax.integrity.loop_lengths import Growth, growth
from pcm_jax.integrity.variance_components import Components, Part, variance_components
from pcm_jax.mapping import optimize
from pcm_jax.merging import TOO_BAD
from pcm_jax.pipeline._calibration_set import (
    CalibrationSet,
    agreeing,
    agreeing_again,
    fitting,
    parts_of,
)
from pcm_jax.pipeline.within import select_within

NINE_IN_TEN = 1.645
"""Standard deviations, either way, that hold 90 % of a normal law."""
ROUNDS = 4
"""Selections under the factors found so far, at most."""
DIRTY = 4.0
"""Times the variance of normal residuals: a map with false loops."""
BETTER = 0.1
"""Times the chi-squared: a map that fits so much better without some loops had false ones; one that
does not has small deviations."""
FEW = 3
"""Loops of a map below which that cannot be told."""


@on_host
def calibrate(
    graph: MultiRobotGraph | PoseGraph | Evidence,
    accepted: Any = None,
    *,
    confidence: float = 0.99,
    seed: int = 0,
) -> Calibration:
    """Finds by how much odometry and closures misstate their errors, from what they close.

        calibration = pcm_jax.calibrate(graph)
        print(calibration)                       # advice in words
        calibration.odometry.translation         # a factor on the information; its .interval
        merged = pcm_jax.merge(calibration.apply(graph))

    Odometry is told from closures only where both are many: that of a chain that a single loop
    closes shares its one misfit with it. A factor comes within 10 % in nine of ten cases only where
    it rests on some 540 numbers that nothing else determines (2 (1.645 / 0.1)²; `redundancy` of
    `components` has them): the errors of fewer closures are themselves off by more.

    Where errors are no noise (a scale, a bias, a clock) one factor does not hold for loops of any
    length: `growth` compares short ones and long ones, the words say so where they differ, and
    the intervals of odometry's factors are wider by the differences.

    Intervals come from simulated errors (`integrity.variance_components`), not from closures drawn
    again (bootstrap): copies of one closure share its error, which reads as less noise.

    Args:
        graph: maps, and closures between robots if there are any; or what `weigh` found of them.
        accepted: bool `[m]` or indices, the closures between robots that are right; None: those
            that agree, under wider gates where few agree as stated, which is then said.
        confidence: of the gate that closures pass, between robots or in a map that is cleaned.
        seed: of simulated errors.

    Returns:
        Factors on the information with intervals; float64.

    Raises:
        InputError: where nothing closes a loop, and what optimising the maps raises.
    """
    given = _as_graph(graph)
    own = [_own_loops(one, confidence, seed) for one in given.maps]
    maps = dataclasses.replace(given, maps=tuple(each.graph for each in own))
    count, gate = len(given.closures), float(chi2_gate(confidence, given.tangent_dim))
    chosen = CalibrationSet(
        inside=tuple(each.kept for each in own),
        between=np.zeros(count, bool) if accepted is None else _mask(accepted, count),
        cleaned=tuple(not each.kept.all() for each in own),
        chosen=False,
        wider=1.0,
        gate=gate,
    )
    if accepted is None:
        known = graph if isinstance(graph, Evidence) and not any(chosen.cleaned) else None
        chosen = agreeing(maps, chosen, known, seed)
    components, chosen = _settled(maps, chosen, confidence, seed)
    by_length = growth(parts_of(maps, chosen), components.variance, seed=seed)
    factors = _factors(components, by_length)
    loops = [closing_edges(one) for one in maps.maps]
    inside = sum(int(held[c].sum()) for held, c in zip(chosen.inside, loops, strict=True))
    return Calibration(
        odometry=Factors(*factors[:2]),
        closures=Factors(*factors[2:]),
        map_consistency=tuple(each.chi2 for each in own),
        accepted=chosen.between,
        widened=chosen.wider,
        used=int(chosen.between.sum()) + inside,
        left_out=sum(int(c.sum()) for c in loops) - inside,
        tangent_dim=given.tangent_dim,
        components=components,
        median_information=_median_information(chosen.maps(maps)),
        growth=by_length,
    )


def _settled(
    maps: MultiRobotGraph, chosen: CalibrationSet, confidence: float, seed: int
) -> tuple[Components, CalibrationSet]:
    """The factors, and the closures that fit under them, found in turns until they stay."""
    components = _components(maps, chosen, seed)
    for _ in range(ROUNDS if chosen.gated else 0):
        scaled = scaled_graph(maps, 1.0 / components.variance)
        again = fitting(scaled, agreeing_again(scaled, chosen, confidence), confidence)
        if again.same_as(chosen):
            break
        chosen, components = again, _components(scaled, again, seed).after(components)
    return components, chosen


def _components(maps: MultiRobotGraph, chosen: CalibrationSet, seed: int) -> Components:
    gate = chosen.gate if chosen.gated else None
    return variance_components(parts_of(maps, chosen), gate, seed=seed)


class _Own(NamedTuple):
    """A map and what is right in it.

    Attributes:
        graph: with all its edges, at the optimum of those kept.
        kept: bool [e], those that are not false closures.
        chi2: normalised, of those kept as stated; None without loops.
    """

    graph: PoseGraph
    kept: Bool[np.ndarray, " e"]
    chi2: float | None


def _own_loops(given: PoseGraph, confidence: float, seed: int) -> _Own:
    one = given.without_priors()
    every, loops = np.ones(one.num_edges, bool), int(closing_edges(one).sum())
    if not loops:
        return _Own(one, every, None)
    solved = optimize(one)
    chi2 = _normalized(one, solved.cost)
    as_given = _Own(solved.graph, every, chi2)
    bad = not solved.converged or (chi2 or 0.0) > TOO_BAD
    if loops < FEW or not (bad or _has_tails(solved.graph, seed)):
        return as_given
    kept = _cleaned(one, confidence, seed)
    if kept is None:
        return as_given
    again = optimize(one.with_edges(kept))
    cleaned = _Own(one.with_poses(again.graph.poses), kept, _normalized(again.graph, again.cost))
    merely_sure = solved.converged and bad and (cleaned.chi2 or 0.0) > BETTER * (chi2 or 0.0)
    return as_given if merely_sure else cleaned


def _normalized(one: PoseGraph, cost: float) -> float | None:
    freedom = (one.num_edges - one.num_poses + 1) * one.tangent_dim
    return 2.0 * cost / freedom if freedom > 0 else None


def _has_tails(graph: PoseGraph, seed: int) -> bool:
    """True where some residuals are far larger than the rest: false loops do that to a map."""
    closing = closing_edges(graph)
    found = variance_components([Part(graph, closing, closing & False)], seed=seed)
    return bool(found.tails.max() > DIRTY) or not found.converged


def _cleaned(one: PoseGraph, confidence: float, seed: int) -> Bool[np.ndarray, " e"] | None:
    """The edges without closures that contradict the map; None where that takes all closures."""
    try:
        kept = select_within(one, confidence=confidence, recall=False, seed=seed)
    except InputError:  # no chain of odometry
        return None
    return kept.kept if kept.accepted.any() else None


def _factors(components: Components, by_length: Growth) -> list[Factor]:
    """Factors on information; odometry's those for loops of any length, where these differ."""
    factors = []
    for row in range(4):
        times = by_length.variance if row < 2 else 1.0
        ends = (components.variance[row], components.low[row], components.high[row])
        variance, low, high = (times * each for each in ends)
        if not np.isfinite(high):
            factors.append(Factor(1.0, (0.0, np.inf)))
            continue
        more = NINE_IN_TEN * by_length.deviation if row < 2 else 0.0
        down, up = (np.hypot(np.log(ratio), more) for ratio in (variance / low, high / variance))
        factors.append(Factor(1.0 / variance, (np.exp(-up) / variance, np.exp(down) / variance)))
    return factors


def _median_information(graph: MultiRobotGraph) -> np.ndarray:
    """As stated, of odometry's and closures' translations and rotations."""
    information = [np.asarray(one.information) for one in graph.maps]
    closing = np.concatenate([*map(closing_edges, graph.maps), np.ones(len(graph.closures), bool)])
    diagonal = np.concatenate([*information, np.asarray(graph.closures.information)])
    diagonal = np.diagonal(diagonal, axis1=1, axis2=2)
    half = graph.tangent_dim - 1 if graph.tangent_dim == 3 else 3
    parts = [
        diagonal[rows][:, axes]
        for rows in (~closing, closing)
        for axes in (slice(half), slice(half, None))
    ]
    return np.array([np.median(part) if part.size else np.nan for part in parts])


def _as_graph(graph: Any) -> MultiRobotGraph:
    if isinstance(graph, PoseGraph):
        return MultiRobotGraph((graph,))
    if isinstance(graph, Evidence):
        return graph.graph
    if not isinstance(graph, MultiRobotGraph):
        raise InputError(
            f"graph: {type(graph).__name__} given, expected maps (a MultiRobotGraph or a"
            " PoseGraph) or Evidence"
        )
    return graph


def _mask(accepted: Any, count: int) -> Bool[np.ndarray, " m"]:
    """The mask of a mask or of indices."""
    chosen = np.asarray(accepted)
    if chosen.dtype == bool and chosen.shape == (count,):
        return chosen.copy()
    if (
        chosen.dtype.kind not in "iu"
        or chosen.ndim != 1
        or ((chosen < 0) | (chosen >= count)).any()
    ):
        raise InputError(
            f"accepted: {chosen.dtype} {list(chosen.shape)}, expected bool [{count}], one per"
            f" closure, or indices 0 … {count - 1}"
        )
    mask = np.zeros(count, bool)
    mask[chosen] = True
    return mask
