"""The decision on the closures inside one map, from trials of what agrees."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from pcm_jax.consistency import chi2_gate, odometry_edges
from pcm_jax.errors import InputError
from pcm_jax.graph import PoseGraph
from pcm_jax.integrity import SIGNIFICANCE, ChanceLevel, Places, Verdict
from pcm_jax.integrity.within import level_of_measurements, level_of_poses
from pcm_jax.pipeline._within_recall import with_recalled
from pcm_jax.pipeline._within_recheck import rechecked
from pcm_jax.pipeline.select import CHANCE, check_minimum
from pcm_jax.pipeline.within_trials import Asked, Trial, Trials
from pcm_jax.selection.choose import Method, check_method
from pcm_jax.selection.methods import METHODS
from pcm_jax.selection.within_one_map import WithinSelection

TIME_LIMIT = 60.0  # seconds
PAIR = 2
"""Closures that suffice without odometry's word, which the tests of chance go by."""


@dataclasses.dataclass(frozen=True)
class Question:
    """The options of `select_within`, checked.

    Attributes:
        confidence, method, own_loop, odometry_scale, minimum_inliers, significance, separation,
        recheck, recall, time_limit, seed: as there.
        options: the method's own.

    Raises:
        InputError: as there.
    """

    confidence: float = 0.99
    method: Method = "pcm-exact"
    own_loop: bool = True
    odometry_scale: float | None = None
    minimum_inliers: int | str = CHANCE
    significance: float | None = None
    separation: float | None = None
    recheck: bool = False
    recall: bool | None = None
    time_limit: float | None = None
    seed: int | None = None
    options: dict[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        _ = self.method_options
        check_minimum(self.minimum_inliers, given(significance=self.significance, seed=self.seed))
        check_numbers(self.odometry_scale, self.significance, self.separation)
        if self.recall is not None and not isinstance(self.recall, bool):
            raise InputError(f"recall: {self.recall!r}, expected True, False or None")
        if not isinstance(self.recheck, bool):
            raise InputError(f"recheck: {self.recheck!r}, expected True or False")

    @classmethod
    def from_options(cls, options: dict[str, Any]) -> Question:
        """The question that `select_within(graph, **options)` asks."""
        own = {field.name for field in dataclasses.fields(cls)} - {"options"}
        said = {name: value for name, value in options.items() if name in own}
        rest = {name: value for name, value in options.items() if name not in own}
        return cls(**said, options=rest)

    @property
    def method_options(self) -> dict[str, Any]:
        """The method's options, with the default limit of time if it takes one."""
        return _with_time_limit(self.method, self.time_limit, self.options)

    @property
    def by_chance(self) -> bool:
        """True where the tests of chance decide, which go by odometry's word."""
        return self.minimum_inliers == CHANCE and self.own_loop

    @property
    def recalls(self) -> bool:
        """True where closures that the largest set leaves out may come back."""
        return self.by_chance if self.recall is None else self.recall

    def asked(self, dim: int) -> Asked:
        """Extracts what a trial needs to know, for tangent vectors of `dim` entries."""
        gate = float(chi2_gate(self.confidence, dim))
        return Asked(gate, self.method, self.own_loop, self.method_options, self.separation)


TrialsOf = Callable[[PoseGraph, Int[np.ndarray, " m"], Asked], Trials]


def decided(pose_graph: PoseGraph, question: Question, trials_of: TrialsOf) -> WithinSelection:
    """The selection, from trials of a map's closures.

    Args:
        pose_graph: a chain with closures, as for `select_within`.
        question: its options.
        trials_of: `Trials`, or what knows some of it already.

    Raises:
        InputError: for consecutive poses that no edge joins.
    """
    asked = question.asked(pose_graph.tangent_dim)
    start = time.perf_counter()
    odometry = np.zeros(pose_graph.num_edges, bool)
    odometry[odometry_edges(pose_graph)] = True
    closures = np.flatnonzero(~odometry)
    trials = trials_of(pose_graph, closures, asked)
    found = trials.all(question.odometry_scale)
    chosen = time.perf_counter()
    trial, verdict = _judged(trials, found, question)
    kept = odometry.copy()
    kept[closures] = trial.members & verdict.believed
    members, whole = kept, _as_judged(pose_graph, odometry, trial.factor)
    judged = time.perf_counter()
    if question.recheck and kept[closures].any():
        core = np.zeros(pose_graph.num_edges, bool)
        core[closures] = trials.core(trial)
        kept = rechecked(whole, kept, core & kept, odometry, question.confidence)
    checked = time.perf_counter()
    if question.recalls and kept[closures].any():
        kept = with_recalled(whole, kept, odometry, question.confidence)
    return WithinSelection(
        graph=pose_graph.with_edges(kept),
        kept=kept,
        odometry=odometry,
        closures=closures,
        squared=trial.squared,
        own_squared=trial.own_squared,
        gate=asked.gate,
        accepted=kept[closures],
        recalled=(kept & ~members)[closures],
        dropped=(members & ~kept)[closures],
        optimal=trial.choice.optimal,
        upper_bound=trial.choice.upper_bound,
        seconds={
            "consistency": trials.measuring,
            "clique": chosen - start - trials.measuring,
            "chance": judged - chosen,
            **({"recheck": checked - judged} if question.recheck else {}),
            "recall": time.perf_counter() - checked,
        },
        odometry_scale=trial.factor,
        verdict=verdict,
    )


def _as_judged(pose_graph: PoseGraph, odometry: Bool[np.ndarray, " e"], factor: float) -> PoseGraph:
    """The map without priors, odometry's standard deviations multiplied."""
    information = np.array(pose_graph.information)
    information[odometry] /= factor**2
    return dataclasses.replace(pose_graph.without_priors(), information=information)


def _judged(trials: Trials, found: list[Trial], question: Question) -> tuple[Trial, Verdict]:
    """The trial that counts, and whether its closures are believed."""
    if question.by_chance:
        level = SIGNIFICANCE if question.significance is None else question.significance
        trial, verdict = _by_chance(trials, found, level, question.seed or 0)
    else:
        asked = question.minimum_inliers
        minimum = PAIR if isinstance(asked, str) else asked
        trial, verdict = found[0], _by_number(trials, found[0], minimum)
    if not verdict.believed and question.own_loop:
        why = verdict.why + trials.contradicting(trial)
        verdict = dataclasses.replace(verdict, why=why)
    return trial, verdict


def given(**options: Any) -> dict[str, Any]:
    """The options that are not None."""
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


def check_numbers(
    odometry_scale: float | None = None,
    significance: float | None = None,
    separation: float | None = None,
) -> None:
    """Raises `InputError` for a scale that is not above 0, a level outside (0, 1), a length < 0."""
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
