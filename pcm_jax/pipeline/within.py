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
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.consistency import (
    PairEvidence,
    chi2_gate,
    odometry_edges,
    own_loops,
    squared_mahalanobis,
    squared_own_loops,
    with_odometry_errors,
    within_problem,
)
from pcm_jax.errors import InputError
from pcm_jax.graph import MultiRobotGraph, PoseGraph
from pcm_jax.integrity import SIGNIFICANCE, ChanceLevel, Places, Verdict
from pcm_jax.integrity.odometry import odometry_scale as estimated_scale
from pcm_jax.integrity.places import longest_run
from pcm_jax.integrity.within import Loops, level_of_measurements, level_of_poses
from pcm_jax.pipeline.select import CHANCE, check_minimum
from pcm_jax.selection.choose import Method, check_method, choose
from pcm_jax.selection.method import Choice
from pcm_jax.selection.methods import METHODS
from pcm_jax.selection.within_one_map import WithinSelection

TIME_LIMIT = 60.0  # seconds
AS_GOOD = 0.9
"""Of the closures that agree under another scale: if so many do as stated, it is as stated. And of
those as stated: what a set under another scale must keep, else it is another answer."""
PAIR = 2
"""Closures that suffice without odometry's word, which the tests of chance go by."""
MOST = 1500
"""Closures that are shuffled; of more, so many drawn at random."""


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
    time_limit: float | None = None,
    seed: int = 0,
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
        time_limit: seconds for the method, if it has the option: 60 by default, `math.inf` for any
            time. Whether it sufficed is `optimal`.
        seed: of what chance draws; the same seed gives the same answer.
        **options: the method's own, see `select_from`.

    Returns:
        the selection, with the cleaned map; float64 whatever the caller's `jax_enable_x64`.

    Raises:
        InputError: for consecutive poses that no edge joins, an unknown method or option, a
            confidence or significance outside (0, 1), a negative minimum or separation, a scale
            that is not above 0.
    """
    options = _with_time_limit(method, time_limit, options)
    check_minimum(minimum_inliers, significance)
    _check_numbers(odometry_scale, significance, separation)
    gate = float(chi2_gate(confidence, pose_graph.tangent_dim))
    asked = _Asked(gate, method, own_loop, options, separation)
    start = time.perf_counter()
    odometry = np.zeros(pose_graph.num_edges, bool)
    odometry[odometry_edges(pose_graph)] = True
    closures = np.flatnonzero(~odometry)
    trials = _Trials(pose_graph, closures, asked)
    found = trials.all(odometry_scale)
    chosen = time.perf_counter()
    if minimum_inliers == CHANCE and own_loop:
        level = SIGNIFICANCE if significance is None else significance
        trial, verdict = _by_chance(trials, found, level, seed)
    else:
        minimum = PAIR if isinstance(minimum_inliers, str) else minimum_inliers
        trial, verdict = found[0], _by_number(trials, found[0], minimum)
    if not verdict.believed and own_loop:
        why = verdict.why + trials.contradicting(trial)
        verdict = dataclasses.replace(verdict, why=why)
    kept = odometry.copy()
    kept[closures] = trial.members & verdict.believed
    return WithinSelection(
        graph=pose_graph.with_edges(kept),
        kept=kept,
        odometry=odometry,
        closures=closures,
        squared=trial.squared,
        own_squared=trial.own_squared,
        gate=gate,
        accepted=kept[closures],
        optimal=trial.choice.optimal,
        upper_bound=trial.choice.upper_bound,
        seconds={
            "consistency": trials.measuring,
            "clique": chosen - start - trials.measuring,
            "chance": time.perf_counter() - chosen,
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
    looped = [each.num_edges >= each.num_poses for each in graph.maps]
    for each, has_loops in zip(graph.maps, looped, strict=True):
        if has_loops:
            odometry_edges(each)  # raises for any map before the first one takes its time
    minimum = options.get("minimum_inliers", CHANCE)
    check_minimum(minimum, significance)
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


class _Asked(NamedTuple):
    """The question, checked."""

    gate: float
    method: Method
    own_loop: bool
    options: dict[str, Any]
    separation: float | None


class _Trial(NamedTuple):
    """The closures that a method finds under one scale of odometry's errors.

    Attributes:
        factor: on odometry's standard deviations.
        fitted: whether these closures themselves said so.
        squared: float64 [m, m].
        own_squared: float64 [m].
        choice: among the closures that agree with odometry.
        members: bool [m].
    """

    factor: float
    fitted: bool
    squared: Float[np.ndarray, "m m"]
    own_squared: Float[np.ndarray, " m"]
    choice: Choice
    members: Bool[np.ndarray, " m"]

    @property
    def found(self) -> int:
        return int(self.members.sum())


class _Trials:
    """One map's closures, to be tried under several scales of odometry's errors."""

    def __init__(self, graph: PoseGraph, closures: np.ndarray, asked: _Asked):
        self.graph, self.closures, self.asked, self.measuring = graph, closures, asked, 0.0
        self.problem = within_problem(graph)
        odometry = lie.take(lie.as_numpy(graph.measurement), odometry_edges(graph))
        steps = np.linalg.norm(lie.translation(odometry), axis=1)
        way = np.concatenate([[0.0], np.cumsum(steps)])
        ends = np.stack([np.asarray(graph.tail), np.asarray(graph.head)])[:, closures]
        self.ends = np.sort(ends, axis=0)
        self.ways, self.step = (way[self.ends[0]], way[self.ends[1]]), way[-1] / max(1, len(steps))
        touched = [
            lie.translation(lie.as_numpy(p)) for p in (self.problem.pose_a, self.problem.pose_b)
        ]
        self.extent = np.ptp(np.concatenate(touched), axis=0)

    def all(self, given: float | None) -> list[_Trial]:
        """The trials that may be believed, the preferred one first."""
        if given is not None:
            return [self._at(given, fitted=False)]
        stated = self._at(1.0, fitted=False)
        if not self.asked.own_loop or not len(self.closures):
            return [stated]
        loops = own_loops(self.problem)
        scale = estimated_scale(loops, self.extent)
        if scale.factor == 1.0 or not scale.found:
            return [stated]
        fitted = self._at(scale.factor, fitted=True)
        if stated.found >= AS_GOOD * fitted.found:
            return [stated]
        contained = np.count_nonzero(fitted.members & stated.members) >= AS_GOOD * stated.found
        return [fitted, stated] if contained else [stated, fitted]

    def _at(self, factor: float, *, fitted: bool) -> _Trial:
        start = time.perf_counter()
        problem = with_odometry_errors(self.problem, factor) if factor != 1.0 else self.problem
        squared = np.asarray(squared_mahalanobis(problem))
        own_squared = np.asarray(squared_own_loops(problem))
        self.measuring += time.perf_counter() - start
        agreeing = (own_squared <= self.asked.gate) | (not self.asked.own_loop)
        choice, members = self._chosen(squared, np.flatnonzero(agreeing))
        return _Trial(factor, fitted, squared, own_squared, choice, members)

    def _chosen(self, squared: np.ndarray, among: np.ndarray) -> tuple[Choice, np.ndarray]:
        evidence = PairEvidence.from_squared(squared[np.ix_(among, among)])
        asked = self.asked
        choice = choose(evidence, asked.gate, method=asked.method, **asked.options)
        members = np.zeros(len(squared), bool)
        members[among] = choice.members
        return choice, members

    def places(self, trial: _Trial) -> Places:
        """Where the closures lie; the separation is that of the trial's set."""
        separation = self.asked.separation
        if separation is None:
            evidence = PairEvidence.from_squared(trial.squared)
            steps = (self.step, self.step)
            separation = longest_run(evidence, self.asked.gate, trial.members, self.ways, steps)
        return Places(self.ways[0], self.ways[1], float(separation))

    def loops(self, places: Places) -> Loops:
        """The closures, for tests of chance."""
        return Loops(self.graph, self.problem, places, self.extent)

    def some(self, places: Places, generator: np.random.Generator) -> tuple[Loops, np.ndarray]:
        """The closures that are shuffled, and which they are."""
        count = len(self.closures)
        if count <= MOST:
            return self.loops(places), np.arange(count)
        chosen = np.sort(generator.choice(count, MOST, replace=False))
        graph = self.graph.with_edges(
            np.concatenate([odometry_edges(self.graph), self.closures[chosen]])
        )
        thinned = Places(self.ways[0][chosen], self.ways[1][chosen], places.separation)
        return Loops(graph, within_problem(graph), thinned, self.extent), chosen

    def contradicting(self, trial: _Trial) -> str:
        """Says so where closures agree among themselves, but hardly any with odometry."""
        agreeing = int(np.count_nonzero(trial.own_squared <= self.asked.gate))
        _, among_all = self._chosen(trial.squared, np.arange(len(trial.members)))
        if among_all.sum() < 3 or 2 * agreeing > among_all.sum():
            return ""
        return (
            f"; everything contradicts odometry: {among_all.sum()} of {len(trial.members)} closures"
            f" agree among themselves, but only {agreeing} with odometry"
        )


def _by_chance(
    trials: _Trials, found: list[_Trial], significance: float, seed: int
) -> tuple[_Trial, Verdict]:
    """The first trial that is beyond chance; the last one if none is."""
    share = significance / len(found)
    judged: list[tuple[_Trial, Verdict]] = []
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
    trials: _Trials, trial: _Trial, places: Places, significance: float, seed: int
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


def _by_number(trials: _Trials, trial: _Trial, minimum: int) -> Verdict:
    places = trials.places(trial)
    why = f"{_found(trial)}, {minimum} asked for"
    return Verdict(
        believed=trial.found >= minimum,
        why=why,
        found=trial.found,
        places=places.count(trial.members),
        separation=places.separation,
    )


def _found(trial: _Trial) -> str:
    under = (
        "as stated"
        if trial.factor == 1.0
        else f"were its errors {trial.factor:.3g} times those stated"
    )
    return (
        f"{trial.found} of {len(trial.members)} closures agree with each other and odometry {under}"
    )


def _why(
    trial: _Trial, places: Places, chance: ChanceLevel, significance: float, passes: bool
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
