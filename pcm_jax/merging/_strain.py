"""The part of a merge that does not fit: where a chi-squared far above its expectation lies.

Each part of the merged graph, a robot's own edges or the accepted closures of a pair of robots, has
its share of Σ rᵀΩr at the merged poses, r = Log(z⁻¹ X_i⁻¹ X_j).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pcm_jax import lie
from pcm_jax.graph import MultiRobotGraph

TOO_BAD = 10.0
"""Normalised chi-squared above which the noise as stated cannot be meant."""


def strain(graph: MultiRobotGraph, normalized_chi2: float | None) -> str | None:
    """Says that a fit is far worse than noise as stated explains, and which part is the worst.

    Args:
        graph: merged maps and the closures that were used.
        normalized_chi2: of the merge.
    """
    if normalized_chi2 is None or normalized_chi2 <= TOO_BAD:
        return None
    shares = _shares(graph)
    worst = max(shares, key=lambda part: shares[part])
    percent = 100.0 * shares[worst] / sum(shares.values())
    return (
        f"the normalised chi-squared is {normalized_chi2:.3g}, where noise as stated gives 1:"
        f" {percent:.0f} % of it lies in {worst}"
    )


def _shares(graph: MultiRobotGraph) -> dict[str, float]:
    shares = {}
    for one in graph.maps:
        poses = lie.as_numpy(one.poses)
        tail, head = (lie.take(poses, np.asarray(end)) for end in (one.tail, one.head))
        shares[f"the edges of map {one.name!r}"] = _squared(tail, head, one)
    names = graph.names
    for a, b in graph.closures.pairs():
        closures, _ = graph.closures.between(a, b)
        tail, head = (
            lie.take(lie.as_numpy(graph.maps[robot].poses), np.asarray(poses))
            for robot, poses in ((a, closures.pose_a), (b, closures.pose_b))
        )
        part = f"the {len(closures)} closures between {names[a]!r} and {names[b]!r}"
        shares[part] = _squared(tail, head, closures)
    return shares


def _squared(tail: Any, head: Any, edges: Any) -> float:
    """Σ rᵀΩr of some edges."""
    measured = lie.as_numpy(edges.measurement)
    residual = np.asarray(lie.log(lie.compose(lie.inverse(measured), lie.between(tail, head))))
    return float(np.einsum("ki,kij,kj->", residual, np.asarray(edges.information), residual))
