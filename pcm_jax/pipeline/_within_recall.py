"""The closures inside one map that the largest set leaves out, and the cleaned map agrees with.

A set of n right closures is a clique only if all n (n − 1) / 2 pairs pass the gate. The map that
odometry and the set make judges each of the others by itself, see `merging.recall`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from pcm_jax.graph import PoseGraph
from pcm_jax.mapping import optimize
from pcm_jax.merging.recall import recall
from pcm_jax.merging.refinement import JointTest


def with_recalled(
    whole: PoseGraph,
    kept: Bool[np.ndarray, " e"],
    odometry: Bool[np.ndarray, " e"],
    confidence: float,
) -> Bool[np.ndarray, " e"]:
    """Marks the edges kept, and closures that agree with the map that these make.

    Args:
        whole: as for `rechecked`.
        kept: odometry and the closures accepted, one at least.
        odometry: the edges that are never in doubt.
        confidence: of the gate, and of the joint test of what comes back.
    """
    if kept.all():
        return kept
    solution = optimize(whole.with_edges(kept))
    if not solution.converged:
        return kept
    held = kept & ~odometry
    joint = JointTest(2.0 * solution.cost, int(held.sum()) * whole.tangent_dim)
    return recall(
        whole.with_poses(solution.graph.poses),
        kept,
        ~kept,
        joint,
        accepted=held,
        confidence=confidence,
    ).used
