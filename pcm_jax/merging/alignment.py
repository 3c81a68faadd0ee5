"""Each map's place in its group's frame, from the accepted closures: the start of the solve.

Closure u between pose i of robot a and pose k of robot b says by itself where map b lies in map a:
`T_u = X_i z_u Y_k⁻¹`. Of a pair's closures the one whose T_u is nearest to the others' (the medoid)
is believed; the robots of a group are chained along the pairs with the most closures. Host, NumPy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from pcm_jax import lie
from pcm_jax.arrays import namespace
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
    seen = lie.translation(from_b)[:MOST_COMPARED]
    cost = medoid_costs(lie.as_matrix(compared), seen, np.ones(len(seen)))
    return lie.take(compared, int(np.argmin(cost)))


def medoid_costs(
    placements: Float[Any, "k s s"], seen: Float[Any, "k p"], weights: Float[Any, " k"]
) -> Float[Any, " k"]:
    """Sums each placement's distances from all others, weighted: least for the medoid.

    Distances between the images of the middle of what the closures see, not between origins, which
    may be far away; with the rotations' difference at a lever arm as long as what they see.
    NumPy or JAX.

    Args:
        placements: T_u as homogeneous matrices.
        seen: y_u, the positions in the map that the closures measure, metres.
        weights: of the others; where one is 0 its closure does not count.
    """
    xp = namespace(placements, seen, weights)
    counted = weights > 0.0
    middle = xp.where(counted[:, None], seen, 0.0).sum(axis=0) / xp.maximum(counted.sum(), 1)
    spread = xp.where(counted[:, None], xp.abs(seen - middle), 0.0)
    lever = 1.0 + 2.0 * xp.sqrt(xp.sum(xp.max(spread, axis=0) ** 2))
    turn, shift = placements[:, :-1, :-1], placements[:, :-1, -1]
    features = xp.concatenate([turn @ middle + shift, lever * turn.reshape(len(turn), -1)], axis=1)
    away = features[:, None] - features[None]
    return xp.sqrt(xp.sum(away * away, axis=-1)) @ weights
