"""A block of `H⁻¹` from the factor of `H`: the joint covariance of some poses.

With `H = L Lᵀ` and the unit columns `E` of the poses, the block is `Eᵀ H⁻¹ E = Wᵀ W`, `W = L⁻¹ E`:
forward substitution alone. The columns of `W` are sparse. A pose's column is nonzero only in the
fronts on its way from the front that eliminates it to the root; in elimination order the poses
below a front are consecutive, so each front multiplies one dense slice:

    [ W_s ]   [ L⁻¹            ] [ right-hand sides of the front's poses, ]
    [ U_s ] = [ −X L⁻¹     I   ] [ its own and its children's U           ]      block += W_sᵀ W_s

Work is Σ pivots · (poses of interest below)², far below both the whole inverse and `H⁻¹ E`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pcm_jax.mapping.cholesky import CholeskyFactor, blas_threads, limited_to
from pcm_jax.mapping.symbolic import FrontTree

LARGE_COLUMNS = 1536
"""Columns (scalars) from which BLAS threads gain even where other work holds some cores."""


class _Passed(NamedTuple):
    """A child's U: the poses of its rest against the columns from `first_column` on."""

    child: int
    first_column: int
    update: Float[np.ndarray, "r*d columns*d"]


def inverse_block(
    factor: CholeskyFactor, poses: Int[np.ndarray, " k"]
) -> Float[np.ndarray, "k*d k*d"]:
    """Rows and columns of `H⁻¹` that belong to `poses`, in their order, each given once."""
    plan, tree, d = factor.plan, factor.plan.tree, factor.plan.block_dim
    by_position = np.argsort(plan.position[poses])
    wanted = plan.position[poses][by_position]
    low = np.searchsorted(wanted, _subtree_starts(tree))
    middle = np.searchsorted(wanted, tree.first)
    high = np.searchsorted(wanted, tree.first + tree.pivots)
    total = np.zeros((len(poses) * d, len(poses) * d))
    passed: list[list[_Passed]] = [[] for _ in tree.first]
    threads = blas_threads()
    for front in np.flatnonzero(high > low).tolist():
        right = _gathered(tree, front, passed[front], (low[front], high[front]), d)
        passed[front].clear()
        own = np.arange(middle[front], high[front])
        rows = (wanted[own] - tree.first[front])[:, None] * d + np.arange(d)
        columns = (own - low[front])[:, None] * d + np.arange(d)
        right[rows.ravel(), columns.ravel()] = 1.0
        with limited_to(threads if right.shape[1] > LARGE_COLUMNS else 1):
            solved, update = _eliminate(factor, front, right)
            part = slice(low[front] * d, high[front] * d)
            total[part, part] += solved.T @ solved
        if tree.parent[front] >= 0:
            passed[tree.parent[front]].append(_Passed(front, low[front], update))
    given = np.empty(len(poses), np.int64)
    given[by_position] = np.arange(len(poses))
    blocks = total.reshape(len(poses), d, len(poses), d)
    return blocks[given][:, :, given].reshape(total.shape)


def _subtree_starts(tree: FrontTree) -> Int[np.ndarray, " s"]:
    """First position of each front's subtree; it ends with the front's own pivots."""
    start = tree.first.copy()
    for front, parent in enumerate(tree.parent.tolist()):
        if parent >= 0:
            start[parent] = min(start[parent], start[front])
    return start


def _gathered(
    tree: FrontTree, front: int, passed: list[_Passed], columns: tuple[int, int], d: int
) -> Float[np.ndarray, "(p+r)*d columns*d"]:
    """Right-hand sides at a front's poses: what its children pass on."""
    pivots, rests = tree.pivots[front], tree.rests[front]
    low, high = columns
    right = np.zeros((pivots + rests, d, (high - low) * d))
    for child, first_column, update in passed:
        positions = tree.rest[tree.rest_start[child] : tree.rest_start[child + 1]]
        local = tree.locate(np.full(len(positions), front), positions)
        rows = np.where(tree.front_of[positions] == front, local, pivots + local)
        start = (first_column - low) * d
        right[rows, :, start : start + update.shape[1]] += update.reshape(len(rows), d, -1)
    return right.reshape((pivots + rests) * d, -1)


def _eliminate(
    factor: CholeskyFactor, front: int, right: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """W and U of one front."""
    plan, tree, d = factor.plan, factor.plan.tree, factor.plan.block_dim
    group, slot = plan.group_of[front], plan.slot_of[front]
    pivots, rests = tree.pivots[front] * d, tree.rests[front] * d
    solved = factor.inverse_pivots[group][slot, :pivots, :pivots] @ right[:pivots]
    coupling = factor.couplings[group][slot, :rests, :pivots]
    return solved, right[pivots:] - coupling @ solved
