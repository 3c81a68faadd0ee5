"""`optimize`: one robot's map at its own maximum-likelihood estimate (the paper's step i)."""

from __future__ import annotations

import dataclasses
import functools
import math
import warnings
from typing import Any

import numpy as np

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.errors import InputError, InputWarning, check_choice, check_class
from pcm_jax.graph import PoseGraph
from pcm_jax.graph.spanning_tree import spanning_tree_poses
from pcm_jax.mapping.certificate import Certificate, certify
from pcm_jax.mapping.initialization import chordal_poses
from pcm_jax.mapping.least_squares import MAX_STEPS, SOLVERS, PoseProblem, Solved, check_names
from pcm_jax.mapping.priors import held, placed, position_only, priors_of, turned

INITIAL = ("chordal", "spanning-tree", "given")
TURNS = 4  # solves, at most, between which positions' priors are turned to the poses
TURNED = 1e-4  # radians
UNLIKELY = 1e-6
"""Probability of a cost as large, below which an optimum is doubted."""
LOWER = 1e-6
"""Share by which other poses cost less, if they do."""


@dataclasses.dataclass(frozen=True, repr=False)
class Solution:
    """An optimised pose graph.

    Attributes:
        graph: the graph at the optimum; ids and name as given.
        cost: 0.5 Σ rᵀΩr with r = Log(z⁻¹ X_i⁻¹ X_j), and of priors Log(z⁻¹ X).
        initial_cost: the same at the start.
        iterations: steps taken.
        converged: whether a tolerance was met; False also where the steps diverged.
        start: where the steps began, see `optimize`'s `initial`.
    """

    graph: PoseGraph
    cost: float
    initial_cost: float
    iterations: int
    converged: bool
    start: str = INITIAL[0]

    @functools.cached_property
    def certificate(self) -> Certificate:
        """The proof that no other poses fit better, if there is one; see `mapping.certificate`.

        Costs a few times what `optimize` does.

        Raises:
            InputError: for a map with priors.
        """
        return certify(self.graph)

    def __repr__(self) -> str:
        how = "converged" if self.converged else "did not converge"
        begun = "" if self.start == INITIAL[0] else f", from {self.start} poses"
        return (
            f"Solution of {self.graph!r}\n"
            f"  cost {self.cost:.6g}, from {self.initial_cost:.6g}\n"
            f"  {how} after {self.iterations} steps{begun}"
        )


@on_host
def optimize(
    pose_graph: PoseGraph,
    *,
    initial: str = "chordal",
    solver: str | None = None,
    engine: str = "blocks",
    max_steps: int = MAX_STEPS,
    method: str | None = None,
) -> Solution:
    """Finds the poses of least cost 0.5 Σ rᵀΩr, r = Log(z⁻¹ X_i⁻¹ X_j), the first pose held.

    A map with priors is put where they say, r = Log(z⁻¹ X): no pose is held, but for directions of
    the whole map that the priors leave free, in which the first pose stays (see `mapping.priors`).

    Args:
        pose_graph: a connected map.
        initial: where to start: "chordal" (relaxed rotations), "spanning-tree" (measurements
            along shortest paths) or "given" (the graph's own poses). Where the first ends in what
            can hardly be the optimum, the others are tried too, and the best is kept: if it did not
            converge, if the given poses cost less, or if as large a cost has a probability below
            1e-6. Other local optima it does not see: `Solution.certificate` does.
        solver: "gauss-newton" (the default), or "levenberg-marquardt" where the start is poor.
        engine: "blocks" (NumPy and LAPACK), or "cholmod" (the `cholmod` extra).
        max_steps: evaluations of the cost after which to give up.
        method: the former name of `solver`.

    Returns:
        The solution; its graph is float64 whatever the caller's `jax_enable_x64`.

    Raises:
        InputError: for an unknown name, an engine that is not installed, or `solver` and `method`
            both given.

    Warns:
        InputWarning: for priors that leave a motion of the whole map free.

        solution = pcm_jax.optimize(graph.maps[0])
        solution.converged, solution.cost
    """
    check_class("pose_graph", pose_graph, "a PoseGraph", PoseGraph)
    solver = _solver(solver, method)
    check_names(solver, engine)
    options: dict[str, Any] = {"solver": solver, "engine": engine, "max_steps": max_steps}
    alone = priors_of(pose_graph) is None and pose_graph.num_edges > 0
    options["problem"] = problem = problem_of(pose_graph) if alone else None
    found = optimize_from(initial, pose_graph, **options)
    if initial == INITIAL[0] and _is_suspicious(pose_graph, problem, found):
        others = (optimize_from(start, pose_graph, **options) for start in INITIAL[1:])
        found = min([found, *others], key=lambda one: (not one.converged, _or_infinite(one.cost)))
    return found


def optimize_from(
    initial: str, pose_graph: PoseGraph, *, problem: PoseProblem | None = None, **options: Any
) -> Solution:
    """Does the work of `optimize` from one start alone.

    Args:
        initial: as there.
        pose_graph: as there.
        problem: of the graph, `problem_of`, where that is known and it has no priors.
        **options: of `PoseProblem.solve`.
    """
    start = _initial_poses(pose_graph, host_arrays(pose_graph), initial)
    if priors_of(pose_graph) is not None:
        found = _among_priors(pose_graph, start, initial == "given", options)
    elif pose_graph.num_edges == 0:
        found = Solution(pose_graph, 0.0, 0.0, 0, True)
    else:
        solved = (problem or problem_of(pose_graph)).solve(start, **options)
        found = _solution(pose_graph, solved)
    return dataclasses.replace(found, start=initial)


def _is_suspicious(pose_graph: PoseGraph, problem: PoseProblem | None, found: Solution) -> bool:
    """True where a solution can hardly be the optimum; of priors nothing is known but the steps."""
    from scipy.special import chdtrc

    if not found.converged:
        return True
    freedom = pose_graph.tangent_dim * (pose_graph.num_edges - pose_graph.num_poses + 1)
    if freedom <= 0 or problem is None:
        return False
    if chdtrc(freedom, 2.0 * found.cost) < UNLIKELY:
        return True
    return problem.cost(pose_graph.poses) < found.cost * (1.0 - LOWER)


def _or_infinite(cost: float) -> float:
    return cost if math.isfinite(cost) else math.inf


def problem_of(pose_graph: PoseGraph) -> PoseProblem:
    """The least-squares problem of a graph: its first pose held, or its priors at its own poses."""
    priors = held(pose_graph)
    first = (np.arange(pose_graph.num_poses) == 0) & (priors is None)
    return PoseProblem(*host_arrays(pose_graph), first, priors=priors)


def _solution(graph: PoseGraph, solved: Solved) -> Solution:
    numbers = solved.cost, solved.initial_cost, solved.iterations, solved.converged
    return Solution(graph.with_poses(solved.poses), *numbers)


def _among_priors(
    pose_graph: PoseGraph, start: Any, stays: bool, options: dict[str, Any]
) -> Solution:
    """Solves a map with priors; again, while that turns poses whose positions alone are known."""
    priors: Any = pose_graph.priors
    poses = start if stays else placed(start, priors)
    _tell_free(pose_graph.with_poses(poses))
    initial_cost, iterations = None, 0
    for turn in range(1, TURNS + 1):
        here = turned(priors, poses)
        graph = dataclasses.replace(pose_graph, poses=poses, priors=here)
        found = _solution(graph, problem_of(graph).solve(poses, **options))
        initial_cost = found.initial_cost if initial_cost is None else initial_cost
        iterations += found.iterations
        again = turned(priors, found.graph.poses)
        moved = lie.log(lie.between(again.measurement, here.measurement))
        settled = np.abs(np.asarray(moved)).max() <= TURNED
        if settled or turn == TURNS or not found.converged or not position_only(priors).any():
            break
        poses = found.graph.poses
    return dataclasses.replace(found, initial_cost=initial_cost, iterations=iterations)


def _tell_free(graph: PoseGraph) -> None:
    priors, kept = priors_of(graph), held(graph)
    if priors is not None and kept is not None and len(kept) > len(priors):
        free = np.linalg.matrix_rank(kept.information[-1], hermitian=True)
        warnings.warn(
            InputWarning(
                f"map {graph.name!r}: its {len(priors)} priors leave {free} of"
                f" {graph.tangent_dim} directions of the whole map free; in these its first pose"
                " is held where the file has it"
            ),
            stacklevel=4,
        )


def _solver(solver: str | None, method: str | None) -> str:
    if solver is not None and method is not None:
        raise InputError(
            f"method: {method!r} given, expected none beside solver {solver!r}: it is the former"
            " name of the same"
        )
    return (method or SOLVERS[0]) if solver is None else solver


def host_arrays(graph: PoseGraph) -> tuple[Any, Any, Any, Any]:
    """Tail, head, measurement and information of a graph's edges, in NumPy."""
    ends = np.asarray(graph.tail), np.asarray(graph.head)
    return *ends, lie.as_numpy(graph.measurement), np.asarray(graph.information)


def _initial_poses(graph: PoseGraph, arrays: Any, initial: str) -> Any:
    check_choice("initial", initial, INITIAL)
    poses = lie.as_numpy(graph.poses)
    if initial == "given" or graph.num_poses == 1:
        return poses
    root = lie.take(poses, 0)
    tail, head, measurement, _ = arrays
    if initial == "spanning-tree":
        n = graph.num_poses
        return spanning_tree_poses(tail, head, measurement, n, root_pose=root, prefer="shortest")
    return chordal_poses(*arrays, first_pose=root, size=graph.num_poses)
