"""How certain some poses of a map are, jointly: what the consistency of loop closures rests on.

With `H = Σ JᵀJ` at the optimum and the first pose held, the joint covariance of the poses that
closures touch is a block of `H⁻¹`, found from the sparse factor (`inverse_block`): never the whole
inverse, never pose pair by pose pair. Runs on the host.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.errors import InputError
from pcm_jax.graph import PoseGraph
from pcm_jax.mapping._normal_equations import system_for
from pcm_jax.mapping.least_squares import padded_edges, padded_size
from pcm_jax.mapping.optimization import host_arrays
from pcm_jax.sparse.cholesky import CholeskyFactor, NotPositiveDefiniteError
from pcm_jax.sparse.inverse import inverse_block


@on_host
def joint_marginal_covariance(
    pose_graph: PoseGraph, poses: Int[np.ndarray, " k"]
) -> Float[np.ndarray, "k*d k*d"]:
    """Joint covariance of some poses at the graph's own poses, which should be the optimum.

    Args:
        pose_graph: an optimised map.
        poses: `[k]` indices, in any order, each once. The first pose is held, so its rows and
            columns are zero.

    Returns:
        `[k·d, k·d]` for right perturbations `X exp(δ)`, δ = (translation, rotation), metres and
        radians; blocks in the order of `poses`.

    Raises:
        InputError: for an index out of range or given twice, or a singular map.
    """
    wanted = _check_indices(np.asarray(poses), pose_graph.num_poses)
    d = pose_graph.tangent_dim
    free = wanted[wanted != 0]
    covariance = np.zeros((len(wanted), d, len(wanted), d))
    if len(free):
        rows, scalar = np.flatnonzero(wanted != 0), np.arange(d)
        found = inverse_block(covariance_factor(pose_graph), free)
        found = found.reshape(len(free), d, len(free), d)
        covariance[np.ix_(rows, scalar, rows, scalar)] = found
    return covariance.reshape(len(wanted) * d, len(wanted) * d)


def _check_indices(poses: np.ndarray, size: int) -> np.ndarray:
    if poses.ndim != 1 or not np.issubdtype(poses.dtype, np.integer):
        raise InputError(
            f"poses: shape {poses.shape}, dtype {poses.dtype} given, expected integers [k]"
        )
    outside = np.flatnonzero((poses < 0) | (poses >= size))
    if len(outside):
        at = outside[0]
        raise InputError(f"poses[{at}]: {poses[at]} given, expected 0 … {size - 1}")
    values, count = np.unique(poses, return_counts=True)
    if (count > 1).any():
        raise InputError(f"poses: {values[count > 1][0]} given twice, expected each pose once")
    return poses.astype(np.int64)


def covariance_factor(graph: PoseGraph) -> CholeskyFactor:
    """The factor of H, whose inverse is the covariance of all poses but the first.

    The first pose, which is held, has an identity block and is tied to none.

    Raises:
        InputError: for a singular map.
    """
    tail, head, measurement, information = host_arrays(graph)
    fixed = np.arange(graph.num_poses) == 0
    products = _edge_information(graph.poses, tail, head, measurement, information)
    system = system_for(graph.num_poses, tail, head, fixed, graph.tangent_dim)
    try:
        return system.factorize(products)
    except NotPositiveDefiniteError as error:
        raise InputError(
            f"pose_graph {graph.name!r}: its information is singular: some pose is tied to the"
            " first one by measurements of almost no weight"
        ) from error


def _edge_information(poses: Any, *edges: Any) -> Float[np.ndarray, "3 e d d"]:
    """JᵀJ of every edge's two poses, on the host."""
    size = padded_size(lie.parameters(poses).shape[0], len(edges[0]))
    padded = padded_edges(*edges, size=size)
    start = lie.pad_leading(lie.as_numpy(poses), size)
    return np.asarray(_compiled_products()(start, padded))


@functools.cache
def _compiled_products() -> Any:
    from pcm_jax.mapping._linearization import apart, linearize
    from pcm_jax.mapping._normal_equations import edge_products

    @jax.jit
    def edge_information(poses: Any, edges: Any) -> Any:
        residual, by_tail, by_head = linearize(poses, edges)
        return apart(edges.tail[0] >= 0, edge_products, by_tail, by_head, residual).products

    return edge_information
