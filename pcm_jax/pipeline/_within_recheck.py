"""The closures of the largest set that the map which they make contradicts, see `consensus`.

Where the set fits far better than stated, the map grows by those of it that agree under a gate as
much narrower (`Trials.core`, `consistency.overstated`); in the end all of them are judged.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from pcm_jax.consistency import chi2_gate
from pcm_jax.graph import PoseGraph
from pcm_jax.mapping import optimize
from pcm_jax.merging.consensus import consensus, fitting_edges


def rechecked(
    whole: PoseGraph,
    kept: Bool[np.ndarray, " e"],
    core: Bool[np.ndarray, " e"],
    odometry: Bool[np.ndarray, " e"],
    confidence: float,
) -> Bool[np.ndarray, " e"]:
    """Marks odometry and the closures that hold in the map as it grows, and in the end.

    Args:
        whole: the map as it was judged, without priors.
        kept: odometry and the closures accepted.
        core: those of them, without odometry, that the map is made of as it grows.
        odometry: the edges that are never in doubt.
        confidence: of the gate, and of the joint test on the way.
    """
    alone = optimize(whole.with_edges(odometry)).graph
    used, grown = consensus(whole.with_poses(alone.poses), odometry, core, confidence=confidence)
    gate = float(chi2_gate(confidence, whole.tangent_dim))
    asked = np.flatnonzero(kept & ~odometry)
    return fitting_edges(grown, used, asked, gate, initial="chordal", narrow=True)
