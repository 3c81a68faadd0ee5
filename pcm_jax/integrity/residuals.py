"""Residuals in merged maps: of closures, whether used or not, and of the edges strained most.

With P and Q the merged poses at an edge's ends, `r = Log(z⁻¹ P⁻¹ Q)` and χ² = rᵀΩr. Of what was
used for the merge χ² is a little less than the d to be expected, since the map has followed it; of
a closure that was left out it is without the map's own uncertainty, which eq. 4 has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.consistency.joint import survival
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures, PoseGraph, unsaid

AXES = {3: ("x", "y", "theta"), 6: ("x", "y", "z", "rx", "ry", "rz")}
"""Names of a residual's entries, by their number: metres, then radians."""


@dataclass(frozen=True)
class Fit:
    """The fit of one measurement in the merged map.

    Attributes:
        chi2: rᵀΩr.
        residual: `[d]` Log of what is left between the measurement and the map, seen from where the
            measurement ends; metres, then radians. Without what the measurement does not say.
        p: probability that a right measurement between certain poses has a chi2 at least as large.
        dof: degrees of freedom of chi2: d, or the rank of the measurement's information.
    """

    chi2: float
    residual: tuple[float, ...]
    p: float
    dof: int

    @property
    def by_axis(self) -> dict[str, float]:
        """The residual with its entries' names: x, y, theta, or x, y, z, rx, ry, rz."""
        return dict(zip(AXES[len(self.residual)], self.residual, strict=True))


@dataclass(frozen=True)
class StrainedEdge:
    """An edge of a robot's own map, and how far merging has moved it from its measurement.

    Attributes:
        robot: the map's name.
        tail: the name of the pose it starts at.
        head: of the one it ends at.
        source: file and line, or "".
        odometry: whether it joins neighbours; else it is a loop inside the map.
        fit: in the merged map.
    """

    robot: str
    tail: str
    head: str
    source: str
    odometry: bool
    fit: Fit

    def __repr__(self) -> str:
        kind = "odometry" if self.odometry else "loop"
        off = ", ".join(f"{name} {value:.3g}" for name, value in self.fit.by_axis.items())
        return (
            f"StrainedEdge({self.tail} to {self.head}, {kind} of robot {self.robot})\n"
            f"  chi2      {self.fit.chi2:.4g}, {self.fit.dof} expected\n"
            f"  residual  {off} (m, rad)"
        )


def fits(
    maps: Sequence[PoseGraph], groups: Sequence[Sequence[int]], closures: LoopClosures
) -> list[Fit | None]:
    """Fits closures to merged maps.

    Args:
        maps: merged, each group's in one frame.
        groups: robots that are in one frame.
        closures: any between the maps.

    Returns:
        One a closure; None between robots that are not in one frame.
    """
    frame = np.zeros(len(maps), int)
    for number, robots in enumerate(groups):
        frame[list(robots)] = number
    robot_a, robot_b = np.asarray(closures.robot_a), np.asarray(closures.robot_b)
    found: list[Fit | None] = [None] * len(closures)
    joined = np.flatnonzero(frame[robot_a] == frame[robot_b])
    if len(joined):
        poses = lie.concatenate([lie.as_numpy(one.poses) for one in maps])
        first = np.cumsum([0, *(one.num_poses for one in maps)])[:-1]
        used = closures[joined]
        tail = first[robot_a[joined]] + np.asarray(used.pose_a)
        head = first[robot_b[joined]] + np.asarray(used.pose_b)
        own = _fits(lie.take(poses, tail), lie.take(poses, head), used)
        for index, fit in zip(joined.tolist(), own, strict=True):
            found[index] = fit
    return found


@on_host
def strained_edges(maps: Sequence[PoseGraph], count: int = 5) -> list[StrainedEdge]:
    """Finds the edges of the robots' own maps that a merge has strained most, by χ².

    Args:
        maps: merged.
        count: how many, all robots together.

    Raises:
        InputError: for a negative count.
    """
    if count < 0:
        raise InputError(f"count: {count}, expected at least 0")
    chi2 = [_residuals(*_ends(one), one)[1] for one in maps]
    robot = np.repeat(np.arange(len(maps)), [len(own) for own in chi2])
    edge = np.concatenate([np.arange(len(own)) for own in chi2])
    worst = np.argsort(-np.concatenate(chi2), kind="stable")[:count]
    return [_strained(maps[int(robot[row])], int(edge[row])) for row in worst]


def _strained(one: PoseGraph, edge: int) -> StrainedEdge:
    alone = one.with_edges(np.array([edge]))
    (fit,) = _fits(*_ends(alone), alone)
    tail, head = int(one.tail[edge]), int(one.head[edge])
    return StrainedEdge(
        robot=one.name,
        tail=one.pose_name(tail),
        head=one.pose_name(head),
        source=str(one.source[edge]),
        odometry=abs(tail - head) == 1,
        fit=fit,
    )


def _ends(one: PoseGraph) -> tuple[Any, Any]:
    poses = lie.as_numpy(one.poses)
    return lie.take(poses, np.asarray(one.tail)), lie.take(poses, np.asarray(one.head))


def _residuals(
    tail: Any, head: Any, edges: Any
) -> tuple[Float[np.ndarray, "e d"], Float[np.ndarray, " e"]]:
    measured = lie.as_numpy(edges.measurement)
    residual = np.asarray(lie.log(lie.compose(lie.inverse(measured), lie.between(tail, head))))
    return residual, np.einsum("ki,kij,kj->k", residual, np.asarray(edges.information), residual)


def _fits(tail: Any, head: Any, edges: Any) -> list[Fit]:
    residual, chi2 = _residuals(tail, head, edges)
    information = np.asarray(edges.information)
    dof = unsaid.ranks(information)
    said = np.einsum("kij,kj->ki", unsaid.said(information), residual)
    return [
        Fit(square, tuple(own), survival(square, degrees), degrees)
        for square, own, degrees in zip(chi2.tolist(), said.tolist(), dof.tolist(), strict=True)
    ]
