"""`select`: from a graph or its evidence to the closures to believe; steps i to iii."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from pcm_jax.arrays import on_host
from pcm_jax.consistency import Evidence, PairEvidence, chi2_gate
from pcm_jax.errors import InputError, check_number
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.integrity import (
    AS_ASKED,
    Doubts,
    Verdict,
    alignments_of,
    judge_by_chance,
    judge_by_number,
    judge_team,
)
from pcm_jax.pipeline.stages import Progress, StopWatch, silent
from pcm_jax.pipeline.weigh import MEMORY_LIMIT, checked_limit, weigh
from pcm_jax.selection import Choice, PairSelection, Selection, choose
from pcm_jax.selection.choose import Method, check_method, name_of, needs_distances
from pcm_jax.selection.weights import check_weights, weights_for

CHANCE = "chance"
ON_AMBIGUOUS = ("split", "largest")
PREFER = ("places", "closures")
OF_WEIGHING = ("metric", "optimized", "memory_limit")
"""Options of `weigh`, which evidence has behind it."""


@on_host
def select(
    graph: MultiRobotGraph | Evidence,
    *,
    method: Method = "pcm-exact",
    confidence: float = 0.99,
    minimum_inliers: int | str = CHANCE,
    significance: float | None = None,
    separation: float | None = None,
    on_ambiguous: str | None = None,
    prefer: str | None = None,
    seed: int | None = None,
    time_limit: float | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> Selection:
    """Selects the closures to believe, for every pair of robots by itself.

    Each map is optimised on its own; the joint covariance of the poses that a pair's closures
    touch, and from it the squared distances of all pairs of closures, go to the method.

        selection = pcm_jax.select(graph)
        selection.accepted                      # bool [m]
        selection.pairs[0].verdict.why          # in a sentence
        pcm_jax.select(selection.evidence, confidence=0.9)  # asks again, at no cost

    Where the closures of a robot pair differ in weight (`LoopClosures.weight`), the PCM methods
    keep the heaviest consistent set instead of the largest; equal weights change nothing. A
    closure of weight 0 is never kept by them.

    Args:
        graph: the robots' maps and the closures between them, or what `weigh` found of them.
        method: a name, see `select_from`, or a function `(evidence, gate) -> bool [k]` of one
            pair's `PairEvidence`.
        confidence: probability that the loop of two right closures passes the gate.
        minimum_inliers: "chance": a pair of robots accepts what was found if closures of which none
            is right would hardly agree as well, see `integrity.chance`. Or a number: if that many
            closures were found, which closures that are all wrong manage too where they are many.
        significance: with "chance", the probability that any pair of robots is accepted none of
            whose closures is right; 0.01 by default.
        separation: metres along the way of either robot between closures that are two witnesses,
            see `integrity.places`; by default as there.
        on_ambiguous: with "chance": "split", the default: a pair of robots accepts nothing where
            another alignment is supported about as well, see `integrity.rivals`; "largest": it
            accepts the larger set, whose verdict says so.
        prefer: of two such sets with "largest": "places", the default: the one at more places, and
            of as many the one of more closures; "closures": the one of more closures (the paper's
            rule, and the only one for a number of closures).
        seed: of the shuffles that "chance" makes, 0 by default; the same seed gives the same
            answer.
        time_limit: seconds for each pair's clique; needs a method that has the option.
        progress: called with a stage, how many of its parts are done, and how many there are.
        **options: the method's own, see `select_from`; of a graph also `metric`, `optimized` and
            `memory_limit` of `weigh`. Methods that need the distances (all but PCM's; so does
            `tie_break="distance"`) get them whatever memory they take.

    Returns:
        The selection; float64 whatever the caller's settings.

    Raises:
        InputError: for an unknown method or option, a confidence or significance outside (0, 1), a
            negative minimum, limit or separation, a weight that is negative or not finite, and what
            optimising the maps raises.

    Warns:
        InputWarning: where weights differ and the method is a named one that cannot go by them.
            (A function has them in its evidence: `measured.weight`.)
    """
    weighing = {name: options.pop(name) for name in OF_WEIGHING if name in options}
    if time_limit is not None:
        options["time_limit"] = time_limit
    check_method(method, options)
    if "weights" in options:
        raise InputError("weights: not an option of select, expected them in the closures' weight")
    of_chance = {
        "significance": significance,
        "on_ambiguous": on_ambiguous,
        "prefer": prefer,
        "seed": seed,
    }
    asked = {name: value for name, value in of_chance.items() if value is not None}
    check_minimum(minimum_inliers, asked)
    check_graph(graph)
    if seed is not None:
        check_number("seed", seed, least=0, integer=True)
    check_number("confidence", confidence)
    if significance is not None:
        check_number("significance", significance)
    for name, given in (("separation", separation), ("time_limit", time_limit)):
        if given is not None:
            check_number(name, given)
    gate = float(chi2_gate(confidence, graph.tangent_dim))
    evidence = weighed(graph, weighing, needs_distances(method, options), progress)
    check_weights(method, evidence.graph)
    watch, tell = StopWatch(), progress or silent
    choices = []
    for number, pair in enumerate(evidence.pairs):
        tell("clique", number, len(evidence.pairs))
        if pair.is_streamed:
            with watch("consistency"):
                pair.packed(gate)
        with watch("clique"):
            weights = weights_for(method, pair)
            choices.append(choose(pair, gate, method=method, **options, **weights))
    tell("clique", len(choices), len(choices))
    names = name_of(method), confidence, gate
    by = {"separation": separation, **asked}
    return decide(evidence, choices, names, minimum_inliers, watch, tell, **by)


def decide(
    evidence: Evidence,
    choices: Sequence[Choice],
    names: tuple[str, float, float],
    minimum_inliers: int | str,
    watch: StopWatch,
    tell: Progress = silent,
    *,
    separation: float | None = None,
    doubts: Doubts = AS_ASKED,
    prefer: str = PREFER[0],
    **of_chance: Any,
) -> Selection:
    """Judges what a method chose, all pairs of robots together: the last step of `select`.

    Args:
        evidence: of the graph.
        choices: one for each of its pairs.
        names: the method's name, the confidence and γ².
        minimum_inliers: as for `select`.
        watch: to which "chance" is added, and whose seconds are told.
        tell: of progress.
        separation: as for `select`.
        doubts: where chance levels and rivals come from.
        prefer: as for `select`.
        **of_chance: `significance`, `on_ambiguous` and `seed`, where given.
    """
    gate = names[2]
    found = [(pair, choice.members) for pair, choice in zip(evidence.pairs, choices, strict=True)]
    tell("chance", 0, 1)
    with watch("chance"):
        if minimum_inliers == CHANCE:
            by: dict[str, Any] = {"separation": separation, "doubts": doubts, **of_chance}
            verdicts = judge_by_chance(found, gate, **by)
            if prefer == PREFER[0] and any(map(_has_better_rival, verdicts)):
                choices = [*map(_by_places, evidence.pairs, choices, verdicts)]
                found = [*zip(evidence.pairs, (choice.members for choice in choices), strict=True)]
                verdicts = judge_by_chance(found, gate, **by)
            alignments = alignments_of(found, verdicts)
            verdicts, team = judge_team(found, verdicts, alignments=alignments)
        else:
            minimum, team, alignments = int(minimum_inliers), (), {}
            verdicts = [judge_by_number(*each, minimum, gate, separation) for each in found]
    tell("chance", 1, 1)
    accepted, pairs = np.zeros(len(evidence.graph.closures), bool), []
    for pair, choice, verdict in zip(evidence.pairs, choices, verdicts, strict=True):
        joint = alignments.get((pair.robot_a, pair.robot_b))
        pairs.append(PairSelection.of_choice(pair, gate, choice, verdict, joint))
        accepted[pair.closures] = pairs[-1].accepted
    seconds = {stage: evidence.seconds[stage] + spent for stage, spent in watch.seconds.items()}
    return Selection(accepted, tuple(pairs), *names, evidence, seconds, team)


def _has_better_rival(verdict: Verdict) -> bool:
    """True where a set is believed beside one as good that is at more places."""
    rival = verdict.rival if verdict.believed and verdict.ambiguous else None
    return rival is not None and rival.places > verdict.places


def _by_places(evidence: PairEvidence, choice: Choice, verdict: Verdict) -> Choice:
    """The rival in a set's place where it is at more places; nothing proves it the largest."""
    if verdict.rival is None or not _has_better_rival(verdict):
        return choice
    members: Any = verdict.rival.members
    optimal = None if choice.optimal is None else False
    weights: Any = None if evidence.measured is None else evidence.measured.weight
    weight = None if choice.weight is None else float(weights[members].sum())
    return dataclasses.replace(choice, members=members, optimal=optimal, weight=weight)


def check_minimum(minimum: Any, of_chance: dict[str, Any]) -> None:
    """Raises `InputError` for what is neither "chance" nor a number, or for options without use.

    Args:
        minimum: `minimum_inliers`.
        of_chance: the options given that "chance" alone can use.
    """
    if isinstance(minimum, str):
        if minimum != CHANCE:
            raise InputError(
                f"minimum_inliers: {minimum!r}, expected {CHANCE!r} or a number of closures"
            )
        on_ambiguous = of_chance.get("on_ambiguous", ON_AMBIGUOUS[0])
        if not isinstance(on_ambiguous, str) or on_ambiguous not in ON_AMBIGUOUS:
            raise InputError(
                f"on_ambiguous: {on_ambiguous!r}, expected one of {', '.join(ON_AMBIGUOUS)}"
            )
        _check_preference(of_chance.get("prefer", PREFER[0]), PREFER)
        return
    check_number("minimum_inliers", minimum)
    if minimum < 0:
        raise InputError(f"minimum_inliers: {minimum}, expected at least 0")
    _check_preference(of_chance.pop("prefer", PREFER[1]), PREFER[1:])
    for name, value in of_chance.items():
        raise InputError(
            f"{name}: {value} given with minimum_inliers {minimum}, expected {CHANCE!r} for that"
        )


def _check_preference(prefer: Any, known: Sequence[str]) -> None:
    if not isinstance(prefer, str) or prefer not in known:
        of = "" if len(known) > 1 else f" with a number of closures, or minimum_inliers {CHANCE!r}"
        raise InputError(f"prefer: {prefer!r}, expected {' or '.join(map(repr, known))}{of}")


def check_graph(graph: Any) -> None:
    """Raises `InputError` unless this is a graph or evidence."""
    if not isinstance(graph, MultiRobotGraph | Evidence):
        raise InputError(
            f"graph: {type(graph).__name__} given, expected a MultiRobotGraph or Evidence"
        )


def weighed(
    graph: MultiRobotGraph | Evidence,
    options: dict[str, Any],
    with_distances: bool = False,
    progress: Progress | None = None,
) -> Evidence:
    """The evidence of a graph; evidence as it is.

    Args:
        graph: a graph, or evidence.
        options: of `weigh`.
        with_distances: whether distances are needed whatever memory they take.
        progress: see `weigh`.

    Raises:
        InputError: for options of weighing together with evidence.
    """
    if isinstance(graph, Evidence):
        for name in options:
            raise InputError(
                f"{name}: given with evidence, expected with a graph; weigh(graph, {name}=…) has it"
            )
        return graph
    limit = checked_limit(options.pop("memory_limit", MEMORY_LIMIT))
    limit = np.inf if with_distances else limit
    return weigh(graph, memory_limit=limit, progress=progress, **options)
