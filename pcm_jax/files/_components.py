"""Sessions in one file that no odometry links to one another, as robots."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from pcm_jax.files._scope import Scope, made_scope
from pcm_jax.files.pose_file import PoseFile
from pcm_jax.graph.spanning_tree import connected_parts


def by_components(file: PoseFile, scope: Scope, *, only_apart: bool = False) -> Scope:
    """A scope in which each session of the file's one robot is a robot.

    Where edges leave the map in parts, the parts are the sessions; else the parts that odometry
    leaves, edges between poses that follow one another in the order of ids. A file of several
    robots, of candidates, or of one session keeps its scope.

    Args:
        file: what the file holds.
        scope: whose its ids are.
        only_apart: whether only parts that no edge joins count.
    """
    if len(scope.labels) != 1 or file.candidates or not len(file.edges):
        return scope
    known = np.unique(file.ids)
    rank = np.searchsorted(known, file.edges.ids)
    part = _parts(rank, len(known))
    if part.max() == 0 and not only_apart:
        part = _parts(rank[np.abs(rank[:, 0] - rank[:, 1]) == 1], len(known))
    count = int(part.max()) + 1
    if count == 1:
        return scope
    name = scope.names[0]
    robots, ids = scope.locate(known)
    return made_scope(
        [f"{scope.labels[0]} part {k}" for k in range(count)],
        [f"{name}-{k + 1}" for k in range(count)],
        kind="table",
        rule=f"{scope.rule}; {count} sessions that no odometry links, each a robot",
        codes=known,
        robots=np.where(robots >= 0, part, -1),
        ids=ids,
    )


def _parts(rank: Int[np.ndarray, "e 2"], count: int) -> Int[np.ndarray, " n"]:
    """The part that each of `count` poses is in, numbered in the order of poses."""
    _, label = connected_parts(rank[:, 0], rank[:, 1], count)
    _, first, part = np.unique(label, return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first))
    return order[part.ravel()]
