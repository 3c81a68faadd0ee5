"""The fronts of a block Cholesky factorisation: the part that depends on the pattern alone.

The information matrix `H` of a pose graph has one `d x d` block per pose and per pair of poses
that an edge joins. Its factor is found front by front, leaves of a tree first (Duff and Reid 1983;
Liu, "The multifrontal method for sparse matrix solution: theory and practice", 1992):

    front = [ A  Bᵀ ]   A: the front's pivot poses              A = L Lᵀ,  X = B L⁻ᵀ
            [ B  C  ]   C: the later poses they are tied to     U = C − X Xᵀ  is added to the parent

This module finds the tree, on poses rather than scalars, on the host:

1. `_eliminate`: a minimum-degree order and the column structures of the factor, both from SuperLU
   on the pose-level pattern;
2. `_amalgamate`: columns of equal structure form one front, and small fronts are merged with their
   parents at the price of some explicit zeros (relaxed amalgamation, Ashcraft and Grimes 1989).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

GROUND = 1e-8
"""Excess of the diagonal in `_eliminate`, relative to unit weights."""


@dataclasses.dataclass(frozen=True, eq=False)
class FrontTree:
    """The fronts of a factorisation, children before parents.

    Poses are named by their `position` in the elimination order. Front `s` has the pivots
    `first[s], …, first[s] + pivots[s] − 1` and the rest `rest[rest_start[s]:rest_start[s + 1]]`,
    ascending, all of them later than its pivots.

    Attributes:
        position: `[n]` the position at which each pose is eliminated.
        first: `[s]` first pivot.
        pivots: `[s]` number of pivots.
        rest_start: `[s + 1]`.
        rest: `[Σ rest]` positions.
        parent: `[s]` the front that receives the update, -1 for a root.
        height: `[s]` 0 for leaves, else one more than the highest child.
        front_of: `[n]` the front in which each position is a pivot.
    """

    position: Int[np.ndarray, " n"]
    first: Int[np.ndarray, " s"]
    pivots: Int[np.ndarray, " s"]
    rest_start: Int[np.ndarray, " s1"]
    rest: Int[np.ndarray, " r"]
    parent: Int[np.ndarray, " s"]
    height: Int[np.ndarray, " s"]
    front_of: Int[np.ndarray, " n"]

    @property
    def size(self) -> int:
        """Number of poses."""
        return len(self.position)

    @property
    def rests(self) -> Int[np.ndarray, " s"]:
        """Number of poses in the rest of each front."""
        return np.diff(self.rest_start)

    @functools.cached_property
    def _rest_keys(self) -> Int[np.ndarray, " r"]:
        return np.repeat(np.arange(len(self.first)), self.rests) * self.size + self.rest

    def locate(
        self,
        front: Int[np.ndarray, " k"],
        position: Int[np.ndarray, " k"],
        pivots: Int[np.ndarray, " s"],
    ) -> Int[np.ndarray, " k"]:
        """Index of a position in a front that holds it: its pivots come first, then its rest.

        Args:
            front, position: each pair of them.
            pivots: of every front, the index at which its rest begins: its pivots, or more.
        """
        found = (
            np.searchsorted(self._rest_keys, front * self.size + position) - self.rest_start[front]
        )
        own = self.front_of[position] == front
        return np.where(own, position - self.first[front], pivots[front] + found)

    def together(self, one: Int[np.ndarray, " k"], other: Int[np.ndarray, " k"]) -> np.ndarray:
        """Marks the pairs of positions of which some front holds both: all that edges join."""
        low, high = np.minimum(one, other), np.maximum(one, other)
        front = self.front_of[low]
        keys = front * self.size + high
        at = np.minimum(np.searchsorted(self._rest_keys, keys), len(self.rest) - 1)
        in_rest = self._rest_keys[at] == keys if len(self.rest) else False
        return (self.front_of[high] == front) | in_rest


class _Columns(NamedTuple):
    """Structure of the factor: column `j` holds rows `rows[start[j]:start[j + 1]]`, `j` first."""

    start: Int[np.ndarray, " n1"]
    rows: Int[np.ndarray, " nnz"]


def front_tree(
    size: int,
    tail: Int[np.ndarray, " e"],
    head: Int[np.ndarray, " e"],
) -> FrontTree:
    """Orders the poses and finds the fronts.

    Args:
        size: number of poses, at least 1.
        tail, head: the pairs of poses with a block; repeats and either order are allowed.
    """
    position, columns = _eliminate(size, tail, head)
    first, members = _amalgamate(columns)
    return _renumber(position, columns, first, members)


def _eliminate(size: int, tail: np.ndarray, head: np.ndarray) -> tuple[np.ndarray, _Columns]:
    """SuperLU's minimum-degree order, and its factor of a Laplacian with a trace of ground.

    Every entry of an M-matrix's factor that is structurally nonzero is a positive conductance that
    shrinks only like resistors in series, so none cancels or underflows and SciPy drops none.
    """
    from scipy.sparse import csc_array, diags_array
    from scipy.sparse.linalg import splu

    tail, head = tail[tail != head], head[tail != head]
    ends = (np.concatenate([tail, head]), np.concatenate([head, tail]))
    pattern = csc_array((np.ones(2 * len(tail)), ends), shape=(size, size))
    pattern.data[:] = -1.0
    degree = np.asarray(pattern.sum(axis=0)).ravel()
    laplacian = (pattern + diags_array(GROUND - degree)).tocsc()
    symmetric = {"SymmetricMode": True}
    factor = splu(laplacian, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
    lower = factor.L.tocsc()
    lower.sort_indices()
    columns = _Columns(lower.indptr.astype(np.int64), lower.indices.astype(np.int64))
    return np.asarray(factor.perm_c, np.int64), columns


def _worth_merging(pivots: int, total: int, zeros: int) -> bool:
    """True if a merged front with so many pivots may hold `zeros` explicit zeros among `total`."""
    if pivots <= 4:
        return True
    return zeros < total * (0.5 if pivots <= 8 else 0.25 if pivots <= 16 else 0.1)


def _amalgamate(columns: _Columns) -> tuple[np.ndarray, list[list[int]]]:
    """Fundamental supernodes, then their merging; see `_renumber` for the result's use.

    Returns:
        first: first column of each fundamental supernode, and `n` at the end.
        members: for each merged front, children before parents, its fundamental supernodes in
            elimination order; the last is the topmost.
    """
    size = len(columns.start) - 1
    count = np.diff(columns.start)
    parent = np.full(size, -1)
    inner = count > 1
    parent[inner] = columns.rows[columns.start[:-1][inner] + 1]
    starts = np.ones(size, bool)
    starts[1:] = (parent[:-1] != np.arange(1, size)) | (count[:-1] != count[1:] + 1)
    first = np.append(np.flatnonzero(starts), size)
    top = first[1:] - 1
    above = np.where(parent[top] >= 0, (np.cumsum(starts) - 1)[parent[top]], -1).tolist()
    pivots, rest = np.diff(first).tolist(), (count[top] - 1).tolist()

    nodes = len(above)
    zeros = [0] * nodes
    members = [[node] for node in range(nodes)]
    children: list[list[int]] = [[] for _ in range(nodes)]
    roots = []
    for node in range(nodes):
        kept = []
        for child in sorted(children[node], key=rest.__getitem__, reverse=True):
            merged = pivots[child] + pivots[node]
            empty = pivots[child] * (pivots[node] + rest[node] - rest[child])
            empty += zeros[child] + zeros[node]
            if _worth_merging(merged, merged * (merged + 1) // 2 + merged * rest[node], empty):
                pivots[node], zeros[node] = merged, empty
                members[node] = members[child] + members[node]
                kept += children[child]
            else:
                kept.append(child)
        children[node] = kept
        (children[above[node]] if above[node] >= 0 else roots).append(node)

    postorder, stack = [], roots
    while stack:
        postorder.append(stack.pop())
        stack += children[postorder[-1]]
    return first, [members[node] for node in reversed(postorder)]


def _renumber(
    position: np.ndarray, columns: _Columns, first: np.ndarray, members: list[list[int]]
) -> FrontTree:
    """The tree in an elimination order that follows the merged fronts."""
    supernode = np.array([node for nodes in members for node in nodes])
    widths = np.diff(first)[supernode]
    old = ragged_arange(first[supernode], widths)
    size = len(position)
    new = np.empty(size, np.int64)
    new[old] = np.arange(size)
    owner = np.repeat(np.arange(len(members)), [len(nodes) for nodes in members])
    front_of = np.repeat(owner, widths)
    pivots = np.bincount(front_of, minlength=len(members))

    top = first[np.array([nodes[-1] for nodes in members]) + 1] - 1
    rests = np.diff(columns.start)[top] - 1
    rest_start = np.concatenate([[0], np.cumsum(rests)])
    rest = new[columns.rows[ragged_arange(columns.start[top] + 1, rests)]]
    rest_owner = np.repeat(np.arange(len(members)), rests)
    rest = rest[np.lexsort((rest, rest_owner))]
    parent = np.full(len(members), -1)
    parent[rests > 0] = front_of[rest[rest_start[:-1][rests > 0]]]
    height = np.zeros(len(members), np.int64)
    for front, above in enumerate(parent.tolist()):
        if above >= 0:
            height[above] = max(height[above], height[front] + 1)
    first_pivot = np.concatenate([[0], np.cumsum(pivots)[:-1]])
    return FrontTree(new[position], first_pivot, pivots, rest_start, rest, parent, height, front_of)


def ragged_arange(start: Int[np.ndarray, " k"], length: Int[np.ndarray, " k"]) -> np.ndarray:
    """The ranges `start[i], …, start[i] + length[i] − 1`, one after another."""
    before = np.cumsum(length) - length
    return np.repeat(start - before, length) + np.arange(length.sum())
