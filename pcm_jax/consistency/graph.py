"""The consistency graph: closures as nodes, an edge between two that agree."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from pcm_jax.arrays import as_array, as_real, device_array, standard_rules
from pcm_jax.errors import InputError

if TYPE_CHECKING:
    import networkx as nx


@standard_rules()
def consistency_graph(squared: Float[Array, "*batch m m"], gate: Any) -> Bool[Array, "*batch m m"]:
    """Makes the adjacency matrix: u and v agree if q²_uv and q²_vu are both within the gate.

        consistent = pcm_jax.consistency_graph(squared, pcm_jax.chi2_gate(0.99, dof=3))
        pcm_jax.maximum_clique(consistent).members

    Args:
        squared: squared distances, `[u, v]` not necessarily equal to `[v, u]`. NaN agrees with
            nothing.
        gate: γ², see `chi2_gate`: one number.

    Returns:
        Symmetric, the diagonal false; NumPy for NumPy, else JAX, safe under jit and vmap.

    Raises:
        InputError: when `squared` is not a square matrix of real numbers, or a concrete gate is not
            one number of at least 0.
    """
    if not isinstance(squared, jax.Array):
        squared = cast(Any, as_real(squared, "squared"))
    if squared.ndim < 2 or squared.shape[-1] != squared.shape[-2]:
        raise InputError(f"squared: shape {tuple(squared.shape)}; expected [m, m]")
    if isinstance(squared, Tracer) or isinstance(gate, Tracer):
        return _within_both_ways(squared, gate, jnp)
    level = as_real(gate, "gate")
    if level.ndim or not level >= 0.0:
        raise InputError(f"gate: {gate}; expected one number of at least 0")
    # Concrete arrays by NumPy: eager JAX would compile for every number of closures.
    graph = _within_both_ways(np.asarray(squared), level, np)
    return graph if isinstance(squared, np.ndarray) else device_array(graph, np.bool_)


def _within_both_ways(squared: Any, gate: Any, xp: Any) -> Any:
    within = squared <= gate
    return within & xp.swapaxes(within, -1, -2) & ~xp.eye(squared.shape[-1], dtype=bool)


def to_networkx(
    graph: Bool[Array, "m m"], squared: Float[Array, "m m"] | None = None
) -> nx.Graph[int]:
    """Makes a networkx graph of the consistency graph, nodes 0 … m − 1.

        networkx.density(pcm_jax.to_networkx(consistent, squared))

    Args:
        graph: adjacency matrix, see `consistency_graph`.
        squared: squared distances. If given, every edge has the larger of its two directions as
            the attribute `squared`.
    """
    import networkx as nx

    graph = cast(Any, as_array(graph, "graph"))
    if graph.ndim != 2 or graph.shape[0] != graph.shape[1] or graph.dtype != bool:
        raise InputError(f"graph: {graph.dtype} {graph.shape}, expected bool [m, m]")
    result: nx.Graph[int] = nx.Graph()
    result.add_nodes_from(range(len(graph)))
    u, v = np.nonzero(np.triu(np.asarray(graph), 1))
    if squared is None:
        result.add_edges_from(zip(u.tolist(), v.tolist(), strict=True))
        return result
    values = as_real(squared, "squared")
    if values.shape != graph.shape:
        raise InputError(f"squared: shape {values.shape}, expected {graph.shape}")
    larger = np.maximum(values, values.T)[u, v]
    edges = zip(u.tolist(), v.tolist(), larger.tolist(), strict=True)
    result.add_weighted_edges_from(edges, weight="squared")
    return result
