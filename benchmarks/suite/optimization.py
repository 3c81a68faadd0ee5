"""Step i, the maps: optimised costs, Gauss-Newton against GTSAM, the symbolic plan.

Gauss-Newton is raced on identical graphs from identical poses, our chordal ones, with the same
stopping rule. Neither side's ordering is counted: GTSAM's is found when its optimiser is made, ours
is cached by content; `plan` says what it costs the first time.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from benchmarks.suite import gtsam_peer, maps
from benchmarks.suite.harness import Case, Measured, Metric, NotMeasuredError, Settings
from benchmarks.suite.measure import Timing, against, in_words, race, seconds_of, timing_of
from pcm_jax import InputError, PoseGraph, lie, optimize
from pcm_jax.mapping.assembly import plan_for
from pcm_jax.mapping.initialization import chordal_poses
from pcm_jax.mapping.optimization import host_arrays

COSTS = {
    "intel": 22.502117,
    "M3500": 1774.5205,
    "kitti_00": 49.161069,
    "city10000": 255.99373,
    "parking-garage": 0.6341924,
    "sphere2500": 675.70096,
    "torus3D": 12117.637,
    "cubicle": 1372.7883,
}
"""0.5 Σ rᵀΩr at the optimum, found by GTSAM; cubicle with its information clipped."""

CHOLMOD_FIGURES = {"city10000": 1.0, "M3500": 1.0, "intel": 1.0}
ENGINES = ("blocks", "cholmod")


def solve(name: str, settings: Settings) -> dict[str, Measured]:
    """The cost of a graph, and the race from its chordal poses."""
    graph = maps.read_map(name, settings)
    first = seconds_of(lambda: optimize(graph))
    solution = optimize(graph)
    steps = f"{solution.iterations} steps from the chordal poses"
    if not solution.converged:
        steps += ", not converged"
    found = {
        "cost": Measured(solution.cost, steps),
        "first_call": Measured(first, "start, plan and compilation included"),
    }
    start = graph.with_poses(_chordal(graph))
    contestants, reasons = _engines(start)
    try:
        factors, values = gtsam_peer.factors_and_values(start, "solve")
    except NotMeasuredError as reason:
        ratios = {f"{engine}_over_gtsam": Measured(None, str(reason)) for engine in ENGINES}
        return found | ratios | {"cost_difference": Measured(None, str(reason))}
    peer = gtsam_peer.gauss_newton(factors, values)
    theirs = factors.error(peer.optimize())
    found["cost_difference"] = Measured(
        abs(solution.cost / theirs - 1.0), f"GTSAM: {theirs:.8g} in {peer.iterations()} steps"
    )
    contestants["gtsam"] = lambda: gtsam_peer.gauss_newton(factors, values).optimize
    times = race(contestants, settings.patience)
    for engine in ENGINES:
        if engine in times:
            found[f"{engine}_over_gtsam"] = _ratio(times[engine], times["gtsam"])
        else:
            found[f"{engine}_over_gtsam"] = Measured(None, reasons[engine])
    return found


def plan(name: str, settings: Settings) -> dict[str, Measured]:
    """Ordering, fronts and scatter plan of a pattern never seen before."""
    graph = maps.read_map(name, settings)
    tail, head, size = np.asarray(graph.tail), np.asarray(graph.head), graph.num_poses
    plan_for(3, np.array([0, 1]), np.array([1, 2]), 3)  # SciPy is imported here, not below
    seconds = [seconds_of(call) for call in _fresh_plans(size, tail, head, graph.tangent_dim)]
    again = timing_of(lambda: plan_for(size, tail, head, graph.tangent_dim), settings.patience)
    note = f"median of {len(seconds)}; found by content in {in_words(again.median)}"
    return {"first_call": Measured(float(np.median(seconds)), note)}


def stop_of_gtsam(name: str, settings: Settings) -> dict[str, Measured]:
    """Where Levenberg-Marquardt of GTSAM stops from the file's own poses."""
    factors, values = gtsam_peer.factors_and_values(maps.read_map(name, settings), "solve")
    peer = gtsam_peer.levenberg_marquardt(factors, values)
    cost = factors.error(peer.optimize())
    note = f"{peer.iterations()} iterations from a cost of {factors.error(values):.4g}"
    return {"cost": Measured(cost, note)}


def _chordal(graph: PoseGraph) -> Any:
    first = lie.take(lie.as_numpy(graph.poses), 0)
    arrays = host_arrays(graph)
    return lie.as_device(chordal_poses(*arrays, first_pose=first, size=graph.num_poses))


def _engines(start: PoseGraph) -> tuple[dict[str, Callable[[], Any]], dict[str, str]]:
    """Contestants by engine, compiled, and why others are missing."""
    contestants: dict[str, Callable[[], Any]] = {}
    reasons = {}
    for engine in ENGINES:
        call = functools.partial(optimize, start, initial="given", engine=engine)
        try:
            call()
        except InputError as reason:
            reasons[engine] = str(reason)
        else:
            contestants[engine] = functools.partial(_itself, call)
    return contestants, reasons


def _itself(call: Any) -> Any:
    return call


def _ratio(ours: Timing, theirs: Timing) -> Measured:
    return Measured(ours.median / theirs.median, against(ours, theirs))


def _fresh_plans(
    size: int, tail: np.ndarray, head: np.ndarray, d: int, count: int = 3
) -> Iterator[Callable[[], Any]]:
    """Calls for patterns of new content and one structure: their last edge stands there again."""
    for repeats in range(1, count + 1):
        edges = (np.append(ends, np.repeat(ends[-1], repeats)) for ends in (tail, head))
        yield functools.partial(plan_for, size, *edges, d)


def _solve_case(name: str) -> Case:
    cost = COSTS.get(name)
    band = None if cost is None else (cost * (1 - 1e-6), cost * (1 + 1e-6))
    metrics = (
        Metric("cost", "", "target", band, tolerance=1e-6, digits=8),
        Metric("cost_difference", "relative", figure=1e-6, tolerance=None, digits=2),
        Metric("first_call", "s"),
        Metric("blocks_over_gtsam", "×", figure=2.0),
        Metric("cholmod_over_gtsam", "×", figure=CHOLMOD_FIGURES.get(name)),
    )
    case = Case(f"optimization/{name}", metrics, functools.partial(solve, name))
    return case._replace(applies=maps.stand_ins_needed) if name in maps.SIMULATED else case


CASES = [
    *map(_solve_case, (*maps.FILES, *maps.SIMULATED)),
    Case(
        "optimization/plan-city10000",
        (Metric("first_call", "s", figure=1.0),),
        functools.partial(plan, "city10000"),
    ),
    Case(
        "optimization/gtsam-lm-torus3D",
        (Metric("cost", "", "target", tolerance=0.1, digits=6),),
        functools.partial(stop_of_gtsam, "torus3D"),
        slow=True,
    ),
]
