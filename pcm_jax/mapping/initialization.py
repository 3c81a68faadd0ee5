"""Poses to start from: the chordal relaxation, or a spanning tree.

Chordal relaxation (Martinec and Pajdla 2007; Carlone et al., "Initialization techniques for 3D
SLAM", ICRA 2015), two linear least-squares problems with the first pose held:

    rotations     min Σ w ‖ R_jᵀ − Z_ijᵀ R_iᵀ ‖²   over k x k matrices, then the nearest rotations
    translations  min Σ w ‖ t_j − t_i − R_i t_ij ‖²

where z_ij = (Z_ij, t_ij) and w is the mean information of the edge in rotation and in translation.
Both go through the same block Cholesky factorisation as the optimiser, with blocks of k and 1.
Runs on the host, in NumPy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.sparse.system import System, system_for

SMALLEST_WEIGHT = 1e-6
"""Relative to the median: keeps nearly free edges from making the relaxation singular."""


def chordal_poses(
    tail: Int[np.ndarray, " e"],
    head: Int[np.ndarray, " e"],
    measurement: Any,
    information: Float[np.ndarray, "e d d"],
    *,
    first_pose: Any,
    size: int,
) -> Any:
    """Poses by chordal relaxation.

    Args:
        tail, head: `[e]`; the graph is connected.
        measurement: Lie `[e]`.
        information: `[e, d, d]`.
        first_pose: Lie `[]`, where pose 0 is held.
        size: number of poses.

    Returns:
        Lie `[n]`, NumPy.
    """
    matrices = np.asarray(lie.as_matrix(lie.as_numpy(measurement)))
    k = matrices.shape[-1] - 1
    fixed = np.arange(size) == 0
    scale = np.diagonal(information, axis1=1, axis2=2)
    rotations = _rotations(
        system_for(size, tail, head, fixed, k), matrices[:, :k, :k], _weights(scale[:, k:])
    )
    moved = np.einsum("eij,ej->ei", rotations[tail], matrices[:, :k, k])
    translations = _translations(
        system_for(size, tail, head, fixed, 1), moved, _weights(scale[:, :k])
    )
    poses = np.zeros((size, k + 1, k + 1))
    poses[:, :k, :k], poses[:, :k, k], poses[:, k, k] = rotations, translations, 1.0
    start = np.asarray(lie.as_matrix(lie.as_numpy(first_pose)))
    return lie.from_matrix(start @ poses)  # type: ignore[arg-type]


def _weights(diagonal: Float[np.ndarray, "e k"]) -> Float[np.ndarray, " e"]:
    mean = diagonal.mean(axis=1)
    return np.maximum(mean / np.median(mean), SMALLEST_WEIGHT)


def _rotations(
    system: System, measured: Float[np.ndarray, "e k k"], weight: Float[np.ndarray, " e"]
) -> Float[np.ndarray, "n k k"]:
    """The relaxation's rotations, the first one the identity."""
    k = measured.shape[-1]
    identity = np.broadcast_to(np.eye(k), measured.shape)
    transposed = measured.transpose(0, 2, 1)
    # Row q of every R is one unknown of length k: r = y_j − Zᵀ y_i, Jh = I, Jt = −Zᵀ.
    products = weight[:, None, None] * np.stack([identity, identity, -transposed])
    factor = system.factorize(products)
    guess = np.zeros((system.size, k, k))
    guess[0] = np.eye(k)
    residual = guess[system.head] - transposed @ guess[system.tail]
    residual *= weight[:, None, None]
    gradients = np.stack([-measured @ residual, residual])
    right = np.stack([system.gradient(gradients[..., q]) for q in range(k)], axis=-1)
    solution = guess - factor.solve(right.reshape(-1, k)).reshape(guess.shape)
    return _nearest_rotations(solution.transpose(0, 2, 1))


def _nearest_rotations(matrices: Float[np.ndarray, "n k k"]) -> Float[np.ndarray, "n k k"]:
    """The rotation that maximises trace(RᵀM), by the singular value decomposition."""
    if matrices.shape[-1] == 2:
        cos = matrices[:, 0, 0] + matrices[:, 1, 1]
        sin = matrices[:, 1, 0] - matrices[:, 0, 1]
        angle = np.arctan2(sin, cos)
        columns = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
        return np.stack(columns, axis=-1).reshape(-1, 2, 2)
    left, _, right = np.linalg.svd(matrices)
    left[:, :, -1] *= np.linalg.det(left @ right)[:, None]
    return left @ right


def _translations(
    system: System, moved: Float[np.ndarray, "e k"], weight: Float[np.ndarray, " e"]
) -> Float[np.ndarray, "n k"]:
    """Positions from the displacements `moved` of every edge, the first one at the origin."""
    ones = weight[:, None, None]
    factor = system.factorize(np.stack([ones, ones, -ones]))
    weighted = weight[:, None] * moved
    gradients = np.stack([weighted, -weighted])
    right = [system.gradient(gradients[..., q, None])[:, 0] for q in range(moved.shape[1])]
    return -factor.solve(np.stack(right, axis=-1))
