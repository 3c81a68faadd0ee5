"""The plan of the numeric part: where each block of `H` and of the update matrices is added.

Fronts of equal height and equal padded shape form a group, and the numeric part treats a group as
one batched array operation; the few large fronts form groups of their own. All numbers to be
summed lie in one pool, cut into chunks of `d` scalars (a row of a `d x d` block):

    [ identity block | blocks of H | update matrices U of each group ]

The stacked fronts of a group are then one sparse 0/1 matrix times the pool. Only blocks on and
below the diagonal are summed, which is all that a Cholesky factorisation reads. An update matrix is
needed until the parents of its group are summed; its place then serves other groups.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from pcm_jax.sparse import registry
from pcm_jax.sparse._symbolic import FrontTree, front_tree, ragged_arange

PADDED_PIVOTS = np.array([1, 2, 3, 4, 6, 8, 12, 16])
PADDED_RESTS = np.array([0, 1, 2, 3, 4, 6, 8, 12, 16, 20, 24])
SCALARS_AT_ONCE = 1 << 18
"""All fronts of a group, unless one is larger: as much as a processor's cache holds."""


class FrontGroup(NamedTuple):
    """Fronts of one height and one padded shape; lengths in scalars.

    Attributes:
        count: number of fronts, `b`.
        pivots: pivots of each, `p`.
        rest: rest of each, `r`.
        gather: `[b·(p + r)·(p + r)/d, pool]` 0/1 matrix that sums the fronts, as chunks.
        pivot_rows: `[b, p]` elimination rows; padded entries name the row after the last.
        rest_rows: `[b, r]` likewise.
        update: first chunk of the group's update matrices in the pool.
    """

    count: int
    pivots: int
    rest: int
    gather: Any
    pivot_rows: Int[np.ndarray, "b p"]
    rest_rows: Int[np.ndarray, "b r"]
    update: int


@dataclasses.dataclass(frozen=True, eq=False)
class CholeskyPlan:
    """Everything about a factorisation that does not depend on the numbers.

    Attributes:
        tree: the fronts.
        block_dim: scalars per pose, `d`.
        block_row, block_column: `[k]` positions of the blocks of `H`, row ≥ column; the first `n`
            are the diagonal.
        edge_block: `[e]` the block of each given pair.
        edge_transposed: `[e]` whether that block is (tail, head) rather than (head, tail).
        groups: in the order of factorisation.
        group_of, slot_of: `[s]` where the numeric part keeps each front.
        chunks: length of the pool.
    """

    tree: FrontTree
    block_dim: int
    block_row: Int[np.ndarray, " k"]
    block_column: Int[np.ndarray, " k"]
    edge_block: Int[np.ndarray, " e"]
    edge_transposed: np.ndarray
    groups: tuple[FrontGroup, ...]
    group_of: Int[np.ndarray, " s"]
    slot_of: Int[np.ndarray, " s"]
    chunks: int

    @property
    def size(self) -> int:
        """Number of poses, n."""
        return self.tree.size

    @property
    def scalars(self) -> int:
        """Scalars of the pool and of the factor."""
        factor = sum(
            group.count * (group.pivots + group.rest) * group.pivots for group in self.groups
        )
        return self.chunks * self.block_dim + factor

    @property
    def position(self) -> Int[np.ndarray, " n"]:
        """Elimination position of each pose."""
        return self.tree.position


def plan_for(
    size: int,
    tail: Int[np.ndarray, " e"],
    head: Int[np.ndarray, " e"],
    block_dim: int,
) -> CholeskyPlan:
    """The plan for a pattern, made once and then found by content.

    Args:
        size: number of poses.
        tail, head: poses that each edge joins.
        block_dim: scalars per pose.
    """
    tail, head = np.asarray(tail, np.int64), np.asarray(head, np.int64)

    def make_tree() -> FrontTree:
        return front_tree(size, tail, head)

    def make_plan() -> CholeskyPlan:
        return _make_plan(registry.trees.get(make_tree, size, tail, head), tail, head, block_dim)

    return registry.plans.get(make_plan, size, block_dim, tail, head)


class _Shapes(NamedTuple):
    """Fronts sorted into groups; lengths in poses."""

    pivots: np.ndarray  # [s] padded
    rests: np.ndarray  # [s] padded
    group: np.ndarray  # [s]
    slot: np.ndarray  # [s] index within the group
    members: list[np.ndarray]  # fronts of each group
    update: np.ndarray  # [s] first block of the front's update matrix, counted from the first one
    update_blocks: int  # that the update matrices take at most at one time


def _padded(length: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    found = np.searchsorted(sizes, length)
    return np.where(found < len(sizes), sizes[np.minimum(found, len(sizes) - 1)], length)


def _group(tree: FrontTree, d: int) -> _Shapes:
    pivots, rests = _padded(tree.pivots, PADDED_PIVOTS), _padded(tree.rests, PADDED_RESTS)
    _, alike, count = _labelled(tree.height, pivots, rests)
    slot = np.empty(len(alike), np.int64)
    slot[np.argsort(alike, kind="stable")] = ragged_arange(np.zeros_like(count), count)
    at_once = np.maximum(SCALARS_AT_ONCE // ((pivots + rests) * d) ** 2, 1)
    _, group, count = _labelled(alike, slot // at_once)
    slot %= at_once
    members = np.split(np.argsort(group, kind="stable"), np.cumsum(count)[:-1])
    blocks = rests**2
    size = np.bincount(group, blocks).astype(np.int64)
    needed_by = np.zeros(len(size), np.int64)
    np.maximum.at(needed_by, group, np.where(tree.parent >= 0, group[tree.parent], 0))
    start = _places(size, needed_by)
    update = start[group] + slot * blocks
    return _Shapes(pivots, rests, group, slot, members, update, int((start + size).max()))


def _labelled(*keys: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distinct rows of the keys, which of them each row is, and how often they occur."""
    return np.unique(np.stack(keys), axis=1, return_inverse=True, return_counts=True)


def _places(size: np.ndarray, needed_by: np.ndarray) -> np.ndarray:
    """Places for the update matrices of groups: each in the first gap that is large enough.

    Args:
        size: `[g]` of each group.
        needed_by: `[g]` the last group that reads them, before its own are written.
    """
    start = np.zeros_like(size)
    taken: list[tuple[int, int, int]] = []  # start, end, needed by; ascending
    for group, (length, last) in enumerate(zip(size.tolist(), needed_by.tolist(), strict=True)):
        taken = [place for place in taken if place[2] > group]
        free = 0
        for begin, end, _ in taken:
            if begin - free >= length:
                break
            free = end
        start[group] = free
        if length:
            taken = sorted([*taken, (free, free + length, last)])
    return start


class _Terms(NamedTuple):
    """Blocks to be summed: into block (row, column) of a front, from `source` with a row stride."""

    front: np.ndarray
    row: np.ndarray
    column: np.ndarray
    source: np.ndarray  # chunk of the block's first row
    stride: np.ndarray  # chunks between its rows


def _make_plan(tree: FrontTree, tail: np.ndarray, head: np.ndarray, d: int) -> CholeskyPlan:
    size, shapes = tree.size, _group(tree, d)
    low = np.minimum(tree.position[tail], tree.position[head])
    high = np.maximum(tree.position[tail], tree.position[head])
    pairs, edge_pair = np.unique(np.where(low == high, -1, low * size + high), return_inverse=True)
    has_loop = len(pairs) > 0 and pairs[0] < 0
    pairs, edge_pair = pairs[int(has_loop) :], edge_pair - int(has_loop)
    column = np.concatenate([np.arange(size), pairs // size])
    row = np.concatenate([np.arange(size), pairs % size])
    first_update = (1 + len(row)) * d
    terms = _sorted(
        shapes,
        _terms_of_matrix(tree, shapes, row, column, d),
        _terms_of_padding(tree, shapes),
        _terms_of_updates(tree, shapes, first_update, d),
    )
    chunks = first_update + shapes.update_blocks * d
    bounds = np.searchsorted(shapes.group[terms.front], np.arange(len(shapes.members) + 1))
    groups = tuple(
        _front_group(
            tree,
            shapes,
            fronts,
            _Terms(*(part[bounds[g] : bounds[g + 1]] for part in terms)),
            (first_update + int(shapes.update[fronts[0]]) * d, chunks, d),
        )
        for g, fronts in enumerate(shapes.members)
    )
    return CholeskyPlan(
        tree=tree,
        block_dim=d,
        block_row=row,
        block_column=column,
        edge_block=np.where(low == high, tree.position[tail], edge_pair + size),
        edge_transposed=tree.position[tail] > tree.position[head],
        groups=groups,
        group_of=shapes.group,
        slot_of=shapes.slot,
        chunks=chunks,
    )


def _terms_of_matrix(
    tree: FrontTree, shapes: _Shapes, row: np.ndarray, column: np.ndarray, d: int
) -> _Terms:
    front = tree.front_of[column]
    local = tree.locate(front, row, shapes.pivots)
    source = (1 + np.arange(len(row))) * d
    return _Terms(front, local, column - tree.first[front], source, np.ones_like(source))


def _terms_of_padding(tree: FrontTree, shapes: _Shapes) -> _Terms:
    """An identity block for every pivot that only fills a front up."""
    missing = shapes.pivots - tree.pivots
    front = np.repeat(np.arange(len(missing)), missing)
    index = ragged_arange(tree.pivots, missing)
    return _Terms(front, index, index, np.zeros_like(front), np.ones_like(front))


def _terms_of_updates(tree: FrontTree, shapes: _Shapes, first_update: int, d: int) -> _Terms:
    """Each child's update matrix, lower triangle of blocks, into its parent's front."""
    owner = np.repeat(np.arange(len(tree.first)), tree.rests)
    above = tree.parent[owner]
    local = tree.locate(above, tree.rest, shapes.pivots)
    # Entry k of the rest is paired with itself and every earlier entry of the same rest.
    before = np.arange(len(owner)) - tree.rest_start[owner]
    row = np.repeat(np.arange(len(owner)), before + 1)
    column = ragged_arange(tree.rest_start[owner], before + 1)
    child = owner[row]
    width = shapes.rests[child]
    source = first_update + shapes.update[child] * d
    source += before[row] * d * width + before[column]
    return _Terms(above[row], local[row], local[column], source, width)


def _sorted(shapes: _Shapes, *parts: _Terms) -> _Terms:
    """All terms, by group, front, row and column."""
    terms = _Terms(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    start = np.cumsum([0, *map(len, shapes.members)])
    rank = start[shapes.group] + shapes.slot
    width = int((shapes.pivots + shapes.rests).max())
    key = (rank[terms.front] * width + terms.row) * width + terms.column
    order = np.argsort(key, kind="stable")
    return _Terms(*(part[order] for part in terms))


def _front_group(
    tree: FrontTree,
    shapes: _Shapes,
    fronts: np.ndarray,
    terms: _Terms,
    place: tuple[int, int, int],
) -> FrontGroup:
    update, chunks, d = place
    pivots, rests = int(shapes.pivots[fronts[0]]), int(shapes.rests[fronts[0]])
    pivot_rows = _padded_rows(tree.first[fronts], tree.pivots[fronts], pivots, tree.size)
    rest_index = _padded_rows(tree.rest_start[fronts], tree.rests[fronts], rests, len(tree.rest))
    rest_rows = np.append(tree.rest, tree.size)[rest_index]
    scalar = np.arange(d)
    return FrontGroup(
        count=len(fronts),
        pivots=pivots * d,
        rest=rests * d,
        gather=_gather(shapes, terms, len(fronts), pivots + rests, chunks, d),
        pivot_rows=(pivot_rows[:, :, None] * d + scalar).reshape(len(fronts), -1),
        rest_rows=(rest_rows[:, :, None] * d + scalar).reshape(len(fronts), -1),
        update=update,
    )


def _padded_rows(start: np.ndarray, length: np.ndarray, width: int, filler: int) -> np.ndarray:
    index = np.arange(width)
    return np.where(index < length[:, None], start[:, None] + index, filler)


def _gather(shapes: _Shapes, terms: _Terms, count: int, width: int, chunks: int, d: int) -> Any:
    """The 0/1 matrix whose product with the pool is the group's fronts, chunk by chunk.

    Chunk ((front, row, q), column) is row q of block (front, row, column): the terms, sorted by
    (front, row, column), repeat for every q.
    """
    from scipy.sparse import csr_array

    block_row = shapes.slot[terms.front] * width + terms.row
    rows = count * width
    per_chunk = np.bincount(block_row * width + terms.column, minlength=rows * width)
    per_chunk = per_chunk.reshape(rows, 1, width)
    start = np.zeros(rows * d * width + 1, np.int32)
    np.cumsum(np.broadcast_to(per_chunk, (rows, d, width)), out=start[1:])
    in_row = per_chunk.sum(axis=(1, 2))
    before = np.cumsum(in_row) - in_row
    scalar = np.arange(d)
    index = (np.arange(len(block_row)) + (d - 1) * before[block_row])[:, None]
    index = index + scalar * in_row[block_row][:, None]
    source = np.empty(len(block_row) * d, np.int32)
    source[index] = terms.source[:, None] + scalar * terms.stride[:, None]
    return csr_array((_ones(len(source)), source, start), shape=(rows * d * width, chunks))


def _ones(count: int) -> np.ndarray:
    """Ones, in memory that the gathers of all plans share: twice the largest at most."""
    return _ones_of(count.bit_length())[:count]


@functools.lru_cache(maxsize=64)
def _ones_of(bits: int) -> np.ndarray:
    return np.ones(1 << bits)
