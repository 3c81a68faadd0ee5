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
from pcm_jax.mapping.least_squares import MAX_STEPS, PoseProblem, check_names

INITIAL = ("chordal", "spanning-tree", "given")


@dataclasses.dataclass(frozen=True)
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


@on_host
def optimize(
    pose_graph: PoseGraph,
    *,
    initial: str = "chordal",
    method: str = "gauss-newton",
    engine: str = "blocks",
    max_steps: int = MAX_STEPS,
) -> Solution:
    """Finds the poses of least cost 0.5 Σ rᵀΩr, r = Log(z⁻¹ X_i⁻¹ X_j), the first pose held.

    Args:
        pose_graph: a connected map.
        initial: where to start: "chordal" (relaxed rotations), "spanning-tree" (measurements
            along shortest paths) or "given" (the graph's own poses).
        method: "gauss-newton", or "levenberg-marquardt" where the start is poor.
        engine: "blocks" (NumPy and LAPACK), or "cholmod" (the `cholmod` extra).
        max_steps: evaluations of the cost after which to give up.

    Returns:
        The solution; its graph is float64 whatever the caller's `jax_enable_x64`.

    Raises:
        InputError: for an unknown name, or an engine that is not installed.
    """
    check_names(method, engine)
    arrays = host_arrays(pose_graph)
    first = np.arange(pose_graph.num_poses) == 0
    start = _initial_poses(pose_graph, arrays, initial)
    if pose_graph.num_edges == 0:
        return Solution(pose_graph, 0.0, 0.0, 0, True)
    problem = PoseProblem(*arrays, first)
    solved = problem.solve(start, method=method, engine=engine, max_steps=max_steps)
    graph = pose_graph.with_poses(solved.poses)
    return Solution(graph, solved.cost, solved.initial_cost, solved.iterations, solved.converged)


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
