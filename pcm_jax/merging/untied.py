"""Directions in which a merged map is tied by nothing: closures that leave them unsaid.

With left errors w of the robots' anchors in the group's frame, closure u between robots a and b
weighs w_b − w_a with Λ_u = Ad(P_k)⁻ᵀ Ω_u Ad(P_k)⁻¹, P_k the pose that it ends at. The group's first
robot is held, and so are robots with priors of their own; what Σ Λ_u over the rest lacks is said by
no closure. Maps are rigid in this: their own edges leave nothing unsaid.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from pcm_jax import lie
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.graph.unsaid import AXES

ZERO = 1e-9
"""Eigenvalues of the scaled sum that are rounding."""


def untied(graph: MultiRobotGraph, groups: Sequence[Sequence[int]]) -> dict[int, tuple[str, ...]]:
    """Names the directions in which robots are not tied, by robot; none for those that are.

    Args:
        graph: merged maps and the closures that were used.
        groups: of robots that these connect.

    Returns:
        For each such robot the directions of its place in the group's frame, by their nearest
        axes.
    """
    closures = graph.closures
    lacking = closures.rank < closures.tangent_dim
    found: dict[int, tuple[str, ...]] = {}
    for members in groups:
        within = np.isin(np.asarray(closures.robot_a), members) & lacking
        if within.any():
            found |= _of_group(graph, members)
    return found


def _of_group(graph: MultiRobotGraph, members: Sequence[int]) -> dict[int, tuple[str, ...]]:
    d = graph.tangent_dim
    free = [robot for robot in members[1:] if not _has_priors(graph, robot)]
    place = {robot: k for k, robot in enumerate(free)}
    total = np.zeros((len(free), d, len(free), d))
    for a, b in graph.closures.pairs():
        if a not in members:
            continue
        said = _said(graph, a, b)
        for one, other, sign in ((a, a, 1.0), (b, b, 1.0), (a, b, -1.0), (b, a, -1.0)):
            if one in place and other in place:
                total[place[one], :, place[other]] += sign * said
    basis = _null(total.reshape(len(free) * d, -1)).reshape(len(free), d, -1)
    return {
        robot: names for robot, own in zip(free, basis, strict=True) if (names := _nearest(own))
    }


def _has_priors(graph: MultiRobotGraph, robot: int) -> bool:
    priors = graph.maps[robot].priors
    return priors is not None and len(priors) > 0


def _said(graph: MultiRobotGraph, a: int, b: int) -> Float[np.ndarray, "d d"]:
    """Σ Λ_u of the closures between two robots, about the middle of what they see."""
    closures, _ = graph.closures.between(a, b)
    ends = lie.take(lie.as_numpy(graph.maps[b].poses), np.asarray(closures.pose_b))
    back = np.asarray(lie.adjoint(lie.inverse(ends)))
    return (back.swapaxes(1, 2) @ np.asarray(closures.information) @ back).sum(axis=0)


def _null(total: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n s"]:
    """A basis of what a positive semidefinite matrix lacks, its units balanced."""
    own = np.diagonal(total)
    scale = 1.0 / np.sqrt(np.where(own > 0.0, own, 1.0))
    values, vectors = np.linalg.eigh(scale[:, None] * total * scale)
    return scale[:, None] * vectors[:, values < ZERO]


def _nearest(basis: Float[np.ndarray, "d s"]) -> tuple[str, ...]:
    """The axes along which directions mostly lie, as many as there are directions."""
    directions, values, _ = np.linalg.svd(basis, full_matrices=False)
    directions = directions[:, values > ZERO * max(values.max(initial=0.0), 1e-300)]
    share = (directions**2).sum(axis=1)
    chosen = np.sort(np.argsort(-share, kind="stable")[: directions.shape[1]])
    return tuple(AXES[len(basis)][k] for k in chosen)
