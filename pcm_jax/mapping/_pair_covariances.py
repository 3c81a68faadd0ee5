"""Joint covariances of two poses, for many pairs of poses at once.

Of poses that edges join they are blocks of `H⁻¹` where its factor has some, all found in one pass
(`sparse.selected`); other pairs take the joint covariance of all poses of a few pairs at a time.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from jaxtyping import Float, Int

from pcm_jax.sparse.cholesky import CholeskyFactor
from pcm_jax.sparse.selected import Selected

MANY = 128
"""Pairs from which one pass over the whole factor takes less than their panels."""
PANEL = 64
"""Pairs whose poses' joint covariance is formed at once; of larger panels most is not used."""


class Covariances(Protocol):
    """The part of `MapCovariance` that is asked here."""

    def factor(self) -> CholeskyFactor:
        """The factor of H."""
        ...

    def joint(self, poses: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k*d k*d"]:
        """The joint covariance of some poses, each given once."""
        ...


def pair_covariances(
    of: Covariances, held: int, tail: Int[np.ndarray, " k"], head: Int[np.ndarray, " k"]
) -> Float[np.ndarray, "k 2*d 2*d"]:
    """Does the work of `MapCovariance.pairs`.

    Args:
        of: the map's covariance.
        held: the pose that is certain, or one that there is not.
        tail, head: checked indices, not the same two.
    """
    plan = of.factor().plan
    d, position = plan.block_dim, plan.position
    found = np.zeros((len(tail), 2, d, 2, d))
    close = plan.tree.together(position[tail], position[head]) | (tail == held) | (head == held)
    if close.sum() < MANY:
        close[:] = False
    else:
        found[close] = _selected(of.factor(), held, tail[close], head[close])
    rows = np.flatnonzero(~close)
    rows = rows[np.argsort(tail[rows], kind="stable")]
    for start in range(0, len(rows), PANEL):
        some = rows[start : start + PANEL]
        poses, at = np.unique(np.stack([tail[some], head[some]]), return_inverse=True)
        at = at.reshape(2, -1).T
        joint = of.joint(poses).reshape(len(poses), d, len(poses), d)
        found[some] = joint[at[:, :, None], :, at[:, None, :], :].transpose(0, 1, 3, 2, 4)
    return found.reshape(len(tail), 2 * d, 2 * d)


def _selected(
    factor: CholeskyFactor, held: int, tail: np.ndarray, head: np.ndarray
) -> Float[np.ndarray, "k 2 d 2 d"]:
    """Those of pairs that lie together in the factor, or with the pose that is held."""
    selected, d, ends = Selected(factor), factor.plan.block_dim, (tail, head)
    found = np.zeros((len(tail), 2, d, 2, d))
    for row, column in ((0, 0), (1, 1), (0, 1)):
        free = (ends[row] != held) & (ends[column] != held)
        blocks = selected.pairs(ends[row][free], ends[column][free])
        found[free, row, :, column] = blocks
        found[free, column, :, row] = blocks.swapaxes(1, 2)
    return found
