"""Step ii, the squared distances of all pairs: time, and the closed form against the definition.

Times are those of the compiled kernel on a problem that is at hand, per ordered pair. The
definition (vmap and jacfwd over the same pairs) is timed on fewer closures, since its time per pair
does not depend on their number.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jaxlie
import numpy as np

from benchmarks.suite.harness import Case, Measured, Metric, Settings
from benchmarks.suite.measure import Call, alone, in_words, race, seconds_of
from benchmarks.suite.random_worlds import moved, random_closures, random_map
from pcm_jax import (
    ConsistencyProblem,
    PoseGraph,
    consistency_problem,
    lie,
    optimize,
    squared_mahalanobis,
)
from pcm_jax.simulation import simulate_city

GROUPS = {"SE2": jaxlie.SE2, "SE3": jaxlie.SE3}
MANY, FEW = 1_000, 192
PAPER = 115
FAR = 1e5  # metres
RANK = 60  # of the random joint covariances


def many_in_space(settings: Settings) -> dict[str, Measured]:
    """SE(3), 1,000 closures between as many poses of either map."""
    closed, jacfwd = _kernel("closed-form", MANY), _kernel("jacfwd", FEW)
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


def _chained_problem(count: int) -> ConsistencyProblem:
    """Closures between two chains of `count` poses, each touched once, in space.

    The joint covariances are random ones of low rank: the kernel's time does not depend on them,
    and finding those of 6,000 coordinates would take longer than all the rest.
    """
    generator = np.random.default_rng(count)
    maps = []
    for _ in range(2):
        tangents: Any = generator.normal(size=(count, 6))
        poses = lie.exp(jaxlie.SE3, tangents)
        maps.append(PoseGraph.from_trajectory(poses, sigma_translation=0.1, sigma_rotation=0.01))
    closures = random_closures(generator, maps, count, once=True)
    roots = generator.normal(scale=0.01, size=(2, 6 * count, RANK))
    marginals = roots[0] @ roots[0].T, roots[1] @ roots[1].T
    return consistency_problem(maps[0], maps[1], closures, marginals=marginals)


def _kernel(name: str, count: int) -> Call:
    return _compiled(name, _chained_problem(count))


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
            Metric("pair", "µs", figure=0.4),
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
