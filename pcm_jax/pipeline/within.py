"""`select_within`: the loop closures inside one robot's own map to believe.

Between two robots nothing says beforehand where one is from the other, and the largest consistent
set is all there is to go by. Inside one map odometry says it for every closure by itself. So a
closure must agree with odometry alone as well as with the others (`own_loop`): by the gate, that
costs right closures no more than one pair does, and it rejects groups of false ones that agree
among themselves, however large, as soon as they contradict odometry.

Odometry that states its errors too small contradicts right closures as well. Where a larger scale
of its errors, estimated from the closures (`integrity.odometry`), lets clearly more of them agree,
they are judged under that; but if it drops those that agree with odometry as stated, only if these
are not beyond chance: many false closures that say the same are no scale. What is found is accepted
if chance hardly does as well (`integrity.within`): under a fitted scale by shuffles that are fitted
too, at half the level; as stated by either test, at half of what is left each.

The larger the largest set, the more right closures it leaves out, of which one pair in a hundred
fails the gate; those that the cleaned map agrees with come back (`_within_recall`).
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np

from pcm_jax.arrays import on_host
from pcm_jax.consistency import (
    chi2_gate,
    odometry_edges,
)
from pcm_jax.errors import InputError, check_class
from pcm_jax.graph import MultiRobotGraph, PoseGraph
from pcm_jax.integrity import SIGNIFICANCE, ChanceLevel, Places, Verdict
from pcm_jax.integrity.within import level_of_measurements, level_of_poses
from pcm_jax.pipeline._within_recall import with_recalled
from pcm_jax.pipeline._within_trials import Asked, Trial, Trials
from pcm_jax.pipeline.select import CHANCE, check_minimum
from pcm_jax.selection.choose import Method, check_method
from pcm_jax.selection.methods import METHODS
from pcm_jax.selection.within_one_map import WithinSelection

TIME_LIMIT = 60.0  # seconds
PAIR = 2
"""Closures that suffice without odometry's word, which the tests of chance go by."""


@on_host
def select_within(
    pose_graph: PoseGraph,
    *,
    confidence: float = 0.99,
    method: Method = "pcm-exact",
    own_loop: bool = True,
    odometry_scale: float | None = None,
    minimum_inliers: int | str = CHANCE,
    significance: float | None = None,
    separation: float | None = None,
    recall: bool | None = None,
    time_limit: float | None = None,
    seed: int | None = None,
    **options: Any,
) -> WithinSelection:
    """Selects the loop closures to believe inside one map.

        cleaned = pcm_jax.select_within(graph.maps[0])
        cleaned.accepted, cleaned.graph
        cleaned.verdict.why                     # in a sentence

    Squared distances are measured in the map that odometry alone gives, with its covariance as the
    edges state it or, where that contradicts what the closures have in common, a multiple of it.
    Priors of the map are kept and play no part in this.

    Args:
        pose_graph: a chain of odometry, one edge from each pose to the next in either direction
            (the first of several; others are closures), and closures, which are all other edges.
        confidence: probability that the loop of two right closures passes the gate, and that of
            one with odometry.
        method: see `select_from`.
        own_loop: whether a closure must agree with odometry by itself too. Without that, two that
            agree with each other suffice.
        odometry_scale: the factor on the standard deviations that odometry states; None: as stated,
            or what the closures themselves say if that is more (under `own_loop`). Not right where
            odometry is better than stated: 1 is then used, which tests less sharply than could be.
        minimum_inliers: "chance": what is found is accepted if closures of which none is right
            would hardly agree as well, see `integrity.within`; or a number: if that many are found.
        significance: with "chance": the probability that any is accepted where none is right; 0.01
            by default.
        separation: metres along the way between closures that are two witnesses, see
            `integrity.places`; by default as there.
        recall: whether closures that the largest set leaves out come back where the map that it
            makes agrees with them; None: with "chance" and `own_loop`.
        time_limit: seconds for the method, if it has the option: 60 by default, `math.inf` for any
            time. Whether it sufficed is `optimal`.
        seed: of what chance draws, 0 by default; the same seed gives the same answer.
        **options: the method's own, see `select_from`.

    Returns:
        the selection, with the cleaned map; float64 whatever the caller's `jax_enable_x64`.

    Raises:
        InputError: for consecutive poses that no edge joins, an unknown method or option, a
            confidence or significance outside (0, 1), a negative minimum or separation, a scale
            that is not above 0.
    """
    check_class("pose_graph", pose_graph, "a PoseGraph", PoseGraph)
    options = _with_time_limit(method, time_limit, options)
    check_minimum(minimum_inliers, _given(significance=significance, seed=seed))
    _check_numbers(odometry_scale, significance, separation)
    if recall is not None and not isinstance(recall, bool):
        raise InputError(f"recall: {recall!r}, expected True, False or None")
    gate = float(chi2_gate(confidence, pose_graph.tangent_dim))
    asked = Asked(gate, method, own_loop, options, separation)
    start = time.perf_counter()
    odometry = np.zeros(pose_graph.num_edges, bool)
    odometry[odometry_edges(pose_graph)] = True
    closures = np.flatnonzero(~odometry)
    trials = Trials(pose_graph, closures, asked)
    found = trials.all(odometry_scale)
    chosen = time.perf_counter()
    if minimum_inliers == CHANCE and own_loop:
        level = SIGNIFICANCE if significance is None else significance
        trial, verdict = _by_chance(trials, found, level, seed or 0)
    else:
        minimum = PAIR if isinstance(minimum_inliers, str) else minimum_inliers
        trial, verdict = found[0], _by_number(trials, found[0], minimum)
    if not verdict.believed and own_loop:
        why = verdict.why + trials.contradicting(trial)
        verdict = dataclasses.replace(verdict, why=why)
    kept = odometry.copy()
    kept[closures] = trial.members & verdict.believed
    members = kept.copy()
    if recall is None:
        recall = minimum_inliers == CHANCE and own_loop
    judged = time.perf_counter()
    if recall and kept[closures].any():
        asked_of = {"factor": trial.factor, "confidence": confidence}
        kept = with_recalled(pose_graph, kept, odometry, **asked_of)
    return WithinSelection(
        graph=pose_graph.with_edges(kept),
        kept=kept,
        odometry=odometry,
        closures=closures,
        squared=trial.squared,
        own_squared=trial.own_squared,
        gate=gate,
        accepted=kept[closures],
        recalled=(kept & ~members)[closures],
        optimal=trial.choice.optimal,
        upper_bound=trial.choice.upper_bound,
        seconds={
            "consistency": trials.measuring,
            "clique": chosen - start - trials.measuring,
            "chance": judged - chosen,
            "recall": time.perf_counter() - judged,
        },
        odometry_scale=trial.factor,
        verdict=verdict,
    )


def clean_maps(
    graph: MultiRobotGraph, *, significance: float | None = None, **options: Any
) -> tuple[MultiRobotGraph, tuple[WithinSelection | None, ...]]:
    """Cleans every robot's map by `select_within`; closures between robots stay as they are.

        graph, selections = pcm_jax.clean_maps(graph)

    Args:
        graph: the robots' maps.
        significance: the probability that any map accepts closures of which none is right, all maps
            together; 0.01 by default.
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
    minimum = options.get("minimum_inliers", CHANCE)
    check_minimum(minimum, _given(significance=significance))
    _check_numbers(significance=significance)
    if minimum == CHANCE:
        level = SIGNIFICANCE if significance is None else significance
        options["significance"] = level / max(1, sum(looped))
    selections = tuple(
        select_within(each, **options) if has_loops else None
        for each, has_loops in zip(graph.maps, looped, strict=True)
    )
    maps = tuple(
        each if selection is None else selection.graph
        for each, selection in zip(graph.maps, selections, strict=True)
    )
    return MultiRobotGraph(maps, graph.closures), selections


def _given(**options: Any) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


def _by_chance(
    trials: Trials, found: list[Trial], significance: float, seed: int
) -> tuple[Trial, Verdict]:
    """The first trial that is beyond chance; the last one if none is."""
    share = significance / len(found)
    judged: list[tuple[Trial, Verdict]] = []
    for trial in found:
        places = trials.places(trial)
        if trial.fitted:
            loops, chosen = trials.some(places, np.random.default_rng(seed))
            accepted = trial.members[chosen]
            asked: dict[str, Any] = {"factor": None, "significance": share, "seed": seed}
            chance = level_of_measurements(loops, trials.asked.gate, accepted, **asked)
            passes = chance.p_value <= share
        else:
            chance, passes = _either(trials, trial, places, share, seed)
        verdict = Verdict(
            believed=passes and trial.found > 0,
            why=_why(trial, places, chance, share, passes),
            found=trial.found,
            places=places.count(trial.members),
            separation=places.separation,
            chance=chance,
        )
        judged.append((trial, verdict))
        if verdict.believed:
            break
    return next((each for each in judged if each[1].believed), judged[0])


def _either(
    trials: Trials, trial: Trial, places: Places, significance: float, seed: int
) -> tuple[ChanceLevel, bool]:
    """Either test of chance, each at half the level; the one that passes, or the smaller p."""
    gate, half = trials.asked.gate, 0.5 * significance
    if trial.found < 2:
        nothing = ChanceLevel(trial.found, 1.0, 1.0, 0, np.zeros(0, np.int64), len(trial.members))
        return nothing, False
    poses = level_of_poses(
        trials.loops(places), gate, trial.members, factor=trial.factor, seed=seed
    )
    if poses.p_value <= half:
        return poses, True
    loops, chosen = trials.some(places, np.random.default_rng(seed))
    asked: dict[str, Any] = {"factor": trial.factor, "significance": half, "seed": seed}
    measured = level_of_measurements(loops, gate, trial.members[chosen], **asked)
    best = min(poses, measured, key=lambda each: each.p_value)
    return best, measured.p_value <= half


def _by_number(trials: Trials, trial: Trial, minimum: int) -> Verdict:
    places = trials.places(trial)
    why = f"{_found(trial)}, {minimum} asked for"
    return Verdict(
        believed=trial.found >= minimum,
        why=why,
        found=trial.found,
        places=places.count(trial.members),
        separation=places.separation,
    )


def _found(trial: Trial) -> str:
    under = (
        "as stated"
        if trial.factor == 1.0
        else f"were its errors {trial.factor:.3g} times those stated"
    )
    return (
        f"{trial.found} of {len(trial.members)} closures agree with each other and odometry {under}"
    )


def _why(
    trial: Trial, places: Places, chance: ChanceLevel, significance: float, passes: bool
) -> str:
    if not len(trial.members):
        return "no closures"
    where = f"{_found(trial)}, at {places.count(trial.members)} places"
    if passes:
        return f"{where}; chance does as well with p = {chance.p_value:.2g}"
    return (
        f"{where}, which cannot be told from chance (p = {chance.p_value:.2g},"
        f" {significance:g} asked for)"
    )


def _check_numbers(
    odometry_scale: float | None = None,
    significance: float | None = None,
    separation: float | None = None,
) -> None:
    if odometry_scale is not None and not 0.0 < odometry_scale < np.inf:
        raise InputError(f"odometry_scale: {odometry_scale}, expected a factor above 0")
    if significance is not None and not 0.0 < significance < 1.0:
        raise InputError(f"significance: {significance}, expected a number between 0 and 1")
    if separation is not None and not separation >= 0.0:
        raise InputError(f"separation: {separation}, expected metres, at least 0")


def _with_time_limit(
    method: Method, time_limit: float | None, options: dict[str, Any]
) -> dict[str, Any]:
    """The method's options, checked; with the default limit if it takes one."""
    given = options if time_limit is None else {**options, "time_limit": time_limit}
    check_method(method, given)
    if isinstance(method, str) and "time_limit" in METHODS[method].options:
        return {"time_limit": TIME_LIMIT, **given}
    return given
