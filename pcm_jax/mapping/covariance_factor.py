"""The factor of a map's information matrix at the poses it has, of which covariances are made."""

from __future__ import annotations

import warnings
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.errors import InputError, InputWarning
from pcm_jax.graph import PoseGraph
from pcm_jax.mapping._linearization import apart, edge_products, linearize
from pcm_jax.mapping._lost_digits import lost_digits
from pcm_jax.mapping.least_squares import Framed, padded_edges, padded_size, with_frame
from pcm_jax.mapping.optimization import host_arrays
from pcm_jax.mapping.priors import held
from pcm_jax.sparse.cholesky import CholeskyFactor, NotPositiveDefiniteError
from pcm_jax.sparse.system import system_for

LOST = 1e-3
"""Share of a covariance that rounding may take without a word."""
COMPILED_FROM = 8192
"""Edges: up to here NumPy linearises sooner than JAX compiles."""


@on_host
def covariance_factor(graph: PoseGraph) -> CholeskyFactor:
    """The factor of H, whose inverse is the covariance of all poses but the first.

    The first pose, which is held, has an identity block and is tied to none. With priors that is a
    last pose, their frame.

    Raises:
        InputError: for a singular map.
    """
    priors = held(graph)
    first = (np.arange(graph.num_poses) == 0) & (priors is None)
    problem = Framed(*host_arrays(graph), first)
    problem = problem if priors is None else problem.with_priors(priors)
    *edges, fixed = problem
    poses = with_frame(graph.poses, len(fixed))
    products = _edge_information(poses, *edges)
    system = system_for(len(fixed), problem.tail, problem.head, fixed, graph.tangent_dim)
    try:
        factor = system.factorize(products)
    except NotPositiveDefiniteError as error:
        raise InputError(
            f"pose_graph {graph.name!r}: its information is singular: some pose is tied to the"
            " first one by measurements of almost no weight"
        ) from error
    lost = lost_digits(factor, products, np.stack([problem.tail, problem.head]), ~fixed)
    if lost > LOST:
        warnings.warn(
            InputWarning(
                f"map {graph.name!r}: the information of its edges spans so many orders of"
                f" magnitude that covariances are right to about {lost:.1g} of their value only"
            ),
            stacklevel=2,
        )
    return factor


def _edge_information(poses: Any, *edges: Any) -> Float[np.ndarray, "3 e d d"]:
    """JᵀJ of every edge's two poses: a small map's in NumPy, a large one's compiled and padded."""
    poses, count = lie.as_numpy(poses), len(edges[0])
    if count < COMPILED_FROM:
        return _products(poses, padded_edges(*edges, size=count))
    size = padded_size(lie.parameters(poses).shape[0], count)
    padded = padded_edges(*edges, size=size)
    return np.asarray(_compiled_products(lie.pad_leading(poses, size), padded))


def _products(poses: Any, edges: Any) -> Any:
    residual, by_tail, by_head = linearize(poses, edges)
    return apart(edges.tail[0] >= 0, edge_products, by_tail, by_head, residual).products


_compiled_products = jax.jit(_products)
