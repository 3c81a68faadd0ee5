"""Pairwise consistent measurement set maximization: the largest set in which all agree.

J. G. Mangelson, D. Dominic, R. M. Eustice and R. Vasudevan, ICRA 2018, sections IV and V: a
maximum clique of the consistency graph. Needs m² squared distances and a gate, or that graph alone.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from pcm_jax.clique import Clique, maximum_clique
from pcm_jax.errors import InputError
from pcm_jax.selection._distances import consistent_pairs
from pcm_jax.selection.choice import Choice

TIE_BREAKS = ("index", "distance")


def pcm_exact(
    squared: Float[np.ndarray, "m m"],
    gate: float,
    *,
    time_limit: float | None = None,
    tie_break: str = "index",
) -> Choice:
    """The largest pairwise consistent set, proven.

    Args:
        squared: squared distances, not symmetrised: both directions must pass.
        gate: γ².
        time_limit: seconds, see `maximum_clique`.
        tie_break: which of several largest sets: `"index"`, or `"distance"` (the least total
            squared distance, then index).
    """
    if tie_break not in TIE_BREAKS:
        raise InputError(f"tie_break: {tie_break!r}, expected one of {', '.join(TIE_BREAKS)}")
    graph = consistent_pairs(squared, gate)
    distances = np.where(graph, squared, 0.0) if tie_break == "distance" else None
    return _choice(maximum_clique(graph, time_limit=time_limit, tie_break=distances))


def pcm_heuristic(
    squared: Float[np.ndarray, "m m"], gate: float, *, time_limit: float | None = None
) -> Choice:
    """A large pairwise consistent set, greedily (HeuPatt, the paper's choice for large m)."""
    return pcm_heuristic_in(consistent_pairs(squared, gate), time_limit=time_limit)


def pcm_exact_in(graph: Bool[np.ndarray, "m m"], *, time_limit: float | None = None) -> Choice:
    """`pcm_exact` of a consistency graph, ties by index."""
    return _choice(maximum_clique(graph, time_limit=time_limit))


def pcm_heuristic_in(graph: Bool[np.ndarray, "m m"], *, time_limit: float | None = None) -> Choice:
    """`pcm_heuristic` of a consistency graph."""
    return _choice(maximum_clique(graph, method="heuristic", time_limit=time_limit))


def _choice(clique: Clique) -> Choice:
    return Choice(clique.members, clique.optimal, clique.upper_bound)
