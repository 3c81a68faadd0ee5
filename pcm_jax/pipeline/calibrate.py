"""`calibrate`: from a graph or its evidence to factors on its information.

Loops inside maps and accepted closures between robots are judged together, each group of robots as
one graph. Maps whose loops contradict each other are cleaned before (`pipeline.within`). Where
closures between robots are selected here, they are selected again under the factors found: what
agrees with far too large deviations need not be right.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from pcm_jax.arrays import on_host
from pcm_jax.consistency import Evidence, PairEvidence, chi2_gate
from pcm_jax.errors import InputError
from pcm_jax.graph import MultiRobotGraph, PoseGraph
from pcm_jax.integrity import SIGNIFICANCE, chance_level, places_of
from pcm_jax.integrity.calibration import (
    Calibration,
    Factor,
    Factors,
    closing_edges,
    scaled_graph,
)
from pcm_jax.integrity.variance_components import Components, Part, variance_components
from pcm_jax.mapping import optimize
from pcm_jax.merging import TOO_BAD
from pcm_jax.merging.alignment import aligned_anchors
from pcm_jax.merging.groups import closures_within, robot_groups
from pcm_jax.merging.joint import joint_graph
from pcm_jax.pipeline.weigh import weigh
from pcm_jax.pipeline.within import select_within
from pcm_jax.selection import choose

ROUNDS = 3
"""Selections under the factors found so far, at most."""
WIDER = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Times the stated deviations, for closures of which few agree as stated."""
MORE, KEPT = 1.5, 0.9
"""A wider gate is taken if it lets so many times more agree, and keeps so many of those before. At
the first that is not, gates are wide enough: of yet wider ones false closures would agree."""
DIRTY = 4.0
"""Times the variance of normal residuals: a map with false loops."""
BETTER = 0.1
"""Times the chi-squared: a map that fits so much better without some loops had false ones; one that
does not has small deviations."""
FEW = 3
"""Loops of a map below which that cannot be told."""
LIMIT = 5.0
"""Seconds for a clique."""


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
    closes shares its one misfit with it. Not right where errors are no noise (a scale, a bias, a
    clock): the factors then cover them on average, and a longer drive has others.

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
    cleaned = dataclasses.replace(given, maps=tuple(each.graph for each in own))
    evidence = (
        graph if isinstance(graph, Evidence) and not any(each.left_out for each in own) else None
    )
    gate = float(chi2_gate(confidence, given.tangent_dim))
    if accepted is None:
        chosen = _agreeing(cleaned, evidence, gate, seed)
    else:
        chosen = _Chosen(_mask(accepted, len(given.closures)), 1.0, gated=False)
    widened = chosen.wider
    components = _components(cleaned, own, chosen, gate, seed)
    for _ in range(ROUNDS if accepted is None and chosen.accepted.any() else 0):
        scaled = scaled_graph(cleaned, 1.0 / components.variance)
        again = _agreeing(scaled, None, gate, seed, widen=False)
        if (again.accepted == chosen.accepted).all() or not again.accepted.any():
            break
        chosen = again
        components = _components(scaled, own, chosen, gate, seed).after(components)
    return Calibration(
        odometry=Factors(*_factors(components)[:2]),
        closures=Factors(*_factors(components)[2:]),
        map_consistency=tuple(each.chi2 for each in own),
        accepted=chosen.accepted,
        widened=widened,
        used=int(chosen.accepted.sum() + sum(each.loops for each in own)),
        left_out=sum(each.left_out for each in own),
        tangent_dim=given.tangent_dim,
        components=components,
        median_information=_median_information(cleaned),
    )


class _Own(NamedTuple):
    """A map, cleaned if that was needed.

    Attributes:
        graph: at its optimum.
        loops: closures inside it that are left.
        left_out: closures that are not.
        chi2: normalised, as stated; None without loops.
    """

    graph: PoseGraph
    loops: int
    left_out: int
    chi2: float | None


class _Chosen(NamedTuple):
    """The closures between robots to go by.

    Attributes:
        accepted: bool [m].
        wider: times the deviations as they were, under which these agree.
        gated: whether a gate chose them.
    """

    accepted: Bool[np.ndarray, " m"]
    wider: float
    gated: bool


def _own_loops(given: PoseGraph, confidence: float, seed: int) -> _Own:
    one = given.without_priors()
    loops = int(closing_edges(one).sum())
    if not loops:
        return _Own(one, 0, 0, None)
    solved = optimize(one)
    chi2 = _normalized(one, solved.cost)
    as_given = _Own(solved.graph, loops, 0, chi2)
    bad = not solved.converged or (chi2 or 0.0) > TOO_BAD
    if loops < FEW or not (bad or _has_tails(solved.graph, seed)):
        return as_given
    kept = _cleaned(one, confidence, seed)
    if kept is None:
        return as_given
    again, left = optimize(kept), int(closing_edges(kept).sum())
    cleaned = _Own(again.graph, left, loops - left, _normalized(kept, again.cost))
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


def _cleaned(one: PoseGraph, confidence: float, seed: int) -> PoseGraph | None:
    """The map without closures that contradict it; None where that takes them all."""
    try:
        kept = select_within(one, confidence=confidence, recall=False, seed=seed)
    except InputError:  # no chain of odometry
        return None
    return kept.graph if kept.accepted.any() else None


def _agreeing(
    graph: MultiRobotGraph, evidence: Evidence | None, gate: float, seed: int, *, widen: bool = True
) -> _Chosen:
    """The closures that agree; under wider gates as long as each lets clearly more agree."""
    best = _Chosen(np.zeros(len(graph.closures), bool), 1.0, gated=False)
    if not len(graph.closures):
        return best
    pairs = (evidence or weigh(graph)).pairs
    for wider in WIDER if widen else WIDER[:1]:
        accepted = best.accepted.copy()
        for pair in pairs:
            members = choose(pair, gate * wider**2, time_limit=LIMIT).members
            before = accepted[pair.closures]
            more = members.sum() > MORE * before.sum()
            kept = (members & before).sum() >= KEPT * before.sum()
            if more and kept and _beyond_chance(pair, gate * wider**2, members, seed):
                accepted[pair.closures] = members
        if best.accepted.any() and accepted.sum() <= MORE * best.accepted.sum():
            break
        best = _Chosen(accepted, wider, gated=bool(accepted.any()))
    return best


def _beyond_chance(pair: PairEvidence, gate: float, members: np.ndarray, seed: int) -> bool:
    places = places_of(pair, gate=gate, members=members)
    return chance_level(pair, gate, places, members, seed=seed).p_value <= SIGNIFICANCE


def _components(
    graph: MultiRobotGraph, own: list[_Own], chosen: _Chosen, gate: float, seed: int
) -> Components:
    """Fits the factors to each group of robots as one graph."""
    groups = robot_groups(len(graph.maps), graph.closures, chosen.accepted)
    anchors = aligned_anchors(graph, chosen.accepted, groups)
    parts = []
    for members in groups:
        used = closures_within(members, graph.closures, chosen.accepted)
        joint = joint_graph(graph, members, used, anchors)
        dirty = [np.full(graph.maps[r].num_edges, own[r].left_out > 0) for r in members]
        inside = [closing_edges(graph.maps[robot]) for robot in members]
        closing = np.concatenate([*inside, np.ones(len(used), bool)])
        gated = np.concatenate([*dirty, np.full(len(used), chosen.gated)]) & closing
        parts.append(Part(joint, closing, gated))
    any_gated = any(part.gated.any() for part in parts)
    return variance_components(parts, gate * chosen.wider**2 if any_gated else None, seed=seed)


def _factors(components: Components) -> list[Factor]:
    ends = zip(components.variance, components.low, components.high, strict=True)
    return [
        Factor(1.0 / variance, (1.0 / high, 1.0 / low))
        if np.isfinite(high)
        else Factor(1.0, (0.0, np.inf))
        for variance, low, high in ends
    ]


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
