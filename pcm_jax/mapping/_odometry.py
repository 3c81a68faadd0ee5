"""The steps by which a map has grown, where it has grown by odometry alone."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph import PoseGraph


def odometry_steps(
    before: PoseGraph, after: PoseGraph, origin: Float[np.ndarray, " s"]
) -> Float[np.ndarray, "g d d"]:
    """The covariances of new steps of odometry, left perturbations of the poses they reach.

    Args:
        before: a map.
        after: the same with further poses.
        origin: the point about which left perturbations turn, see `MapCovariance`.

    Raises:
        InputError: unless one edge each leads from the last pose on to all that are new.
    """
    old, edges = before.num_poses, slice(before.num_edges, None)
    tail, head = (np.asarray(end)[edges] for end in (after.tail, after.head))
    backward = tail > head
    low, high = np.where(backward, head, tail), np.where(backward, tail, head)
    if not (np.array_equal(high, np.arange(old, after.num_poses)) and (low == high - 1).all()):
        raise InputError(
            f"pose_graph {after.name!r}: expected the {old} poses and {before.num_edges} edges of"
            " before, and one edge from each pose to the next from there on"
        )
    covariance = np.linalg.inv(np.asarray(after.information)[edges])
    if backward.any():  # X_n = X_(n-1) z⁻¹: an error z exp(δ) moves it by −Ad(z) δ
        turned = np.asarray(lie.adjoint(lie.take(lie.as_numpy(after.measurement), edges)))
        carried = turned @ covariance @ turned.swapaxes(1, 2)
        covariance = np.where(backward[:, None, None], carried, covariance)
    values = np.array(lie.parameters(lie.as_numpy(after.poses)))[old:]
    values[:, -len(origin) :] -= origin
    adjoint = np.asarray(lie.adjoint(after.group(values)))
    return adjoint @ covariance @ adjoint.swapaxes(1, 2)
