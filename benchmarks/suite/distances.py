"""Step ii, the squared distances of all pairs: time, and the closed form against the definition.

Times are those of the compiled kernel on a problem at hand, per ordered pair, and those of all the
way from given joint covariances of the touched poses. The definition (vmap and jacfwd over the same
pairs) is timed on fewer closures, since its time per pair does not depend on their number.
"""

from __future__ import annotations

import functools
import time
from typing import Any

import jax
import jaxlie
import numpy as np

from benchmarks.suite.harness import Case, Measured, Metric, Settings
from benchmarks.suite.measure import (
    Call,
    Patience,
    alone,
    in_words,
    peak_memory,
    race,
    seconds_of,
    timing_of,
)
from benchmarks.suite.random_worlds import (
    between_chains,
    moved,
    random_closures,
    random_map,
)
from pcm_jax import (
    ConsistencyProblem,
    PoseGraph,
    consistency_problem,
    optimize,
    squared_mahalanobis,
)
from pcm_jax.simulation import simulate_city, simulate_sessions

GROUPS = {"SE2": jaxlie.SE2, "SE3": jaxlie.SE3}
MANY, MOST, FEW = 1_000, 3_000, 192
PAPER = 115
FAR = 1e5  # metres
HALF_SPEED = (
    "0.063 on the machine of the former table, where the same kernel ran twice as fast; both cores"
    " would have to be busy"
)
GATHERING = (
    "the host checks the given covariances and forms G of every pair of poses by NumPy, two 6 x 6 "
    "products each, at the speed of memory it has not touched before; the weighing itself takes a "
    "twentieth. Products by panels on one BLAS thread and rows gathered a panel at a time took a "
    "third off; one compiled program over tiles gains nothing: of its 0.3 s a map 0.08 are reading "
    "(6 k)² numbers across their rows, 0.1 products, 0.1 writing 21 planes of k² twice. G formed "
    "inside the kernel's tiles would save the writing, and leave twice what is asked"
)
IN_TURN = (
    "tiles of pairs follow each other, so that what one reads stays in a cache, and only within a "
    "tile do threads share the work"
)


def many_in_space(settings: Settings) -> dict[str, Measured]:
    """SE(3), 1,000 closures between as many poses of either map."""
    closed = _compiled("closed-form", consistency_problem(**between_chains(MANY)))
    jacfwd = _compiled("jacfwd", consistency_problem(**between_chains(FEW)))
    first, first_jacfwd = seconds_of(closed), seconds_of(jacfwd)
    times = race({"closed": lambda: closed, "jacfwd": lambda: jacfwd}, settings.patience)
    ours, theirs = times["closed"].median, times["jacfwd"].median
    return {
        "pair": Measured(1e6 * ours / MANY**2, alone(times["closed"])),
        "compilation": Measured(first - ours, "first call without its run"),
        "speedup_over_jacfwd": Measured(
            (theirs / FEW**2) / (ours / MANY**2),
            f"jacfwd, m = {FEW}: {1e6 * theirs / FEW**2:.3g} µs a pair,"
            f" {in_words(first_jacfwd - theirs)} to compile",
        ),
    }


def from_marginals(count: int, settings: Settings) -> dict[str, Measured]:
    """SE(3): all the way from two joint covariances, and the kernel on the result."""
    before = peak_memory()
    chains = between_chains(count)
    inputs = sum(joint.nbytes for joint in chains["marginals"]) / 1e6

    problems = []

    def gather() -> None:
        problems[:] = [consistency_problem(**chains)]

    patience = Patience(1, 1.0, most_seconds=10.0)
    gathering = timing_of(gather, patience)
    kernel = _compiled("closed-form", problems[0])
    kernel()
    peak = peak_memory() - before
    busy, start = time.process_time(), time.perf_counter()
    weighing = timing_of(kernel, patience)
    cores = (time.process_time() - busy) / (time.perf_counter() - start)
    memory = f"{peak:.0f} MB with the {inputs:.0f} MB of both joint covariances"
    whole = f"{alone(gathering)}, to gather; {in_words(weighing.median)} to weigh"
    return {
        "pair": Measured(1e6 * weighing.median / count**2, alone(weighing)),
        "cores": Measured(cores, "kept busy by the kernel: processor time over wall-clock time"),
        "pair_from_marginals": Measured(
            1e6 * (gathering.median + weighing.median) / count**2, whole
        ),
        "peak_over_inputs": Measured(peak / inputs, memory),
    }


def in_float32(group: str, settings: Settings) -> dict[str, Measured]:
    """Costs of float32 in digits, and gains in time, in a simulated world."""
    simulated = {"SE2": simulate_city, "SE3": simulate_sessions}[group]().graph
    closures, _ = simulated.closures.between(0, 1)
    map_a, map_b = (optimize(one).graph for one in simulated.maps)
    double = consistency_problem(map_a, map_b, closures)
    single = double.astype(np.float32)
    exact, found = (np.asarray(squared_mahalanobis(each), float) for each in (double, single))
    problems = {"float64": double, "float32": single}
    kernels = {name: _compiled("closed-form", each) for name, each in problems.items()}
    for kernel in kernels.values():
        kernel()
    times = race(
        {name: lambda call=call: call for name, call in kernels.items()}, settings.patience
    )
    error = np.abs(found - exact) / np.maximum(exact, closures.tangent_dim)
    return {
        "error": Measured(float(error.max()), "largest change, relative to q² or to d"),
        "over_float64": Measured(
            times["float32"].median / times["float64"].median, alone(times["float32"])
        ),
    }


def paper_in_plane(settings: Settings) -> dict[str, Measured]:
    """SE(2), 115 closures as in the paper, in simulated maps of 1,000 poses."""
    graph = simulate_city().graph
    map_a, map_b = (optimize(one).graph for one in graph.maps)
    closures, _ = graph.closures.between(0, 1)

    def from_maps() -> Any:
        return np.asarray(squared_mahalanobis(consistency_problem(map_a, map_b, closures)))

    kernel = _compiled("closed-form", consistency_problem(map_a, map_b, closures))
    first = seconds_of(kernel)
    from_maps()
    times = race({"kernel": lambda: kernel, "whole": lambda: from_maps}, settings.patience)
    kernel_alone, whole = times["kernel"], times["whole"]
    return {
        "kernel": Measured(1e3 * kernel_alone.median, alone(kernel_alone)),
        "compilation": Measured(first - kernel_alone.median, "first call without its run"),
        "from_maps": Measured(
            1e3 * whole.median, "joint marginals included; the paper's Q took 70.8 s"
        ),
    }


def agreement(group: str, settings: Settings) -> dict[str, Measured]:
    """The largest relative difference of the closed form from the definition."""
    generator = np.random.default_rng(7)
    maps = [optimize(random_map(GROUPS[group], generator)).graph for _ in range(2)]
    closures = random_closures(generator, maps, 60)
    far = [moved(graph, generator, FAR) for graph in maps]
    note = f"{len(closures)} closures, both directions, of which some share a pose"
    return {
        "at_origin": Measured(_largest_difference(maps, closures), note),
        "far_away": Measured(_largest_difference(far, closures), f"maps {FAR:g} m away"),
    }


def _compiled(kernel: str, problem: ConsistencyProblem) -> Call:
    """A call that runs the kernel alone, to be compiled by its first call."""
    compiled = jax.jit(functools.partial(squared_mahalanobis, kernel=kernel))
    return lambda: jax.block_until_ready(compiled(problem))


def _largest_difference(maps: list[PoseGraph], closures: Any) -> float:
    problem = consistency_problem(maps[0], maps[1], closures)
    closed = np.asarray(squared_mahalanobis(problem))
    definition = np.asarray(squared_mahalanobis(problem, kernel="jacfwd"))
    pairs = ~np.eye(len(closed), dtype=bool)
    return float(np.abs(closed[pairs] / definition[pairs] - 1.0).max())


CASES = [
    Case(
        f"distances/SE3-{MANY}",
        (
            Metric("pair", "µs", figure=0.05, reason=HALF_SPEED),
            Metric("compilation", "s"),
            Metric("speedup_over_jacfwd", "×", "higher", figure=50.0),
        ),
        many_in_space,
    ),
    Case(
        f"distances/SE2-{PAPER}",
        (
            Metric("kernel", "ms", figure=10.0),
            Metric("compilation", "s"),
            Metric("from_maps", "ms"),
        ),
        paper_in_plane,
    ),
    *(
        Case(
            f"distances/SE3-{count}-from-marginals",
            (
                Metric("pair", "µs", figure=0.05, reason=HALF_SPEED),
                Metric("cores", "", "higher", figure=1.7, reason=IN_TURN),
                Metric("pair_from_marginals", "µs", figure=0.3, reason=GATHERING),
                Metric("peak_over_inputs", "×", figure=3.0, tolerance=0.2),
            ),
            functools.partial(from_marginals, count),
            slow=count == MOST,
        )
        for count in (MANY, MOST)
    ),
    *(
        Case(
            f"distances/float32-{group}",
            (
                Metric("error", "relative", figure=1e-3, tolerance=None, digits=2),
                Metric("over_float64", "×"),
            ),
            functools.partial(in_float32, group),
        )
        for group in GROUPS
    ),
    *(
        Case(
            f"distances/closed-form-{group}",
            (
                Metric("at_origin", "relative", figure=1e-10, tolerance=None, digits=2),
                Metric("far_away", "relative", figure=1e-10, tolerance=None, digits=2),
            ),
            functools.partial(agreement, group),
        )
        for group in GROUPS
    ),
]
