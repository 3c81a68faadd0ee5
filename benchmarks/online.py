"""Time and memory of the online form: closures one by one, maps that grow, answers after each.

    python -m benchmarks.online --out DIR

Two simulated sessions in space, 5,000 poses each; 300 right closures among 3,000, in random order,
each handed to `IncrementalPcm.add` by itself (after one has compiled what there is to compile).
At the end the answer is held against `select` of the same graph. Then the maps grow: one pose of
odometry at a time; a loop inside one map, against a whole `optimize` of it; and the maps are merged
anew after a closure, against a whole `merge` of the graph. In a process of its own; beside wall
clock stand the process's own seconds, which a busy machine stretches less.

Writes summary.json, table.md and run.json.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from benchmarks.experiments.command import command_parser, finish, run_tasks
from benchmarks.experiments.record import LIBRARY
from benchmarks.suite.measure import peak_memory
from pcm_jax import (
    IncrementalPcm,
    LoopClosures,
    MultiRobotGraph,
    PoseGraph,
    lie,
    merge,
    optimize,
    select,
)
from pcm_jax.compiling import ALWAYS
from pcm_jax.simulation import simulate_sessions
from pcm_jax.store import Store, digest

LOOPS = 6
"""Loops that close one after another, of which the first is not counted."""
WARMING = 50
"""Closures that compile what there is to compile: most of a few are told apart without."""
COLUMNS = {
    "value": "figure",
    "own": "of the process",
    "promised": "promised",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command."""
    parser = command_parser("online", __doc__)
    parser.add_argument("--closures", type=int, default=3000, metavar="M")
    parser.add_argument("--right", type=int, default=300, metavar="N")
    parser.add_argument("--poses", type=int, default=5000, metavar="N", help="of each map")
    options = parser.parse_args(arguments)
    start = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    size = options.closures, options.right, options.poses
    steps = Store(options.out / "steps", digest(size, options.seeds, files=LIBRARY))
    tasks = {str(seed): partial(_apart, *size, seed) for seed in options.seeds}
    found = run_tasks("worlds", tasks, steps)
    rows = {f"{name}, seed {seed}": row for seed, one in found.items() for name, row in one.items()}
    return finish(options, start, found, rows, COLUMNS)


def _apart(*task: int) -> dict[str, Any]:
    """`measured` in a process of its own, whose peak of memory is its own, too."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(measured, task)


def measured(count: int, right: int, poses: int, seed: int) -> dict[str, Any]:
    """All figures of one world, by name."""
    before, os.environ[ALWAYS] = os.environ.get(ALWAYS), "always"
    try:
        graph = _world(count, right, poses, seed)
        online = IncrementalPcm(_warmed(graph))
        rows = dict(_of_additions(online, graph))
        rows |= _of_answer(online)
        rows |= _of_growth(online)
    finally:
        os.environ.pop(ALWAYS)
        os.environ |= {} if before is None else {ALWAYS: before}
    return rows


def _world(count: int, right: int, poses: int, seed: int) -> MultiRobotGraph:
    """Right closures and three kinds of false ones, in random order."""
    aliased = (count - right) // 14
    groups = {"aliased_groups": aliased // 10, "aliased_size": 10}
    false = count - right - 10 * groups["aliased_groups"]
    made = simulate_sessions(
        seed=seed, poses=poses, sessions=2, inliers=right, random=false, **groups
    )
    order = np.random.default_rng(seed).permutation(len(made.graph.closures))
    return dataclasses.replace(made.graph, closures=made.graph.closures[order])


def _warmed(graph: MultiRobotGraph) -> MultiRobotGraph:
    """The maps alone, after their first closures have compiled what there is to compile."""
    alone = dataclasses.replace(graph, closures=LoopClosures.empty(graph.group))
    first = IncrementalPcm(alone)
    for row in range(WARMING):
        first.add(graph.closures[[row]])
    return alone


def _of_additions(
    online: IncrementalPcm, graph: MultiRobotGraph
) -> Iterator[tuple[str, dict[str, Any]]]:
    memory = peak_memory()
    times = np.array(
        [_timed(partial(online.add, graph.closures[[row]])) for row in range(len(graph.closures))]
    )
    wall, own = 1e3 * times.T
    yield "addition, mean, ms", _row(wall.mean(), own.mean(), 5.0)
    high = np.quantile([wall, own], 0.99, axis=1)
    yield "addition, 99th percentile, ms", _row(high[0], high[1], 50.0)
    yield "addition, longest, ms", _row(wall.max(), own.max(), None)
    yield "memory that additions took, MB", _row(peak_memory() - memory, None, None)


def _of_answer(online: IncrementalPcm) -> dict[str, dict[str, Any]]:
    wall, own = _timed(online.result)
    found = online.result().accepted
    batch_wall, batch_own = _timed(lambda: select(online.graph))
    same = bool((select(online.graph).accepted == found).all())
    return {
        "answer, s": _row(wall, own, None),
        "batch answer, s": _row(batch_wall, batch_own, None),
        "closures accepted": _row(int(found.sum()), None, None),
        "answers that are equal": _row(int(same), None, 1),
    }


def _of_growth(online: IncrementalPcm) -> dict[str, dict[str, Any]]:
    """Odometry, a loop, and a merge, against whole ones."""
    one = online.graph.maps[0]
    step = {
        "measurement": lie.take(lie.as_numpy(one.measurement), np.array([0])),
        "information": np.asarray(one.information)[:1],
    }
    odometry = [_timed(partial(online.extend, 0, **step)) for _ in range(50)]
    best, drawn = optimize(one).graph, np.random.default_rng(0)
    # Each time another loop, so that patterns are as new to the whole optimisation; the first one
    # compiles.
    looped, whole = [], []
    for k in range(LOOPS):
        looped.append(_timed(partial(online.extend, 0, **_loop(best, 2 * k, drawn))))
        other = _with_edges(one, **_loop(best, 2 * k + 1, drawn))
        whole.append(_timed(partial(optimize, other)))
    online.result()
    again = _timed(online.merge)
    anew = _timed(partial(merge, online.graph))
    cost = online.merge().solution.cost / merge(online.graph).solution.cost - 1.0
    wall, own = 1e3 * np.median(odometry, axis=0)
    return {
        "a pose of odometry, median, ms": _row(wall, own, 1.0),
        "a loop, in whole optimisations": _ratio(_middle(looped[1:]), _middle(whole[1:])),
        "merged anew, in whole merges": _ratio(again, anew),
        "its cost, relative difference": _row(abs(cost), None, 1e-6),
    }


def _loop(one: PoseGraph, pose: int, drawn: np.random.Generator) -> dict[str, Any]:
    """A loop from the end of a map to a pose, as its poses have it but for an error as stated."""
    start, end = (lie.take(lie.as_numpy(one.poses), np.array([k])) for k in (-1, pose))
    information = np.asarray(one.information)[:1]
    root = np.linalg.cholesky(np.linalg.inv(information))
    error: Any = (root @ drawn.standard_normal((one.tangent_dim, 1)))[..., 0]
    return {
        "tail": [one.num_poses - 1],
        "head": [pose],
        "measurement": lie.compose(lie.between(start, end), lie.exp(one.group, error)),
        "information": information,
    }


def _with_edges(
    one: PoseGraph, *, tail: Any, head: Any, measurement: Any, information: Any
) -> PoseGraph:
    return dataclasses.replace(
        one,
        tail=np.append(one.tail, tail),
        head=np.append(one.head, head),
        measurement=lie.concatenate([lie.as_numpy(one.measurement), measurement]),
        information=np.concatenate([np.asarray(one.information), information]),
        source=np.append(one.source, ""),
    )


def _ratio(part: tuple[float, float], whole: tuple[float, float]) -> dict[str, Any]:
    return _row(part[0] / whole[0], part[1] / whole[1], 0.5)


def _middle(times: Sequence[tuple[float, float]]) -> tuple[float, float]:
    wall, own = np.median(np.array(times), axis=0)
    return float(wall), float(own)


def _timed(step: Callable[[], Any]) -> tuple[float, float]:
    """Seconds by the wall clock, and of this process."""
    wall, own = time.perf_counter(), time.process_time()
    step()
    return time.perf_counter() - wall, time.process_time() - own


def _row(value: Any, own: Any, promised: Any) -> dict[str, Any]:
    given = {"value": value, "own": own, "promised": promised}
    return {name: number for name, number in given.items() if number is not None}


if __name__ == "__main__":
    raise SystemExit(main())
