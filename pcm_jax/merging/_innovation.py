"""Innovations: edges against the map that the others make.

With whitened residual r and Jacobians J of an edge at the optimum, Σ the joint covariance of its
two poses there, and P = J Σ Jᵀ,

    an edge left out        χ² = rᵀ (I + P)⁻¹ r     by which the map's χ² rises if it enters,
    an edge that is in it   χ² = rᵀ (I − P)⁻¹ r     by which it falls if it leaves,

the same number of one edge to first order, chi-squared with d degrees of freedom if it is right.
Of what the map of the others predicts and the edge states together, the standard deviations are
|I + P|^(1/2d) or |I − P|^(−1/2d) times those that the edge states, in the geometric mean: the width
of the test. The wider it is, the less it says.

Host; one factorisation, and the joint covariances of the edges' poses.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.graph import PoseGraph
from pcm_jax.mapping import MapCovariance
from pcm_jax.mapping._linearization import linearize
from pcm_jax.mapping.least_squares import padded_edges
from pcm_jax.mapping.optimization import host_arrays


class Innovation(NamedTuple):
    """The test of k edges.

    Attributes:
        squared: χ², `[k]`.
        width: of the test, `[k]`: 1 where the map knows all; NaN for an edge that is in it and
            holds it together alone.
    """

    squared: Float[np.ndarray, " k"]
    width: Float[np.ndarray, " k"]


def innovation(
    graph: PoseGraph, used: Bool[np.ndarray, " e"], edges: Int[np.ndarray, " k"]
) -> Innovation:
    """Tests edges in the map of all used ones but themselves.

    Args:
        graph: at the optimum of the edges used.
        used: which edges hold.
        edges: which are asked for, used or not.
    """
    if not len(edges):
        return Innovation(np.zeros(0), np.zeros(0))
    tail, head, measurement, information = host_arrays(graph)
    asked = tail[edges], head[edges], lie.take(measurement, edges), information[edges]
    linear = linearize(lie.as_numpy(graph.poses), padded_edges(*asked, size=len(edges)))
    both = np.stack([np.asarray(linear.tail), np.asarray(linear.head)]).transpose(3, 1, 0, 2)
    count, d, *_ = both.shape
    jacobian = both.reshape(count, d, 2 * d)
    joint = MapCovariance(graph.with_edges(used)).pairs(*asked[:2])
    predicted = jacobian @ joint @ jacobian.swapaxes(1, 2)
    total = np.eye(d) + np.where(used[edges], -1.0, 1.0)[:, None, None] * predicted
    residual = np.asarray(linear.residual).T[..., None]
    sign, logarithm = np.linalg.slogdet(total)
    width = np.where(sign > 0.0, np.exp(np.abs(logarithm) / (2 * d)), np.nan)
    regular = sign != 0.0
    weighed = np.empty_like(residual)
    weighed[regular] = np.linalg.solve(total[regular], residual[regular])
    held_alone = np.linalg.pinv(total[~regular], hermitian=True)  # no residual where it is singular
    weighed[~regular] = held_alone @ residual[~regular]
    return Innovation(np.sum(residual * weighed, axis=(1, 2)), width)


def squared_by_leaving(
    graph: PoseGraph, used: Bool[np.ndarray, " e"], edges: Int[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Computes χ² alone, see `_innovation`."""
    return innovation(graph, used, edges).squared
