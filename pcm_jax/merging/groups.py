"""Groups of robots that accepted closures connect. Robots that none connects stay apart."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int

from pcm_jax.graph import LoopClosures
from pcm_jax.graph.spanning_tree import connected_parts


def robot_groups(
    robots: int, closures: LoopClosures, accepted: Bool[np.ndarray, " m"]
) -> tuple[tuple[int, ...], ...]:
    """Connected components of the robots.

    Args:
        robots: how many there are.
        closures: all closures.
        accepted: those that connect.

    Returns:
        Tuples of robot indices, ascending, in the order of their first robots.
    """
    ends = np.asarray(closures.robot_a)[accepted], np.asarray(closures.robot_b)[accepted]
    count, label = connected_parts(*ends, robots)
    groups = [tuple(np.flatnonzero(label == k).tolist()) for k in range(count)]
    return tuple(sorted(groups))


def closures_within(
    members: tuple[int, ...], closures: LoopClosures, accepted: Bool[np.ndarray, " m"]
) -> Int[np.ndarray, " k"]:
    """Indices of the accepted closures between the robots of a group, other ends left out."""
    ends = np.asarray(closures.robot_a), np.asarray(closures.robot_b)
    return np.flatnonzero(accepted & np.isin(ends, members).all(axis=0))
