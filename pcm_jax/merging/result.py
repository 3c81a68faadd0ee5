"""`MergeResult`: the merged maps, what was believed, and a report of it."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.graph import LoopClosures, MultiRobotGraph
from pcm_jax.mapping import MapCovariance
from pcm_jax.merging.groups import closures_within
from pcm_jax.merging.joint import joint_graph
from pcm_jax.merging.robust import RobustSolution
from pcm_jax.selection import Selection

POSE_FIELDS = {3: ("x", "y", "theta"), 6: ("x", "y", "z", "qx", "qy", "qz", "qw")}


@dataclasses.dataclass(frozen=True)
class MergeSolution:
    """The fit of the merged maps to all measurements that were used.

    Attributes:
        cost: 0.5 Σ rᵀΩr over the maps' edges and the accepted closures, all groups. Of a robust
            method over all closures, with their scaled information.
        initial_cost: the same with the maps as the closures align them.
        normalized_chi2: 2 cost / (rows − columns), or None when no degree of freedom is left;
            rows are those of the maps' edges and the accepted closures.
        iterations: steps taken, all groups.
        converged: whether every group's solve met a tolerance.
    """

    cost: float
    initial_cost: float
    normalized_chi2: float | None
    iterations: int
    converged: bool


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class MergeResult:
    """Several maps merged by the closures that were accepted.

    Attributes:
        graph: the maps at their merged poses, each in its group's frame, which is that of the
            group's first robot, or of its priors where maps have any; the accepted closures and
            no other, the priors that were used and no other.
        candidates: all closures, in the given order.
        accepted: bool `[m]` over the candidates, those that were accepted and used.
        anchors: Lie `[robots]`, float64: the pose `T_r` of each map's own frame in its group's
            frame, `P = T_r X` at the map's first pose; the identity for a robot by itself, and
            near it for one whose own priors are the group's.
        solution: costs and convergence.
        groups: tuples of robot indices; robots that no accepted closure connects are apart.
        selection: how the closures were chosen, with evidence and certificates; None if they were
            given or the method is a robust one.
        maps: the robots' own optimised maps, before merging.
        method: how the closures were chosen.
        confidence: probability inside the gate; None where no gate was used.
        gate: γ², which a pair of closures (of a robust method: a closure) had to pass; None too.
        seconds: wall-clock time of "optimize", "marginals", "consistency", "clique" and "merge";
            "compile" is what JAX's compiler took of these.
        robust: of a robust method, each closure's scale and where the solve left the maps;
            else None.
    """

    graph: MultiRobotGraph
    candidates: LoopClosures
    accepted: Bool[np.ndarray, " m"]
    anchors: Any
    solution: MergeSolution
    groups: tuple[tuple[int, ...], ...]
    selection: Selection | None
    maps: tuple[Any, ...]
    method: str
    confidence: float | None
    gate: float | None
    seconds: dict[str, float]
    robust: RobustSolution | None = None

    def __repr__(self) -> str:
        groups = " | ".join(
            " + ".join(self.graph.maps[robot].name for robot in members) for members in self.groups
        )
        fit = self.solution
        chi2 = "–" if fit.normalized_chi2 is None else f"{fit.normalized_chi2:.3g}"
        end = "converged" if fit.converged else "not converged"
        return (
            f"MergeResult({int(self.accepted.sum())} of {len(self.accepted)} closures accepted)\n"
            f"  groups  {groups}\n"
            f"  fit     cost {fit.cost:.6g}, normalised χ² {chi2}, {end}, by {self.method}"
        )

    @functools.cached_property
    def anchor_covariance(self) -> Float[np.ndarray, "robots d d"]:
        """The covariance of each `T_r` for `T_r exp(δ)`: how well its map is tied to its group.

        Zero for the first robot of a group, whose frame is the group's; with priors for none.
        """
        return _anchor_covariance(self)

    def report(self) -> dict[str, Any]:
        """Returns the result as plain data (numbers, strings, lists, dicts), as in `report.json`.

        Pose names are the robot's name and the pose's id in its file. Anchors are translations in
        metres with an angle in radians or a quaternion; null for a robot by itself.
        """
        from pcm_jax import __version__

        graph = self.graph
        alone = {members[0] for members in self.groups if len(members) == 1}
        solution = dataclasses.asdict(self.solution)
        del solution["initial_cost"]
        return {
            "version": __version__,
            "method": self.method,
            "confidence": self.confidence,
            "gate": self.gate,
            "robots": [
                {"name": m.name, "poses": m.num_poses, "edges": m.num_edges} for m in graph.maps
            ],
            "closures": self._closure_rows(),
            "robot_pairs": self._pair_rows(),
            "anchors": [
                None if robot in alone else _pose_fields(lie.take(self.anchors, robot))
                for robot in range(len(graph.maps))
            ],
            "solution": solution,
            "groups": [[graph.maps[robot].name for robot in group] for group in self.groups],
            "seconds": dict(self.seconds),
        }

    def plot(self, ax: Any = None, *, is_true: Any = None) -> Any:
        """Draws the merged maps with accepted and rejected closures; needs the `plot` extra.

        Args:
            ax: matplotlib axes; new ones by default.
            is_true: bool `[m]`, the closures that are right, if known.

        Returns:
            The axes.
        """
        from pcm_jax.plots import plot_merge

        return plot_merge(self, ax, is_true=is_true)

    def _closure_rows(self) -> list[dict[str, Any]]:
        maps, closures = self.graph.maps, self.candidates
        ends = zip(
            np.asarray(closures.robot_a).tolist(),
            np.asarray(closures.pose_a).tolist(),
            np.asarray(closures.robot_b).tolist(),
            np.asarray(closures.pose_b).tolist(),
            strict=True,
        )
        return [
            {
                "index": index,
                "a": maps[a].pose_name(i),
                "b": maps[b].pose_name(k),
                "source": str(closures.source[index]),
                "accepted": bool(self.accepted[index]),
            }
            for index, (a, i, b, k) in enumerate(ends)
        ]

    def _pair_rows(self) -> list[dict[str, Any]]:
        maps, closures = self.graph.maps, self.candidates
        certificates = {
            (pair.robot_a, pair.robot_b): (pair.optimal, pair.upper_bound)
            for pair in (self.selection.pairs if self.selection else ())
        }
        rows = []
        for a, b in closures.pairs():
            _, indices = closures.between(a, b)
            optimal, upper_bound = certificates.get((a, b), (None, None))
            rows.append(
                {
                    "a": maps[a].name,
                    "b": maps[b].name,
                    "measured": len(indices),
                    "accepted": int(self.accepted[indices].sum()),
                    "optimal": optimal,
                    "upper_bound": upper_bound,
                }
            )
        return rows


def _pose_fields(pose: Any) -> dict[str, float]:
    if lie.tangent_dim(pose) == 3:
        cos, sin, x, y = map(float, lie.components(lie.as_numpy(pose)))
        values = [x, y, float(np.arctan2(sin, cos))]
    else:
        w, *axis, x, y, z = map(float, lie.components(lie.as_numpy(pose)))
        values = [x, y, z, *axis, w]
    return dict(zip(POSE_FIELDS[lie.tangent_dim(pose)], values, strict=True))


@on_host
def _anchor_covariance(result: MergeResult) -> np.ndarray:
    """`T = P X⁻¹` with X held: a perturbation of P on the right is `Ad(X) δ` of T's."""
    graph = result.graph
    covariance = np.zeros((len(graph.maps), graph.tangent_dim, graph.tangent_dim))
    here = lie.identity(graph.group, (len(graph.maps),))
    for members in result.groups:
        every = np.ones(len(graph.closures), bool)
        used = closures_within(members, graph.closures, every)
        joint = MapCovariance(joint_graph(graph, members, used, here))
        sizes = [graph.maps[robot].num_poses for robot in members]
        firsts = joint.diagonal(np.cumsum(sizes) - sizes)
        for robot, own in zip(members, firsts, strict=True):
            first = lie.take(lie.as_numpy(result.maps[robot].poses), 0)
            transport = np.asarray(lie.adjoint(first))
            covariance[robot] = transport @ own @ transport.T
    return covariance
