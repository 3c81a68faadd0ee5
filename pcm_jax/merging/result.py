"""`MergeResult`: the merged maps, what was believed, and a report of it."""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Iterable, Sequence
from os import PathLike
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.errors import InputError, InputWarning, check_number
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph
from pcm_jax.graph.validation import as_indices
from pcm_jax.integrity import Explanation, StrainedEdge, explain, strained_edges
from pcm_jax.mapping import MapCovariance
from pcm_jax.merging._one_more_or_less import anchor_shift
from pcm_jax.merging._report import closure_rows, pair_rows, pose_fields
from pcm_jax.merging._strain import strain
from pcm_jax.merging._untied import untied
from pcm_jax.merging.groups import closures_within
from pcm_jax.merging.joint import joint_graph
from pcm_jax.merging.refinement import Refinement
from pcm_jax.merging.robust import RobustSolution
from pcm_jax.selection import Selection
from pcm_jax.tables import ShownAsTable

LINEAR_TO = np.radians(40.0)
"""Standard deviation of a heading up to which covariances to first order hold."""
UNLIKELY = 1e-3
"""Probability below which a cycle of alignments does not close."""


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
class MergeResult(ShownAsTable):
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
        refinement: of a refined merge, what it changed; else None.
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
    refinement: Refinement | None = None

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

    def _table(self) -> tuple[Sequence[str], Iterable[Sequence[object]]]:
        if self.selection is not None:
            return self.selection._table()
        rows = pair_rows(self)
        counts = ((f"{row['a']} – {row['b']}", row["measured"], row["accepted"]) for row in rows)
        return ("robots", "measured", "accepted"), counts

    @property
    def recalled(self) -> Bool[np.ndarray, " m"]:
        """The accepted closures that were not selected, but agree with the merged map."""
        if self.refinement is None:
            return np.zeros(len(self.accepted), bool)
        return self.refinement.recalled

    @property
    def ambiguous(self) -> bool:
        """True where another alignment of some two robots is supported about as well."""
        pairs = self.selection.pairs if self.selection else ()
        return any(pair.verdict.ambiguous for pair in pairs if pair.verdict)

    @functools.cached_property
    def warnings(self) -> list[str]:
        """Reasons to doubt the answer, a sentence each; empty where there is none to see."""
        names, chosen = self.graph.names, self.selection
        told = [
            f"{names[pair.robot_a]} and {names[pair.robot_b]}: {pair.verdict.why}"
            for pair in (chosen.pairs if chosen else ())
            if pair.verdict and pair.verdict.ambiguous
        ]
        for cycle in chosen.team if chosen else ():
            if cycle.p < UNLIKELY:
                around = " – ".join(names[robot] for robot in cycle.robots)
                told.append(f"the alignments around {around} do not fit (p = {cycle.p:.2g})")
        for robot, directions in untied(self.graph, self.groups).items():
            told.append(
                f"robot {names[robot]!r}: {len(directions)} of {self.graph.tangent_dim} directions"
                f" of its place ({', '.join(directions)}) are tied by no accepted closure; they"
                " stay where the closures' measurements put them"
            )
        strained = strain(self.graph, self.solution.normalized_chi2)
        return told + ([strained] if strained else [])

    @functools.cached_property
    def anchor_covariance(self) -> Float[np.ndarray, "robots d d"]:
        """The covariance of each `T_r` for `T_r exp(δ)`: how well its map is tied to its group.

        Zero for the first robot of a group, whose frame is the group's; with priors for none. About
        the origin of the robot's own frame: far from its map, a small turn there is a long way;
        `anchor_covariance_at_middle` is about the map's middle.
        """
        return _anchor_covariance(self, np.zeros((len(self.maps), self._space)))

    @functools.cached_property
    def anchor_covariance_at_middle(self) -> Float[np.ndarray, "robots d d"]:
        """The covariance of each map's place, about the mean position m of the map's own poses.

        That of δ in `T_r t(m) exp(δ)`, with t(m) the translation by m: how uncertain the middle of
        the map is, wherever its frame's origin lies. m², m rad, rad².
        """
        return _anchor_covariance(self, np.stack([_middle(own) for own in self.maps]))

    @on_host
    def marginals(
        self, robot: int, poses: Int[np.ndarray, " k"] | None = None
    ) -> Float[np.ndarray, "k*d k*d"]:
        """Computes the joint covariance of some merged poses of a robot, in its group's frame.

            result.marginals(1, [0, 17])  # [2 d, 2 d]

        To first order, from all edges and the accepted closures; the first pose of the group's
        first robot is held. The merged map is factorised once, however often this is asked.

        Args:
            robot: its index.
            poses: `[k]` indices among its poses, in any order, each once; None: all of them.

        Returns:
            `[k·d, k·d]` for right perturbations `P exp(δ)`, δ = (translation, rotation), metres
            and radians; blocks in the order of `poses`.

        Raises:
            InputError: for a robot or a pose that is not there, a pose given twice.

        Warns:
            InputWarning: where headings are known to no better than 40° (one sigma): the errors of
                poses far along the way are then no longer linear in those of headings, and to first
                order too small (`benchmarks.answers`: mean NEES 1.0 at 25°, 1.2 to 1.4 at 48°).
                Of the anchors' covariance it holds further than that.
        """
        check_number("robot", robot, integer=True)
        if not 0 <= robot < len(self.maps):
            raise InputError(f"robot: {robot} given, expected 0 … {len(self.maps) - 1}")
        count = self.maps[robot].num_poses
        wanted = np.arange(count) if poses is None else as_indices(poses, count, "poses", "poses")
        covariance, first = self._covariance_of[robot]
        joint = covariance.joint(first + wanted)
        self._warn_of_headings(robot, wanted, joint)
        return joint

    def _warn_of_headings(self, robot: int, poses: np.ndarray, joint: np.ndarray) -> None:
        """Warns where a covariance to first order is too small."""
        if len(poses) == 0:
            return
        count, d = len(poses), self.graph.tangent_dim
        own = joint.reshape(count, d, count, d)[np.arange(count), :, np.arange(count)]
        turns = np.linalg.eigvalsh(own[:, self._space :, self._space :])[:, -1]
        sigma, worst = np.sqrt(max(0.0, float(turns.max()))), int(turns.argmax())
        if sigma > LINEAR_TO:
            warnings.warn(
                f"poses: the heading of pose {poses[worst]} of robot {self.graph.names[robot]} is"
                f" known to {np.degrees(sigma):.0f}° (one sigma); a covariance to first order is"
                f" too small beyond {np.degrees(LINEAR_TO):.0f}°",
                InputWarning,
                stacklevel=3,
            )

    def explain(self, index: int) -> Explanation:
        """Explains what was made of a candidate closure; `InputError` for one that is not there.

        print(result.explain(17).sentence)
        """
        return explain(self, index)[0]

    def strained_edges(self, count: int = 5) -> list[StrainedEdge]:
        """Finds the edges of the robots' own maps that merging has strained most, by χ²."""
        return strained_edges(self.graph.maps, count)

    @on_host
    def anchor_shift(self, index: int) -> Float[np.ndarray, "robots d"]:
        """The shift ε of each anchor, T exp(ε), if one closure had been decided the other way.

        To first order and without a solve: an accepted closure is taken out, another put in, which
        is coarse where it misses by far. NaN in a group that nothing else holds together.

        Args:
            index: among the candidates.

        Raises:
            InputError: for one that is not there, or between robots that are not merged.
        """
        return anchor_shift(self, index)

    @property
    def _space(self) -> int:
        return 2 if self.graph.tangent_dim == 3 else 3

    @functools.cached_property
    def _covariance_of(self) -> dict[int, tuple[MapCovariance, int]]:
        """The covariance of each robot's group, and where the robot's own poses begin in it."""
        graph, found = self.graph, {}
        here = lie.identity(graph.group, (len(graph.maps),))
        every = np.ones(len(graph.closures), bool)
        for members in self.groups:
            used = closures_within(members, graph.closures, every)
            joint = MapCovariance(joint_graph(graph, members, used, here))
            sizes = [graph.maps[robot].num_poses for robot in members]
            firsts = (np.cumsum(sizes) - sizes).tolist()
            found |= {robot: (joint, at) for robot, at in zip(members, firsts, strict=True)}
        return found

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
            "closures": closure_rows(self),
            "robot_pairs": pair_rows(self),
            "anchors": [
                None if robot in alone else pose_fields(lie.take(self.anchors, robot))
                for robot in range(len(graph.maps))
            ],
            "solution": solution,
            "groups": [[graph.maps[robot].name for robot in group] for group in self.groups],
            "team": [
                {
                    "cycle": [graph.maps[robot].name for robot in cycle.robots],
                    "chi2": cycle.chi2,
                    "p": cycle.p,
                }
                for cycle in (self.selection.team if self.selection else ())
            ],
            **({"refine": self.refinement.report(self.maps)} if self.refinement else {}),
            "warnings": list(self.warnings),
            "seconds": dict(self.seconds),
        }

    def plot(self, ax: Any = None, *, is_true: Any = None, projection: str | None = None) -> Any:
        """Draws the merged maps with accepted and rejected closures; needs the `plot` extra.

        Args:
            ax: matplotlib axes; new ones by default.
            is_true: bool `[m]`, the closures that are right, if known.
            projection: the two axes drawn, such as "xz"; None: those of the greatest extent.

        Returns:
            The axes.
        """
        from pcm_jax.plots import plot_merge

        return plot_merge(self, ax, is_true=is_true, projection=projection)

    def to_html(self, path: str | PathLike[str]) -> None:
        """Writes the report as one HTML page that needs no network: maps, closures and why.

            pcm_jax.merge(graph).to_html("report.html")

        Args:
            path: of the file.

        Raises:
            FileFormatError: where it cannot be written.
        """
        from pcm_jax.report import write_html

        write_html(path, self)


@on_host
def _anchor_covariance(result: MergeResult, about: Float[np.ndarray, "robots s"]) -> np.ndarray:
    """The covariance of T t(m): `T = P X⁻¹` with X held, so δ of P is `Ad(t(m)⁻¹ X) δ` of that.

    Straight from the first pose P, lest the difference of large numbers be taken.
    """
    covariance = []
    for robot, middle in enumerate(about):
        joint, first = result._covariance_of[robot]
        own = joint.diagonal(np.array([first]))[0]
        values = np.array(lie.parameters(lie.take(lie.as_numpy(result.maps[robot].poses), 0)))
        values[-len(middle) :] -= middle
        transport = np.asarray(lie.adjoint(result.graph.group(values)))
        covariance.append(transport @ own @ transport.T)
    return np.stack(covariance)


def _middle(own: PoseGraph) -> Float[np.ndarray, " s"]:
    return lie.translation(lie.as_numpy(own.poses)).mean(axis=0)
