"""The blocks of `H⁻¹` that lie where the factor of `H` has blocks, all in one pass.

They are the covariances of all unknowns, and of all pairs that an edge joins: what residuals are
tested by. With the factor's fronts (`_symbolic`), from the root down, a front's part of the inverse
follows from that of its parent, which holds all unknowns of its rest:

    Z_pr = −L⁻ᵀ Xᵀ Z_rr        Z_pp = L⁻ᵀ L⁻¹ − Z_pr X L⁻¹

(Takahashi, Fagan and Chin 1973; Erisman and Tinney 1975; by fronts: Campbell and Davis 1995). The
work is about that of the factorisation, whatever number of blocks is asked for. Fronts of a group
are one batch, as there; a group is stored with its padding, in blocks `d x d`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pcm_jax.sparse import registry
from pcm_jax.sparse.assembly import CholeskyPlan
from pcm_jax.sparse.cholesky import CholeskyFactor


class Selected:
    """The parts of `H⁻¹` at the fronts of its factor.

    Args:
        factor: of `H`.
    """

    def __init__(self, factor: CholeskyFactor) -> None:
        self._plan = factor.plan
        self._layout = _laid_out(factor.plan)
        with registry.blas.one():
            self._blocks = _filled(factor, self._layout)

    def pairs(
        self, first: Int[np.ndarray, " k"], second: Int[np.ndarray, " k"]
    ) -> Float[np.ndarray, "k d d"]:
        """Blocks (first, second) of `H⁻¹`.

        Args:
            first, second: unknowns, each two in one front (`FrontTree.together`).
        """
        tree, position = self._plan.tree, self._plan.position
        row, column = position[first], position[second]
        low, high = np.minimum(row, column), np.maximum(row, column)
        front = tree.front_of[low]
        local = tree.locate(front, high, self._layout.pivots)
        own, width = low - tree.first[front], self._layout.width[front]
        found = np.where(row <= column, own * width + local, local * width + own)
        return self._blocks[self._layout.start[front] + found]


class _Layout(NamedTuple):
    """Places of the fronts' parts of the inverse; lengths in unknowns, padded.

    Attributes:
        pivots, width: `[s]` of each front: its pivots, and all of its unknowns.
        start: `[s]` its first block among all.
        blocks: how many there are.
        members: the fronts of each group, in their slots.
    """

    pivots: Int[np.ndarray, " s"]
    width: Int[np.ndarray, " s"]
    start: Int[np.ndarray, " s"]
    blocks: int
    members: list[Int[np.ndarray, " b"]]


def _laid_out(plan: CholeskyPlan) -> _Layout:
    d = plan.block_dim
    of_group = np.array([(group.pivots, group.pivots + group.rest) for group in plan.groups]) // d
    pivots, width = of_group[plan.group_of].T
    by_place = np.lexsort((plan.slot_of, plan.group_of))
    size = width[by_place] ** 2
    start = np.empty(len(width), np.int64)
    start[by_place] = np.cumsum(size) - size
    counts = np.cumsum([group.count for group in plan.groups])[:-1]
    return _Layout(pivots, width, start, int(size.sum()), np.split(by_place, counts))


def _filled(factor: CholeskyFactor, layout: _Layout) -> Float[np.ndarray, "blocks d d"]:
    """All parts, from the root down; behind them a block of zeros, for padding."""
    plan, d = factor.plan, factor.plan.block_dim
    blocks = np.zeros((layout.blocks + 1, d, d))
    groups = zip(layout.members, factor.fronts(), factor.back, strict=True)
    for fronts, (group, inverse, _), back in reversed(list(groups)):
        count, pivots, width = group.count, group.pivots, group.pivots + group.rest
        part = np.empty((count, width, width))
        np.matmul(inverse.transpose(0, 2, 1), inverse, out=part[:, :pivots, :pivots])
        if group.rest:
            above = blocks[_places(plan, layout, fronts, group.rest // d)]
            rest = part[:, pivots:, pivots:]
            rest[...] = above.transpose(0, 1, 3, 2, 4).reshape(rest.shape)
            across = part[:, :pivots, pivots:]
            np.matmul(back, rest, out=across)
            part[:, :pivots, :pivots] += across @ back.transpose(0, 2, 1)
            np.negative(across, out=across)
            part[:, pivots:, :pivots] = across.transpose(0, 2, 1)
        first, w = layout.start[fronts[0]], width // d
        stored = part.reshape(count, w, d, w, d).transpose(0, 1, 3, 2, 4)
        blocks[first : first + count * w * w] = stored.reshape(-1, d, d)
    return blocks


def _places(
    plan: CholeskyPlan, layout: _Layout, fronts: Int[np.ndarray, " b"], rests: int
) -> Int[np.ndarray, "b r r"]:
    """The blocks of each front's rest in its parent's part; padding's is the last of all."""
    tree = plan.tree
    length = tree.rests[fronts]
    index = tree.rest_start[fronts][:, None] + np.arange(rests)
    given = np.arange(rests) < length[:, None]
    parent = np.broadcast_to(tree.parent[fronts][:, None], index.shape)[given]
    at = np.zeros(index.shape, np.int64)
    at[given] = tree.locate(parent, tree.rest[index[given]], layout.pivots)
    above = tree.parent[fronts]
    start, width = layout.start[above], layout.width[above]
    places = start[:, None, None] + at[:, :, None] * width[:, None, None] + at[:, None, :]
    return np.where(given[:, :, None] & given[:, None, :], places, layout.blocks)
