"""CLIPPER's spectral relaxation: a dense clique of the consistency graph, by gradient ascent.

P. C. Lusk, K. Fathian and J. P. How, "CLIPPER: A graph-theoretic framework for robust data
association", ICRA 2021. With affinities M (Gaussian in q, zero where the gate fails, diagonal 1)
and the indicator C̄ of pairs that are not consistent,

    maximise  uᵀ (M − d C̄) u   over  u ≥ 0, |u| = 1,

by projected gradient ascent with backtracking, for a penalty d that grows until no inconsistent
pair has both entries positive: the support of u is then a clique. Needs m² squared distances and a
gate, no random numbers: where the authors start from a random u, this starts from M's leading
eigenvector. The support is checked to be a clique, entry by entry from the largest.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from pcm_jax.selection._distances import consistent_pairs, symmetrised
from pcm_jax.selection.method import Choice, SelectionMethod

MOST_PENALTIES = 100
MOST_STEPS = 1_000
SHORTEST_STEP = 1e-12
TOLERANCE = 1e-10
SUPPORT = 1e-6
"""Entries of u above this, relative to the largest, belong to the set."""


def clipper(squared: Float[np.ndarray, "m m"], gate: float) -> Choice:
    """The clique on which the relaxation settles; a local optimum, so it need not be the largest.

    Args:
        squared: squared distances q²; the larger of a pair's two counts.
        gate: γ².
    """
    if len(squared) == 0:
        return Choice(np.zeros(0, bool))
    edges = consistent_pairs(squared, gate)
    distances = np.where(edges, symmetrised(squared), np.inf)
    affinity = np.exp(-0.5 * distances) + np.eye(len(edges))
    strangers = ~edges & ~np.eye(len(edges), dtype=bool)
    return Choice(_clique_in(_relaxed(affinity, strangers.astype(float)), edges))


def _relaxed(affinity: Float[np.ndarray, "m m"], strangers: Float[np.ndarray, "m m"]) -> np.ndarray:
    """The vector u at the end of the growing penalties."""
    u = np.abs(np.linalg.eigh(affinity)[1][:, -1])
    penalty = 0.0
    for _ in range(MOST_PENALTIES):
        u = _ascend(affinity - penalty * strangers, u)
        held = u > SUPPORT * u.max()
        against = strangers @ np.where(held, u, 0.0)
        contested = held & (against > 0.0)
        if not contested.any():
            break
        # The mean penalty at which a contested entry's slope turns negative.
        penalty += float(np.mean((affinity @ u)[contested] / against[contested]))
    return u


def _ascend(matrix: Float[np.ndarray, "m m"], u: np.ndarray) -> np.ndarray:
    """Projected gradient ascent of uᵀ matrix u on the sphere's part without negative entries."""
    image = matrix @ u
    value = float(u @ image)
    for _ in range(MOST_STEPS):
        step = 1.0
        while step > SHORTEST_STEP:
            moved = np.maximum(u + step * image, 0.0)
            length = np.linalg.norm(moved)
            if length > 0.0:
                moved /= length
                image_moved = matrix @ moved
                value_moved = float(moved @ image_moved)
                if value_moved > value:
                    break
            step *= 0.5
        else:
            return u
        settled = value_moved - value <= TOLERANCE * abs(value)
        u, image, value = moved, image_moved, value_moved
        if settled:
            return u
    return u


def _clique_in(u: np.ndarray, edges: Bool[np.ndarray, "m m"]) -> Bool[np.ndarray, " m"]:
    """The support of u, less whatever disagrees with a larger entry."""
    members = np.zeros(len(u), bool)
    for index in np.argsort(-u, kind="stable"):
        if u[index] > SUPPORT * u.max() and edges[index][members].all():
            members[index] = True
    return members


METHODS = (SelectionMethod("clipper", clipper),)
