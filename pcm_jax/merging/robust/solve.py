"""Robust merging: every closure stays in the graph, with as much information as it deserves.

The robots that candidate closures connect are solved as one graph. In turn, until neither changes:

    1. χ² = rᵀΩr of every closure at the present poses;
    2. a kernel of `robust_weights` turns χ² into factors w of the closures' information;
    3. the graph with information wΩ is relinearised and solved: one step where the weights change
       smoothly (DCS, switchable constraints), a few where they follow a schedule (graduated
       non-convexity), to the end where they switch (max-mixture).

Only numbers change from turn to turn: one sparsity pattern, one compilation. A closure is accepted
if in the end w ≥ 1/4, that is s = √w ≥ 1/2. Unlike the methods that select beforehand, all of these
need an initial guess of where the maps lie, and find the optimum next to it. Priors of the maps
are taken to be in one frame: where a graph has any, maps start where they are.

For DCS and switchable constraints the damping decides what becomes of a bad guess. Where every χ²
is huge, all scales are nearly zero and the cost is flat: damped steps stay where they are and
accept nothing, and `converged` means no more than that. Undamped ones (`solver="gauss-newton"`)
take no notice of how flat it is and follow the nearest closures to the end, be it a single one.
"""

from __future__ import annotations

import dataclasses
import math
import warnings
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.errors import ConvergenceWarning, InputError
from pcm_jax.graph import MultiRobotGraph, PoseGraph
from pcm_jax.mapping.optimization import host_arrays, problem_of
from pcm_jax.mapping.priors import priors_of
from pcm_jax.merging.alignment import aligned_anchors
from pcm_jax.merging.groups import robot_groups
from pcm_jax.merging.joint import cut_apart, joint_graph
from pcm_jax.merging.robust.methods import (
    ACCEPTED_SCALE,
    ROBUST_METHODS,
    Reweighting,
    check_robust_options,
)

INITIAL = ("identity", "closures")
MOST_TURNS = 100
SCALE_TOLERANCE = 1e-4
COST_TOLERANCE = 1e-5
"""Relative change of the weighted cost in a turn, up to which it is called settled."""
LEAST_SCALE = 1e-6
"""Instead of zero, so that robots which all closures are rejected between stay in one system."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class RobustSolution:
    """The end of a robust method.

    Attributes:
        maps: the robots' maps where the solve left them: robots that candidate closures connect
            in one frame, that of the first, whether a closure between them was accepted or not.
        scale: `[m]` s = √w, where wΩ is the information that the closure was given
            (never less than 1e-12 Ω).
        squared: `[m]` χ² = rᵀΩr at these poses, Ω as measured.
        cost: 0.5 Σ rᵀΩr of the maps' edges plus 0.5 Σ wχ² of the closures.
        initial_cost: the same at the start, with the first weights.
        iterations: how often weights were taken anew and the poses solved for.
        converged: whether, in the last turn, no scale changed by more than 1e-4 and the weighted
            cost by no more than 1e-5 of itself; in graduated non-convexity also whether all
            weights are 0 or 1.
    """

    maps: tuple[PoseGraph, ...]
    scale: Float[np.ndarray, " m"]
    squared: Float[np.ndarray, " m"]
    cost: float
    initial_cost: float
    iterations: int
    converged: bool

    def __repr__(self) -> str:
        end = "settled" if self.converged else "not settled"
        return (
            f"RobustSolution({int(self.accepted.sum())} of {len(self.scale)} closures accepted)\n"
            f"  scales  {self.scale.min(initial=1.0):.3g} to {self.scale.max(initial=0.0):.3g}\n"
            f"  cost    {self.cost:.6g}, {end} after {self.iterations} turns"
        )

    @property
    def accepted(self) -> Bool[np.ndarray, " m"]:
        """The closures with s ≥ 1/2."""
        return self.scale >= ACCEPTED_SCALE


def solve_robustly(
    graph: MultiRobotGraph,
    *,
    method: str,
    gate: float,
    solver: str = "levenberg-marquardt",
    engine: str = "blocks",
    initial: str = "identity",
    anchors: Any = None,
    **options: Any,
) -> RobustSolution:
    """Solves for all maps at once, down-weighting the closures that do not fit.

    Args:
        graph: optimised maps and all closures.
        method: "dcs", "gnc", "switchable" or "max-mixture".
        gate: γ², for the methods that have a gate.
        solver: "levenberg-marquardt" or "gauss-newton", for the steps.
        engine: "blocks" or "cholmod".
        initial: where the maps start: "identity" (all first poses coincide) or "closures" (each
            pair as the medoid of its closures has it).
        anchors: Lie `[robots]`, to start there instead: `T_r` of `P = T_r X`, as in
            `MergeResult.anchors`.
        **options: the method's own.

    Raises:
        InputError: for an unknown start or option, or a number out of range.
    """
    check_robust_options(method, options)
    reweighting = ROBUST_METHODS[method](gate, graph.tangent_dim, **options)
    every = np.ones(len(graph.closures), bool)
    groups = robot_groups(len(graph.maps), graph.closures, every)
    start = _start(graph, groups, initial, anchors)
    parts = [
        _solve_group(graph, members, start, reweighting, solver, engine)
        for members in groups
        if len(members) > 1
    ]
    maps, scale, squared = list(graph.maps), np.ones(len(every)), np.zeros(len(every))
    for members, used, turn in parts:
        scale[used], squared[used] = turn.scale, turn.squared
        for robot, poses in cut_apart(graph, members, turn.poses):
            maps[robot] = maps[robot].with_poses(poses)
    turns = [turn for _, _, turn in parts]
    return RobustSolution(
        maps=tuple(maps),
        scale=scale,
        squared=squared,
        cost=sum(turn.cost for turn in turns),
        initial_cost=sum(turn.initial_cost for turn in turns),
        iterations=sum(turn.iterations for turn in turns),
        converged=all(turn.converged for turn in turns),
    )


class Turns(NamedTuple):
    """The end of `reweighted`.

    Attributes:
        poses: Lie `[n]`, NumPy.
        scale: `[k]` s = √w of the edges in doubt.
        squared: `[k]` their χ² at these poses, with all their information.
        cost, initial_cost: 0.5 Σ rᵀΩr with the last weights, and at the start with the first.
        iterations: how often weights were taken anew and the poses solved for.
        converged: whether both have settled.
    """

    poses: Any
    scale: np.ndarray
    squared: np.ndarray
    cost: float
    initial_cost: float
    iterations: int
    converged: bool


def _solve_group(
    graph: MultiRobotGraph,
    members: tuple[int, ...],
    start: Any,
    reweighting: Reweighting,
    solver: str,
    engine: str,
) -> tuple[tuple[int, ...], np.ndarray, Turns]:
    used = np.flatnonzero(np.isin(np.asarray(graph.closures.robot_a), members))
    joint = joint_graph(graph, members, used, start)
    closures = np.arange(joint.num_edges - len(used), joint.num_edges)
    turns = reweighted(joint, closures, reweighting, solver=solver, engine=engine)
    if not turns.converged:
        warnings.warn(
            f"merged map {joint.name!r}: the weights of the closures did not settle in "
            f"{turns.iterations} turns",
            ConvergenceWarning,
            stacklevel=2,
        )
    return members, used, turns


def reweighted(
    joint: PoseGraph,
    doubted: Int[np.ndarray, " k"],
    reweighting: Reweighting,
    *,
    solver: str,
    engine: str,
) -> Turns:
    """Takes weights and solves in turn, from the graph's own poses, until both have settled.

    Args:
        joint: a merged graph.
        doubted: its edges that are weighted, at least one; all others are known to be right.
        reweighting: the method.
        solver, engine: see `optimize`.
    """
    tail, head, measurement, information = host_arrays(joint)
    problem = problem_of(joint)
    measured = tail[doubted], head[doubted], lie.take(measurement, doubted), information[doubted]
    poses, state, scale = lie.as_numpy(joint.poses), None, np.full(len(doubted), np.inf)
    squared, of_edges = squared_residuals(poses, *measured), np.ones(joint.num_edges)
    initial_cost = cost = math.nan
    settled = False
    for turn in range(MOST_TURNS + 1):
        weights, state = reweighting.update(squared, state)
        change, scale = np.abs(np.sqrt(weights) - scale).max(), np.sqrt(weights)
        decided = not reweighting.binary or bool(np.isin(weights, (0.0, 1.0)).all())
        if settled and decided and change <= SCALE_TOLERANCE:
            return Turns(poses, scale, squared, cost, initial_cost, turn, True)
        of_edges[doubted] = np.maximum(scale, LEAST_SCALE)
        solved = problem.solve(
            poses,
            scale=of_edges,
            solver=solver,
            engine=engine,
            max_steps=reweighting.evaluations,
        )
        if turn == 0:
            initial_cost = cost = solved.initial_cost
        if not math.isfinite(solved.cost):
            break
        cost = solved.cost
        settled = abs(solved.initial_cost - cost) <= COST_TOLERANCE * solved.initial_cost
        poses, squared = solved.poses, squared_residuals(solved.poses, *measured)
    return Turns(poses, scale, squared, cost, initial_cost, turn, False)


def squared_residuals(
    poses: Any,
    tail: Int[np.ndarray, " m"],
    head: Int[np.ndarray, " m"],
    measurement: Any,
    information: Float[np.ndarray, "m d d"],
) -> Float[np.ndarray, " m"]:
    """χ² = rᵀΩr, r = Log(z⁻¹ X_i⁻¹ X_j), of edges given in NumPy."""
    found = lie.between(lie.take(poses, tail), lie.take(poses, head))
    residual = np.asarray(lie.log(lie.between(measurement, found)))
    return np.einsum("ei,eij,ej->e", residual, information, residual)


def _start(
    graph: MultiRobotGraph, groups: tuple[tuple[int, ...], ...], initial: str, anchors: Any
) -> Any:
    """Anchors `[robots]`, NumPy."""
    if initial not in INITIAL:
        raise InputError(f"initial: {initial!r}, expected one of {', '.join(INITIAL)}")
    if anchors is not None:
        return _checked_anchors(graph, anchors)
    if initial == "closures":
        return aligned_anchors(graph, np.ones(len(graph.closures), bool), groups)
    if any(priors_of(one) is not None for one in graph.maps):
        return lie.identity(graph.group, (len(graph.maps),))
    first = [lie.take(lie.as_numpy(one.poses), 0) for one in graph.maps]
    leader = {robot: members[0] for members in groups for robot in members}
    coinciding = [
        lie.compose(first[leader[robot]], lie.inverse(pose)) for robot, pose in enumerate(first)
    ]
    return lie.stack(coinciding)


def _checked_anchors(graph: MultiRobotGraph, anchors: Any) -> Any:
    expected = f"{graph.group.__name__} [{len(graph.maps)}], one pose per robot"
    if not isinstance(anchors, graph.group):
        raise InputError(f"anchors: {type(anchors).__name__}, expected {expected}")
    shape = np.asarray(lie.components(anchors)[0]).shape
    if shape != (len(graph.maps),):
        raise InputError(f"anchors: shape {list(shape)}, expected {expected}")
    return lie.as_numpy(anchors)
