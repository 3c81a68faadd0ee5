"""A sweep of merges: two large maps, joined by one set of closures after another.

The sets are what selecting from many versions of the paper's City10000 experiment gives where all
goes well: 15 true closures a version, and 10 of them from a second method. Every merge has room for
all of them (`room_for=`), so that one symbolic plan serves the sweep. The time of a merge is the
mean over the sweep, that plan included; compilation is not.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import numpy as np
from jaxtyping import Int

from benchmarks.suite import maps
from benchmarks.suite.harness import Case, Measured, Metric, Settings
from benchmarks.suite.measure import in_words, seconds_of
from pcm_jax import InputError, MultiRobotGraph, merge, optimize, split
from pcm_jax.sparse import assembly

SECONDS = {"blocks": 0.1, "cholmod": 0.1}
"""Of each merge on 10,000 poses, by engine."""
VERSIONS, TRUE, FEWER = 20, 15, 10
REASON = (
    "three or four steps, each a factorisation of the whole: four fifths of the time; the plan is"
    " made once"
)


def merges(name: str, settings: Settings) -> dict[str, Measured]:
    """Merges of the halves of a map by many sets of its closures, with either engine."""
    whole = maps.read_map(name, settings)
    graph = split(whole, [whole.num_poses // 2])
    graph = MultiRobotGraph(tuple(optimize(one).graph for one in graph.maps), graph.closures)
    sets = _sets(len(graph.closures))
    found = {}
    for engine in SECONDS:
        try:
            found |= _sweep(graph, sets, engine)
        except InputError as reason:
            found |= dict.fromkeys((engine, f"{engine}_plans"), Measured(None, str(reason)))
    return found


def _sets(closures: int) -> list[Int[np.ndarray, " k"]]:
    generator = np.random.default_rng(0)
    drawn = [generator.choice(closures, TRUE, replace=False) for _ in range(VERSIONS)]
    return [each for true in drawn for each in (true, true[:FEWER])]


def _sweep(graph: MultiRobotGraph, sets: list[Any], engine: str) -> dict[str, Measured]:
    def merged(accepted: Any, room: Any) -> Callable[[], Any]:
        options = {"optimized": True, "engine": engine, "room_for": room}
        return lambda: merge(graph, accepted=accepted, **options)

    by_its_own = [seconds_of(merged(each, None)) for each in sets[:6]]  # compiles, too
    room = np.unique(np.concatenate(sets))
    with patch.object(assembly, "front_tree", wraps=assembly.front_tree) as planner:
        before = _analyses(engine)
        seconds = [seconds_of(merged(each, room)) for each in sets]
        plans = planner.call_count + _analyses(engine) - before
    note = (
        f"{len(sets)} merges by {len(room)} closures; median {in_words(float(np.median(seconds)))},"
        f" first {in_words(seconds[0])}; with a plan each"
        f" {in_words(float(np.median(by_its_own[1:])))}"
    )
    return {engine: Measured(float(np.mean(seconds)), note), f"{engine}_plans": Measured(plans)}


def _analyses(engine: str) -> int:
    """Counts the symbolic analyses that CHOLMOD has made."""
    if engine != "cholmod":
        return 0
    import sparsax  # pyright: ignore[reportMissingImports]

    return sparsax.cache_size()


CASES = [
    Case(
        "sweeps/merges-city10000",
        [
            metric
            for engine, seconds in SECONDS.items()
            for metric in (
                Metric(engine, "s each", figure=seconds, reason=REASON),
                Metric(f"{engine}_plans", "plans", figure=1.0, tolerance=0.0),
            )
        ],
        functools.partial(merges, "city10000"),
    )
]
