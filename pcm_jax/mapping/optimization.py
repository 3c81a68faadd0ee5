"""`optimize`: one robot's map at its own maximum-likelihood estimate (the paper's step i)."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.errors import InputError
from pcm_jax.graph import PoseGraph
from pcm_jax.graph.spanning_tree import spanning_tree_poses
from pcm_jax.mapping.initialization import chordal_poses
from pcm_jax.mapping.least_squares import MAX_STEPS, SOLVERS, PoseProblem, check_names

INITIAL = ("chordal", "spanning-tree", "given")


@dataclasses.dataclass(frozen=True, repr=False)
class Solution:
    """An optimised pose graph.

    Attributes:
        graph: the graph at the optimum; ids and name as given.
        cost: 0.5 Σ rᵀΩr with r = Log(z⁻¹ X_i⁻¹ X_j).
        initial_cost: the same at the start.
        iterations: steps taken.
        converged: whether a tolerance was met; False also where the steps diverged.
    """

    graph: PoseGraph
    cost: float
    initial_cost: float
    iterations: int
    converged: bool

    def __repr__(self) -> str:
        how = "converged" if self.converged else "did not converge"
        return (
            f"Solution of {self.graph!r}\n"
            f"  cost {self.cost:.6g}, from {self.initial_cost:.6g}\n"
            f"  {how} after {self.iterations} steps"
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

    Args:
        pose_graph: a connected map.
        initial: where to start: "chordal" (relaxed rotations), "spanning-tree" (measurements
            along shortest paths) or "given" (the graph's own poses).
        solver: "gauss-newton" (the default), or "levenberg-marquardt" where the start is poor.
        engine: "blocks" (NumPy and LAPACK), or "cholmod" (the `cholmod` extra).
        max_steps: evaluations of the cost after which to give up.
        method: the former name of `solver`.

    Returns:
        The solution; its graph is float64 whatever the caller's `jax_enable_x64`.

    Raises:
        InputError: for an unknown name, an engine that is not installed, or `solver` and `method`
            both given.

        solution = pcm_jax.optimize(graph.maps[0])
        solution.converged, solution.cost
    """
    solver = _solver(solver, method)
    check_names(solver, engine)
    arrays = host_arrays(pose_graph)
    first = np.arange(pose_graph.num_poses) == 0
    start = _initial_poses(pose_graph, arrays, initial)
    if pose_graph.num_edges == 0:
        return Solution(pose_graph, 0.0, 0.0, 0, True)
    problem = PoseProblem(*arrays, first)
    solved = problem.solve(start, solver=solver, engine=engine, max_steps=max_steps)
    graph = pose_graph.with_poses(solved.poses)
    return Solution(graph, solved.cost, solved.initial_cost, solved.iterations, solved.converged)


def _solver(solver: str | None, method: str | None) -> str:
    if solver is not None and method is not None:
        raise InputError(
            f"method: {method!r} given, expected none beside solver {solver!r}: it is the former"
            " name of the same"
        )
    return solver or method or SOLVERS[0]


def host_arrays(graph: PoseGraph) -> tuple[Any, Any, Any, Any]:
    """Tail, head, measurement and information of a graph's edges, in NumPy."""
    ends = np.asarray(graph.tail), np.asarray(graph.head)
    return *ends, lie.as_numpy(graph.measurement), np.asarray(graph.information)


def _initial_poses(graph: PoseGraph, arrays: Any, initial: str) -> Any:
    poses = lie.as_numpy(graph.poses)
    if initial == "given" or graph.num_poses == 1:
        return poses
    root = lie.take(poses, 0)
    tail, head, measurement, _ = arrays
    if initial == "spanning-tree":
        n = graph.num_poses
        return spanning_tree_poses(tail, head, measurement, n, root_pose=root, prefer="shortest")
    if initial == "chordal":
        return chordal_poses(*arrays, first_pose=root, size=graph.num_poses)
    raise InputError(f"initial: {initial!r} given, expected one of {', '.join(INITIAL)}")
