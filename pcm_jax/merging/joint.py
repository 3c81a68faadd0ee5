"""The maps of a group as one pose graph, and its solution.

Robot r's poses in the group's frame are `P = T_r X`. In terms of P the residual of a closure,
`Log( z⁻¹ (T_a X_i)⁻¹ (T_b Y_k) )` (Kim et al. 2010), joins two poses like any edge, and the edges
inside a map do not see T_r at all. So the anchors are no unknowns: the merged graph is solved by
the optimiser of single maps, with the group's first pose held, and `T_r = P_r0 X_r0⁻¹` afterwards.
Where maps of the group have priors, these are the gauge instead, and no pose is held.
"""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from pcm_jax import lie
from pcm_jax.errors import ConvergenceWarning
from pcm_jax.graph import MultiRobotGraph, PoseGraph, Priors
from pcm_jax.graph.spanning_tree import connected_parts
from pcm_jax.graph.unsaid import held
from pcm_jax.mapping import Solution, optimize
from pcm_jax.mapping.optimization import optimize_from, problem_of

PATIENCE = 15
"""Evaluations of each attempt by Gauss-Newton: consistent closures need fewer than ten."""
ON_THE_WAY, AT_LAST = 8, 30
"""Evaluations of each solve of the incremental rebuild: of those that lead on, of the last."""


def joint_graph(
    graph: MultiRobotGraph, members: Sequence[int], closures: Int[np.ndarray, " k"], anchors: Any
) -> PoseGraph:
    """One pose graph of several robots, in the frame of the first.

    Args:
        graph: optimised maps and all closures.
        members: robots, which `closures` connect.
        closures: indices of the closures to use.
        anchors: Lie `[robots]`, where each map is put to start with.

    Returns:
        The robots' poses one robot after the other; their edges, then the closures (what these
        leave unsaid held as they measure it, see `graph.unsaid.held`); the priors of
        all of them, as they are: in the frame of the whole.
    """
    maps = [graph.maps[robot] for robot in members]
    sizes = [one.num_poses for one in maps]
    offset = np.zeros(len(graph.maps), np.int64)
    offset[list(members)] = np.cumsum([0, *sizes[:-1]])
    used = graph.closures[closures]
    ends_a = offset[np.asarray(used.robot_a)] + np.asarray(used.pose_a)
    ends_b = offset[np.asarray(used.robot_b)] + np.asarray(used.pose_b)
    poses = [
        lie.compose(lie.take(anchors, np.full(size, robot)), lie.as_numpy(one.poses))
        for robot, one, size in zip(members, maps, sizes, strict=True)
    ]
    placed = [(one, offset[robot]) for robot, one in zip(members, maps, strict=True)]
    edges = [one.measurement for one in maps] + [used.measurement]
    priors = [
        one.priors.shifted(int(start))
        for one, start in placed
        if one.priors is not None and len(one.priors)
    ]
    return PoseGraph.from_checked(
        poses=lie.concatenate(poses),
        tail=np.concatenate([*(np.asarray(m.tail) + start for m, start in placed), ends_a]),
        head=np.concatenate([*(np.asarray(m.head) + start for m, start in placed), ends_b]),
        measurement=lie.concatenate([lie.as_numpy(edge) for edge in edges]),
        information=np.concatenate(
            [*(m.information for m in maps), held(np.asarray(used.information))]
        ),
        ids=np.arange(sum(sizes)),
        name=" + ".join(one.name for one in maps),
        source=np.concatenate([m.source for m in [*maps, used]]),
        priors=Priors.concatenate(priors) if priors else None,
    )


def cut_apart(
    graph: MultiRobotGraph, members: Sequence[int], poses: Any
) -> Iterator[tuple[int, Any]]:
    """Cuts the poses of a joint graph apart: each robot and its own, one robot after the other."""
    first = 0
    for robot in members:
        rows = slice(first, first + graph.maps[robot].num_poses)
        yield robot, lie.take(poses, rows)
        first = rows.stop


def solve_joint(
    roomy: PoseGraph, used: Bool[np.ndarray, " k"], *, method: str, engine: str
) -> Solution:
    """Solves a merged graph from its own poses, and harder if that does not converge.

    In turn, until one converges: the given method from the maps as they are aligned; from the
    chordal relaxation of the whole; and the incremental rebuild of the paper's section VI. The
    first has all closures in its pattern, those not used at no weight, so that solves by other
    closures of the same graph share its plan.

    Args:
        roomy: from `joint_graph`.
        used: which of its last edges, the closures, are to hold.
        method: "gauss-newton" or "levenberg-marquardt".
        engine: "blocks" or "cholmod".

    Returns:
        The solution; its graph has the closures used and no other.
    """
    own = np.ones(roomy.num_edges - len(used), bool)
    kept = np.concatenate([own, used])
    joint = roomy if used.all() else roomy.with_edges(kept)
    options = {"solver": method, "engine": engine, "max_steps": PATIENCE}
    attempts = [_solve_in(roomy, kept, joint, options)]
    if not attempts[-1].converged:
        attempts.append(optimize_from("chordal", joint, **options))
    if attempts[-1].converged:
        return attempts[-1]
    solution = rebuild(joint, int(used.sum()), engine=engine)
    if solution.converged:
        return solution
    warnings.warn(
        f"merged map {joint.name!r}: the solve did not converge; the accepted closures contradict"
        " each other or the maps",
        ConvergenceWarning,
        stacklevel=2,
    )
    return min([*attempts, solution], key=lambda s: s.cost if math.isfinite(s.cost) else math.inf)


def _solve_in(
    roomy: PoseGraph, kept: Bool[np.ndarray, " e"], joint: PoseGraph, options: dict[str, Any]
) -> Solution:
    """Solves `joint`, the kept edges of `roomy`, from its own poses by the plan of all edges."""
    if kept.all():
        return optimize(joint, initial="given", **options)
    solved = problem_of(roomy).solve(roomy.poses, scale=kept.astype(float), **options)
    graph = joint.with_poses(solved.poses)
    numbers = solved.cost, solved.initial_cost, solved.iterations, solved.converged
    return Solution(graph, *numbers, start="given")


def rebuild(joint: PoseGraph, closures: int, *, engine: str = "blocks") -> Solution:
    """Adds the closures a few at a time and re-optimises after each addition.

    The number of closures doubles from step to step, so that m closures take log2(m) solves by
    Levenberg-Marquardt, each from the one before.

    Args:
        joint: a merged graph whose maps are aligned by one of its closures.
        closures: how many of its last edges are closures.
        engine: "blocks" or "cholmod".
    """
    own = np.arange(joint.num_edges - closures)
    order, used = _closure_order(joint, closures)
    solution = Solution(joint, math.inf, math.inf, 0, False)
    iterations = 0
    while True:
        edges = np.concatenate([own, np.sort(order[:used])])
        kept = joint.with_edges(edges).with_poses(solution.graph.poses)
        steps = AT_LAST if used == closures else ON_THE_WAY
        solution = optimize(
            kept, initial="given", solver="levenberg-marquardt", engine=engine, max_steps=steps
        )
        iterations += solution.iterations
        if used == closures:
            break
        used = min(closures, 2 * used)
    final = joint.with_poses(solution.graph.poses)
    return dataclasses.replace(solution, graph=final, iterations=iterations)


def _closure_order(joint: PoseGraph, closures: int) -> tuple[np.ndarray, int]:
    """The closures' edge indices, first those of a tree of robots; and how many these are."""
    own = joint.num_edges - closures
    tail, head = np.asarray(joint.tail), np.asarray(joint.head)
    _, robot = connected_parts(tail[:own], head[:own], joint.num_poses)
    tree, others = [], []
    for edge in range(own, joint.num_edges):
        a, b = robot[tail[edge]], robot[head[edge]]
        (others if a == b else tree).append(edge)
        robot[robot == b] = a
    return np.array(tree + others, np.int64), len(tree)


def gone_on(were: Any, own: Any) -> Any:
    """Poses of a map in another frame, and those behind them where the map has them from the last.

    Args:
        were: Lie `[k]`, the first poses in the other frame.
        own: Lie `[n]`, all of the map's own; of fewer than k so many are given back.
    """
    were, own = lie.as_numpy(were), lie.as_numpy(own)
    count, now = len(lie.parameters(were)), len(lie.parameters(own))
    if now <= count:
        return lie.take(were, np.arange(now))
    step = lie.compose(lie.take(were, count - 1), lie.inverse(lie.take(own, count - 1)))
    return lie.concatenate([were, lie.compose(step, lie.take(own, np.arange(count, now)))])
