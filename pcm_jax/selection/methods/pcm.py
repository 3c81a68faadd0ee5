"""Pairwise consistent measurement set maximization: the largest set in which all agree.

J. G. Mangelson, D. Dominic, R. M. Eustice and R. Vasudevan, ICRA 2018, sections IV and V: a
maximum clique of the consistency graph. Needs m² squared distances and a gate, or that graph alone.
The kernels return the same sets: the exact one by `maximum_clique_batched`, the greedy one because
candidates only ever leave, so that one sweep in the order of falling degree takes from every start
at once what the greedy rule would.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from pcm_jax.clique import Clique, maximum_clique, maximum_clique_batched
from pcm_jax.consistency import consistency_graph
from pcm_jax.errors import InputError
from pcm_jax.selection._distances import consistent_pairs
from pcm_jax.selection.method import Choice, SelectionMethod, at_most

TIE_BREAKS = ("index", "distance")
KERNEL_LIMIT = 128
"""Measurements of the exact kernel."""


def pcm_exact(
    squared: Float[np.ndarray, "m m"],
    gate: float,
    *,
    weights: Float[np.ndarray, " m"] | None = None,
    time_limit: float | None = None,
    tie_break: str = "index",
) -> Choice:
    """The largest pairwise consistent set, proven; with weights, the heaviest.

    Args:
        squared: squared distances, not symmetrised: both directions must pass.
        gate: γ².
        weights: of the measurements, finite and at least 0; one of weight 0 is never kept.
        time_limit: seconds, see `maximum_clique`.
        tie_break: which of several largest (heaviest) sets: `"index"`, or `"distance"` (the least
            total squared distance, then index).
    """
    if tie_break not in TIE_BREAKS:
        raise InputError(f"tie_break: {tie_break!r}, expected one of {', '.join(TIE_BREAKS)}")
    graph = consistent_pairs(squared, gate)
    distances = np.where(graph, squared, 0.0) if tie_break == "distance" else None
    clique = maximum_clique(graph, weights=weights, time_limit=time_limit, tie_break=distances)
    return _choice(clique, weights)


def pcm_heuristic(
    squared: Float[np.ndarray, "m m"],
    gate: float,
    *,
    weights: Float[np.ndarray, " m"] | None = None,
    time_limit: float | None = None,
) -> Choice:
    """A large pairwise consistent set, greedily (HeuPatt, the paper's choice for large m)."""
    graph = consistent_pairs(squared, gate)
    return pcm_heuristic_in(graph, weights=weights, time_limit=time_limit)


def pcm_exact_in(
    graph: Bool[np.ndarray, "m m"],
    *,
    weights: Float[np.ndarray, " m"] | None = None,
    time_limit: float | None = None,
) -> Choice:
    """`pcm_exact` of a consistency graph, ties by index."""
    return _choice(maximum_clique(graph, weights=weights, time_limit=time_limit), weights)


def pcm_heuristic_in(
    graph: Bool[np.ndarray, "m m"],
    *,
    weights: Float[np.ndarray, " m"] | None = None,
    time_limit: float | None = None,
) -> Choice:
    """`pcm_heuristic` of a consistency graph."""
    clique = maximum_clique(graph, method="heuristic", weights=weights, time_limit=time_limit)
    return _choice(clique, weights)


def _choice(clique: Clique, weights: Any) -> Choice:
    weighed = (None, None) if weights is None else (clique.weight, clique.weight_bound)
    return Choice(clique.members, clique.optimal, clique.upper_bound, *weighed)


def pcm_exact_kernel(squared: Float[Array, "m m"], gate: Any) -> Bool[Array, " m"]:
    """The kernel of `pcm_exact`, m ≤ 128."""
    at_most(KERNEL_LIMIT, squared, "pcm-exact")
    return maximum_clique_batched(consistency_graph(squared, gate)).members


def pcm_heuristic_kernel(squared: Float[Array, "m m"], gate: Any) -> Bool[Array, " m"]:
    """The kernel of `pcm_heuristic`."""
    return _greedy(consistency_graph(squared, gate))


def _greedy(graph: Bool[Array, "m m"]) -> Bool[Array, " m"]:
    """From every start: always the candidate of largest degree, ties by index; the first best."""
    order = jnp.argsort(-graph.sum(axis=0), stable=True)
    ranked = graph[order][:, order]

    def visit(carry: tuple[Array, Array], vertex: tuple[Array, Array]) -> tuple[Any, None]:
        candidates, members = carry  # [start, vertex]
        index, near = vertex
        taken = candidates[:, index]
        candidates = candidates & (near | ~taken[:, None])
        return (candidates, members.at[:, index].max(taken)), None

    starts = jnp.eye(len(graph), dtype=bool)
    (_, members), _ = jax.lax.scan(visit, (ranked, starts), (jnp.arange(len(graph)), ranked))
    best = members[jnp.argmax(members.sum(axis=1))]
    return jnp.zeros_like(best).at[order].set(best)


METHODS = (
    SelectionMethod("pcm-exact", pcm_exact, pcm_exact_in, pcm_exact_kernel, None),
    SelectionMethod("pcm-heuristic", pcm_heuristic, pcm_heuristic_in, pcm_heuristic_kernel),
)
