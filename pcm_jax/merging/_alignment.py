"""Where each map lies in its group's frame, from the accepted closures: the start of the solve.

Closure u between pose i of robot a and pose k of robot b says by itself where map b lies in map a:
`T_u = X_i z_u Y_k⁻¹`. Of a pair's closures the one whose T_u is nearest to the others' (the medoid)
is believed; the robots of a group are chained along the pairs with the most closures. Host, NumPy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool

from pcm_jax import lie
from pcm_jax.graph import MultiRobotGraph

MOST_COMPARED = 256
"""Closures of a pair among which the medoid is sought."""


def aligned_anchors(
    graph: MultiRobotGraph, accepted: Bool[np.ndarray, " m"], groups: tuple[tuple[int, ...], ...]
) -> Any:
    """Anchors `T_r`, the pose of each map's frame in that of its group's first robot.

    Args:
        graph: optimised maps and all closures.
        accepted: closures to use.
        groups: robots that these connect.

    Returns:
        Lie `[robots]`, NumPy; the identity for the first robot of each group.
    """
    closures = graph.closures[accepted]
    pairs = [(a, b, *closures.between(a, b)) for a, b in closures.pairs()]
    pairs.sort(key=lambda pair: -len(pair[3]))
    group = lie.group_of(lie.as_numpy(graph.maps[0].poses))
    anchors = [lie.identity(group) for _ in graph.maps]
    placed = {members[0] for members in groups}
    while len(placed) < len(graph.maps):
        a, b, between, _ = next(p for p in pairs if (p[0] in placed) != (p[1] in placed))
        from_a_to_b = _relative_anchor(graph, a, b, between)
        if a in placed:
            anchors[b] = lie.compose(anchors[a], from_a_to_b)
        else:
            anchors[a] = lie.compose(anchors[b], lie.inverse(from_a_to_b))
        placed |= {a, b}
    return lie.stack(anchors)


def _relative_anchor(graph: MultiRobotGraph, a: int, b: int, closures: Any) -> Any:
    """The medoid of T_u over the closures between two robots."""
    from_a = lie.take(lie.as_numpy(graph.maps[a].poses), np.asarray(closures.pose_a))
    from_b = lie.take(lie.as_numpy(graph.maps[b].poses), np.asarray(closures.pose_b))
    measured = lie.compose(from_a, lie.as_numpy(closures.measurement))
    placements = lie.compose(measured, lie.inverse(from_b))
    compared = lie.take(placements, slice(0, MOST_COMPARED))
    # Distances between the images of map b's touched poses, not between distant origins.
    touched = lie.translation(from_b)
    centre = touched.mean(axis=0)
    matrices = np.asarray(lie.as_matrix(compared))
    where = matrices[:, :-1, :-1] @ centre + matrices[:, :-1, -1]
    extent = 1.0 + np.linalg.norm(np.ptp(touched, axis=0))
    turned = extent * matrices[:, :-1, :-1].reshape(len(matrices), -1)
    features = np.concatenate([where, turned], axis=1)
    distance = np.linalg.norm(features[:, None] - features[None], axis=2)
    return lie.take(compared, int(np.argmin(distance.sum(axis=1))))
