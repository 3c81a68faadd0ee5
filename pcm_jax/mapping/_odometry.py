"""The steps by which a map has grown, where it has grown by odometry alone."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph import PoseGraph


def check_steps(before: PoseGraph, after: PoseGraph) -> None:
    """Raises `InputError` unless one edge each leads from the last pose on to all that are new.

    Args:
        before: a map.
        after: the same with further poses.
    """
    old, edges = before.num_poses, slice(before.num_edges, None)
    tail, head = (np.asarray(end)[edges] for end in (after.tail, after.head))
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    if not (np.array_equal(high, np.arange(old, after.num_poses)) and (low == high - 1).all()):
        raise InputError(
            f"pose_graph {after.name!r}: expected the {old} poses and {before.num_edges} edges of"
            " before, and one edge from each pose to the next from there on"
        )


def odometry_steps(
    graph: PoseGraph, poses: int, edges: int, origin: Float[np.ndarray, " s"]
) -> Float[np.ndarray, "g d d"]:
    """The covariances of steps of odometry, left perturbations of the poses they reach.

    Args:
        graph: a map.
        poses: how many of its poses come before the first step, and
        edges: how many of its edges; one edge each then leads to the next pose, `check_steps`.
        origin: the point about which left perturbations turn, see `MapCovariance`.
    """
    steps = slice(edges, None)
    backward = np.asarray(graph.tail)[steps] > np.asarray(graph.head)[steps]
    covariance = np.linalg.inv(np.asarray(graph.information)[steps])
    if backward.any():  # X_n = X_(n-1) z⁻¹: an error z exp(δ) moves it by −Ad(z) δ
        turned = np.asarray(lie.adjoint(lie.take(lie.as_numpy(graph.measurement), steps)))
        carried = turned @ covariance @ turned.swapaxes(1, 2)
        covariance = np.where(backward[:, None, None], carried, covariance)
    values = np.array(lie.parameters(lie.as_numpy(graph.poses))[poses:])
    values[:, -len(origin) :] -= origin
    adjoint = np.asarray(lie.adjoint(graph.group(values)))
    return adjoint @ covariance @ adjoint.swapaxes(1, 2)
