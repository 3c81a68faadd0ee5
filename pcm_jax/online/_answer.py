"""The answer for what is held: the last step of `select`, with all that is known from before."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from pcm_jax.consistency import Evidence
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.integrity import AS_ASKED, Doubts
from pcm_jax.online._state import State
from pcm_jax.online._steady import Change, changes
from pcm_jax.pipeline.select import CHANCE, OF_WEIGHING, decide
from pcm_jax.pipeline.stages import StopWatch, silent
from pcm_jax.pipeline.weigh import MEMORY_LIMIT
from pcm_jax.selection import Selection
from pcm_jax.selection.choose import needs_distances
from pcm_jax.selection.weights import check_weights

EXACT = "pcm-exact"
OF_ALL = ("method", "confidence", "minimum_inliers", "separation", "progress")
OF_CHANCE = ("significance", "on_ambiguous", "prefer", "seed")


def answer(
    state: State,
    graph: MultiRobotGraph,
    options: Mapping[str, Any],
    names: tuple[str, float, float],
    metric: str,
    seconds: dict[str, float],
    hysteresis: float = 0.0,
) -> Selection:
    """The selection that `select` makes of a graph, from a state that holds it.

    Args:
        state: every pair of robots weighed in the maps as they are.
        graph: the maps as given, and all closures.
        options: of `select`, checked.
        names: the method's name, the confidence and γ².
        metric: its name.
        seconds: by stage, what was spent before.
        hysteresis: see `_steady`.

    Warns:
        InputWarning: as `select`.
    """
    method, watch = options.get("method", EXACT), StopWatch()
    check_weights(method, graph)
    known = {*OF_ALL, *OF_CHANCE, *OF_WEIGHING}
    own = {name: value for name, value in options.items() if name not in known}
    with watch("clique"):
        choices = [pair.choice(method, own, hysteresis) for pair in state.pairs.values()]
    evidence = Evidence(
        graph,
        tuple(covariance.pose_graph for covariance in state.covariances),
        state.covariances,
        tuple(pair.evidence() for pair in state.pairs.values()),
        metric,
        seconds,
    )
    given = (*OF_CHANCE, "separation")
    by: dict[str, Any] = {name: options[name] for name in given if options.get(name) is not None}
    by["doubts"] = Doubts(*(_remembered(state, question) for question in AS_ASKED))
    minimum = options.get("minimum_inliers", CHANCE)
    tell = options.get("progress") or silent
    selection = decide(evidence, choices, names, minimum, watch, tell, **by)
    return dataclasses.replace(selection, waiting=len(state.waiting))


def memory_limit(options: Mapping[str, Any]) -> float:
    """Bytes for distances: any number of them where the method needs them, as for `select`."""
    by = {name: options[name] for name in ("tie_break",) if name in options}
    needed = needs_distances(options.get("method", EXACT), by)
    return np.inf if needed else options.get("memory_limit", MEMORY_LIMIT)


def remember(state: State, selection: Selection, step: int) -> list[Change]:
    """Marks what an answer believes, and lists what entered it and what left.

    Args:
        state: that the answer was given for.
        selection: the answer.
        step: how many changes were taken before.
    """
    found, graph = [], selection.evidence.graph
    for held, pair in zip(state.pairs.values(), selection.pairs, strict=True):
        if not np.array_equal(held.believed, pair.accepted):
            changed = changes(held.believed, pair.accepted, held.agree(), pair.verdict.why)
            for row, event, why in changed:
                one = held.measured
                a = graph.maps[held.robots[0]].pose_name(int(one.pose_a[row]))
                b = graph.maps[held.robots[1]].pose_name(int(one.pose_b[row]))
                found.append(Change(step, int(held.closures[row]), a, b, event, why))
            held.believed = pair.accepted
    return found


def _remembered(state: State, question: Callable[..., Any]) -> Callable[..., Any]:
    """The same question, asked once of each set for as long as its pair does not change."""

    def asked(evidence: Any, gate: float, places: Any, members: Any, **how: Any) -> Any:
        known = state.pairs[evidence.robot_a, evidence.robot_b].known
        key = question, places.separation, members.tobytes(), *sorted(how.items())
        if key not in known:
            known[key] = question(evidence, gate, places, members, **how)
        return known[key]

    return asked
