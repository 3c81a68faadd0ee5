"""Step i, the maps: optimised costs, Gauss-Newton against GTSAM, the plan, one whole call, SuperLU.

Gauss-Newton is raced on identical graphs from identical poses, our chordal ones, with the same
stopping rule. Neither side's ordering is counted: GTSAM's is found when its optimiser is made, ours
is cached by content; `plan` says what it costs the first time, and `one_shot` races whole calls,
start and ordering included, on a pattern never seen before.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from benchmarks.suite import gtsam_peer, maps
from benchmarks.suite.harness import Case, Measured, Metric, NotMeasuredError, Settings
from benchmarks.suite.measure import (
    Patience,
    Timing,
    against,
    geometric_mean,
    in_words,
    race,
    seconds_of,
    timing_of,
)
from pcm_jax import InputError, PoseGraph, lie, optimize
from pcm_jax.mapping._linearization import edge_products, linearize
from pcm_jax.mapping.initialization import chordal_poses
from pcm_jax.mapping.least_squares import padded_edges
from pcm_jax.mapping.optimization import host_arrays
from pcm_jax.sparse.assembly import plan_for
from pcm_jax.sparse.system import System, system_for

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

ENGINES = ("blocks", "cholmod")
ONE_THREAD = (
    "factorising is two thirds of the solve (of cubicle's 0.65 s, 0.44), front after front on one "
    "thread as GTSAM does it; independent fronts on two would change it"
)
OVER_GTSAM = {"each": 1.0, "blocks": 0.6, "cholmod": 0.45}
"""Times GTSAM's: the default engine on every graph, both in the geometric mean."""
FIRST = 2.5
"""Seconds of the first `optimize` in a process, and what a warm one takes."""
ATLAS = (
    "in space CHOLMOD's dense part decides, by the BLAS in sparsax's wheel, an ATLAS of 3 to 5"
    " Gflop/s; our ordering, or repeated entries summed beforehand, make no difference"
)
PLAN_SECONDS = {"city10000": 0.3, "torus3D": 0.5}


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
    start = at_chordal_poses(graph)
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
    return found | _raced(start, (factors, values), settings.patience)


def _raced(start: PoseGraph, peer: tuple[Any, Any], patience: Patience) -> dict[str, Measured]:
    """Both engines against GTSAM, from the graph's own poses."""
    contestants, reasons = _engines(start)
    contestants["gtsam"] = lambda: gtsam_peer.gauss_newton(*peer).optimize
    times = race(contestants, patience)
    missing = {engine: Measured(None, reason) for engine, reason in reasons.items()}
    ratios = {
        engine: _ratio(times[engine], times["gtsam"]) for engine in ENGINES if engine in times
    }
    return {f"{engine}_over_gtsam": each for engine, each in (missing | ratios).items()}


def all_graphs(settings: Settings) -> dict[str, Measured]:
    """The race of `solve` on every public graph in one process, and the geometric means."""
    ratios: dict[str, dict[str, Measured]] = {}
    for name in maps.FILES:
        start = at_chordal_poses(maps.read_map(name, settings))
        peer = gtsam_peer.factors_and_values(start, "solve")
        ratios[name] = _raced(start, peer, settings.patience)
    return {
        f"{engine}_over_gtsam": mean_of(
            {name: each[f"{engine}_over_gtsam"] for name, each in ratios.items()}
        )
        for engine in ENGINES
    }


def mean_of(ratios: dict[str, Measured]) -> Measured:
    """The geometric mean, and what it is the mean of; none where one is missing."""
    known = {name: each.value for name, each in ratios.items() if each.value is not None}
    if len(known) < len(ratios):
        return next(each for each in ratios.values() if each.value is None)
    note = ", ".join(f"{name} {ratio:.2f}" for name, ratio in known.items())
    return Measured(geometric_mean(list(known.values())), note)


def one_shot(name: str, settings: Settings) -> dict[str, Measured]:
    """`optimize` as a user calls it, kernels compiled: start, plan and solve, against GTSAM's."""
    graph = maps.read_map(name, settings)
    cost = optimize(graph).cost
    shifts = iter(range(1, graph.num_edges))
    found: dict[str, float] = {}

    def ready() -> Callable[[], Any]:
        fresh = _shifted(graph, next(shifts))
        return lambda: found.update(ours=optimize(fresh).cost)

    try:
        factors, _ = gtsam_peer.factors_and_values(graph, "solve")
    except NotMeasuredError as reason:
        alone = in_words(seconds_of(ready()))
        return {"over_gtsam": Measured(None, f"{alone}; {reason}")}
    theirs = factors.error(gtsam_peer.lago_and_gauss_newton(factors))
    peer = functools.partial(gtsam_peer.lago_and_gauss_newton, factors)
    times = race({"ours": ready, "gtsam": lambda: peer}, settings.patience)
    if max(abs(theirs / cost - 1.0), abs(found["ours"] / cost - 1.0)) > 1e-6:
        raise RuntimeError(f"{name}: {found['ours']} by us, {theirs} by GTSAM, {cost} before")
    return {"over_gtsam": _ratio(times["ours"], times["gtsam"])}


def _shifted(graph: PoseGraph, by: int) -> PoseGraph:
    """The same graph, whose edges begin elsewhere: a pattern of new content."""
    order = np.roll(np.arange(graph.num_edges), by)
    return dataclasses.replace(
        graph,
        tail=graph.tail[order],
        head=graph.head[order],
        measurement=lie.take(graph.measurement, order),
        information=graph.information[order],
    )


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
    """The cost at which Levenberg-Marquardt of GTSAM stops from the file's own poses."""
    factors, values = gtsam_peer.factors_and_values(maps.read_map(name, settings), "solve")
    peer = gtsam_peer.levenberg_marquardt(factors, values)
    cost = factors.error(peer.optimize())
    note = f"{peer.iterations()} iterations from a cost of {factors.error(values):.4g}"
    return {"cost": Measured(cost, note)}


def splu(name: str, settings: Settings) -> dict[str, Measured]:
    """A step's linear system by our factorisation and by SciPy's SuperLU, both with their solve.

    SuperLU finds its ordering anew in every call, ours is cached by content: a step of an optimiser
    would pay for both as they are. Neither side's assembly is counted.
    """
    from scipy.sparse.linalg import splu

    start = at_chordal_poses(maps.read_map(name, settings))
    matrix, right = _information(start), _right_hand_side(start)
    system, products = _system_and_products(start)
    options: dict[str, Any] = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0}
    options["options"] = {"SymmetricMode": True}
    free = right[start.tangent_dim :]
    found = system.factorize(products).solve(right)[start.tangent_dim :]
    difference = np.abs(found - splu(matrix, **options).solve(free)).max() / np.abs(found).max()
    if difference > 1e-6:
        raise RuntimeError(f"{name}: the two solutions differ by {difference}")
    contestants = {
        "ours": lambda: lambda: system.factorize(products).solve(right),
        "splu": lambda: lambda: splu(matrix, **options).solve(free),
    }
    times = race(contestants, settings.patience)
    return {"blocks_over_splu": _ratio(times["ours"], times["splu"])}


def _system_and_products(graph: PoseGraph) -> tuple[System, np.ndarray]:
    """The normal equations of a map, the first pose held, and their numbers at its poses."""
    edges = padded_edges(*host_arrays(graph), size=graph.num_edges)
    residual, by_tail, by_head = linearize(lie.as_numpy(graph.poses), edges)
    first = np.arange(graph.num_poses) == 0
    ends = np.asarray(graph.tail), np.asarray(graph.head)
    system = system_for(graph.num_poses, *ends, first, graph.tangent_dim)
    return system, np.asarray(edge_products(by_tail, by_head, residual).products)


def _information(graph: PoseGraph) -> Any:
    """H without the first pose, as SciPy's sparse matrix."""
    from scipy.sparse import coo_array

    system, (by_tail, by_head, across) = _system_and_products(graph)
    d, tail, head = graph.tangent_dim, system.tail, system.head
    row, column = np.concatenate([tail, head, head, tail]), np.concatenate([tail, head, tail, head])
    block = np.concatenate([by_tail, by_head, across, across.swapaxes(1, 2)])
    free, scalar = (row > 0) & (column > 0), np.arange(d)
    rows = (row[free, None] - 1) * d + scalar
    columns = (column[free, None] - 1) * d + scalar
    rows, columns = np.broadcast_arrays(rows[:, :, None], columns[:, None, :])
    size = (graph.num_poses - 1) * d
    entries = block[free].ravel(), (rows.ravel(), columns.ravel())
    return coo_array(entries, shape=(size, size)).tocsc()


def _right_hand_side(graph: PoseGraph) -> np.ndarray:
    right = np.random.default_rng(0).normal(size=graph.num_poses * graph.tangent_dim)
    right[: graph.tangent_dim] = 0.0
    return right


def at_chordal_poses(graph: PoseGraph) -> PoseGraph:
    """The graph at the poses that solves start from."""
    first = lie.take(lie.as_numpy(graph.poses), 0)
    poses = chordal_poses(*host_arrays(graph), first_pose=first, size=graph.num_poses)
    return graph.with_poses(lie.as_device(poses))


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
    """Calls for patterns of new content and one structure: their edges begin elsewhere."""
    for shift in range(1, count + 1):
        yield functools.partial(plan_for, size, np.roll(tail, shift), np.roll(head, shift), d)


def _solve_case(name: str) -> Case:
    cost = COSTS.get(name)
    band = None if cost is None else (cost * (1 - 1e-6), cost * (1 + 1e-6))
    metrics = (
        Metric("cost", "", "target", band, tolerance=1e-6, digits=8),
        Metric("cost_difference", "relative", figure=1e-6, tolerance=None, digits=2),
        Metric("first_call", "s", figure=FIRST),
        Metric("blocks_over_gtsam", "×", figure=OVER_GTSAM["each"], reason=ONE_THREAD),
        Metric("cholmod_over_gtsam", "×"),
    )
    case = Case(f"optimization/{name}", metrics, functools.partial(solve, name))
    return case._replace(applies=maps.stand_ins_needed) if name in maps.SIMULATED else case


CASES = [
    *map(_solve_case, (*maps.FILES, *maps.SIMULATED)),
    Case(
        "optimization/all-graphs",
        (
            Metric("blocks_over_gtsam", "×", figure=OVER_GTSAM["blocks"], reason=ONE_THREAD),
            Metric("cholmod_over_gtsam", "×", figure=OVER_GTSAM["cholmod"], reason=ATLAS),
        ),
        all_graphs,
    ),
    *(
        Case(
            f"optimization/plan-{name}",
            (Metric("first_call", "s", figure=seconds),),
            functools.partial(plan, name),
        )
        for name, seconds in PLAN_SECONDS.items()
    ),
    *(
        Case(
            f"optimization/splu-{name}",
            (Metric("blocks_over_splu", "×"),),
            functools.partial(splu, name),
        )
        for name in maps.FILES
    ),
    Case(
        "optimization/one-shot-city10000",
        (Metric("over_gtsam", "×", figure=1.0),),
        functools.partial(one_shot, "city10000"),
    ),
    Case(
        "optimization/gtsam-lm-torus3D",
        (Metric("cost", "", "target", tolerance=0.1, digits=6),),
        functools.partial(stop_of_gtsam, "torus3D"),
        slow=True,
    ),
]
