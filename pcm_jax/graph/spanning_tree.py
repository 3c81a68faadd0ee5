"""Spanning trees of a pose graph, and poses composed along them. Host, NumPy.

The poses are composed by pointer jumping: every pose starts as (its parent, its pose seen from
that parent); a round replaces each parent by the parent's parent and composes the two transforms.
After log2(depth) vectorised rounds every pose is seen from the root.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph import symbols

PREFERENCES = ("shortest", "odometry")


def spanning_tree_poses(
    tail: Any,
    head: Any,
    measurement: Any,
    n: int,
    *,
    root: int = 0,
    root_pose: Any = None,
    prefer: str = "shortest",
    ids: Int[np.ndarray, " n"] | None = None,
) -> Any:
    """Poses composed from measurements along a spanning tree.

    Args:
        tail: int `[e]`.
        head: int `[e]`.
        measurement: Lie `[e]`, the head's pose seen from the tail.
        n: number of poses.
        root: index of the pose to start from.
        root_pose: its pose, batch shape `[]`; the identity by default.
        prefer: "shortest": fewest edges from the root (breadth first). "odometry": the tree of
            edges whose indices lie closest together, which is the odometry chain where there is
            one: for graphs whose other edges are in doubt.
        ids: names of the poses in messages; their indices by default.

    Returns:
        The poses, NumPy-backed Lie `[n]`.

    Raises:
        InputError: for a graph that is not connected, naming a pose that is out of reach.
    """
    tail, head = np.asarray(tail, np.int64), np.asarray(head, np.int64)
    parent, edge, forward = spanning_tree(tail, head, n, root=root, prefer=prefer, ids=ids)
    group = lie.group_of(measurement)
    steps = lie.parameters(lie.as_numpy(measurement))
    start = lie.identity(group) if root_pose is None else lie.as_numpy(root_pose)
    rows = np.array(np.broadcast_to(lie.parameters(start), (n, steps.shape[1])))
    rows[edge >= 0] = steps[edge[edge >= 0]]
    backward = (edge >= 0) & ~forward
    rows[backward] = lie.parameters(lie.inverse(group(rows[backward])))
    while (parent >= 0).any():
        moving = np.flatnonzero(parent >= 0)
        ancestors = parent[moving]
        rows[moving] = lie.parameters(lie.compose(group(rows[ancestors]), group(rows[moving])))
        parent[moving] = parent[ancestors]
    return lie.normalize(group(rows))


def spanning_tree(
    tail: Int[np.ndarray, " e"],
    head: Int[np.ndarray, " e"],
    n: int,
    *,
    root: int = 0,
    prefer: str = "shortest",
    ids: Int[np.ndarray, " n"] | None = None,
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """A spanning tree rooted at `root`; see `spanning_tree_poses` for the arguments.

    Of several edges between two poses, the first is used.

    Returns:
        parent: int64 `[n]`, each pose's parent, -1 at the root.
        edge: int64 `[n]`, the edge that joins the two, -1 at the root.
        forward: bool `[n]`, whether that edge runs from the parent to the pose.

    Raises:
        InputError: for a graph that is not connected, or another preference.
    """
    from scipy.sparse import csgraph

    if prefer not in PREFERENCES:
        raise InputError(f"prefer: {prefer!r} given, expected one of {PREFERENCES}")
    check_connected(tail, head, n, ids=ids)
    pair = np.minimum(tail, head) * n + np.maximum(tail, head)
    pairs, first = np.unique(pair, return_index=True)
    span = pairs % n - pairs // n
    links = _sparse(pairs // n, pairs % n, span.astype(np.float64), n)
    if prefer == "odometry":
        links = csgraph.minimum_spanning_tree(links)
    _, parent = csgraph.breadth_first_order(links, root, directed=False)
    parent = np.where(parent < 0, -1, parent).astype(np.int64)
    pose = np.arange(n)
    used = np.minimum(pose, parent) * n + np.maximum(pose, parent)
    found = np.minimum(np.searchsorted(pairs, used), max(len(pairs) - 1, 0))
    edge = np.where(parent < 0, -1, first[found] if len(first) else -1)
    forward = (head[edge] == pose) if len(head) else np.zeros(n, bool)
    return parent, edge, forward


def check_connected(
    tail: Int[np.ndarray, " e"],
    head: Int[np.ndarray, " e"],
    n: int,
    *,
    ids: Int[np.ndarray, " n"] | None = None,
) -> None:
    """Raises `InputError` unless edges join all `n` poses; `ids` name them in the message."""
    count, label = connected_parts(tail, head, n)
    if count > 1:
        stray = int(np.argmax(label != label[0]))
        names = (
            np.arange(n)
            if ids is None
            else [symbols.key_text(int(one)) for one in ids[: stray + 1]]
        )
        raise InputError(
            f"the map falls into {count} parts: no edges lead from pose {names[0]} to pose"
            f" {names[stray]}, expected one connected map"
        )


def connected_parts(
    tail: Int[np.ndarray, " e"], head: Int[np.ndarray, " e"], n: int
) -> tuple[int, Int[np.ndarray, " n"]]:
    """The parts that edges join `n` nodes to: how many, and the one that each node is in."""
    from scipy.sparse import csgraph

    return csgraph.connected_components(_sparse(tail, head, np.ones(len(tail)), n), directed=False)


def _sparse(row: np.ndarray, column: np.ndarray, value: np.ndarray, n: int) -> Any:
    from scipy import sparse

    return sparse.csr_array((value, (row, column)), shape=(n, n))
