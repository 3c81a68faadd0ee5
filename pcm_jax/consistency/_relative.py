"""G, the covariance of the differences of poses' errors, from their joint covariance.

For left perturbations ξ, whose joint covariance has the blocks C_ij,

    G_ij = Cov(ξ_j − ξ_i) = C_ii + C_jj − C_ij − C_ijᵀ

For right perturbations δ, ξ = Ad(X) δ, and C_ij = Ad(X_i) Σ_ij Ad(X_j)ᵀ. Symmetric in i and j, so
the upper triangle is formed, a panel of rows at a time, which stays in a core's cache; products
with adjoints are made for several poses together, as one product of larger matrices, which BLAS
does faster than several of 6 x 6. Host, NumPy, float64.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from pcm_jax.arrays import shareable_zeros
from pcm_jax.errors import InputError
from pcm_jax.lie import unrolled
from pcm_jax.sparse import registry

PANEL = 4  # poses
TILE = 96  # rows and columns of a matrix that is compared with its transpose
SYMMETRY_TOLERANCE = 1e-6  # of the largest entry


def relative_covariance(
    joint: Float[np.ndarray, "k*d k*d"],
    adjoint: Float[np.ndarray, "k d d"] | None,
    order: Int[np.ndarray, " k"],
    size: int,
    d: int,
) -> Float[np.ndarray, "packed size size"]:
    """Forms G, packed, rows and columns in another order.

    Args:
        joint: of left perturbations, or of right ones where `adjoint` is given.
        adjoint: Ad of every pose, in the frame that G is wanted in; None: they are left already.
        order: the pose that each row of G stands for.
        size: rows of the result, at least k; those beyond k are zero.
        d: tangent dimensions.
    """
    count = len(order)
    packed = shareable_zeros((d * (d + 1) // 2, size, size))
    if count == 0:
        return packed
    places = (order[:, None] * d + np.arange(d)).ravel()
    adjoint = None if adjoint is None else adjoint[order]
    row, column = np.transpose(unrolled.packed_indices(d))
    own = joint.reshape(count, d, count, d)[order, :, order]
    if adjoint is not None:
        own = adjoint @ own @ adjoint.swapaxes(1, 2)
    own = own[:, row, column].T
    grouped = None if adjoint is None else _block_diagonals(adjoint)
    with registry.blas.one():  # threads cost many times what products of 24 x 24 take
        for start in range(0, count, PANEL):
            block = _panel(joint, grouped, start, places, d)  # [a, b, i, j]
            i, j = slice(start, start + block.shape[2]), slice(start, count)
            found = block[row, column]
            found += block[column, row]
            np.subtract(own[:, None, j], found, out=found)
            found += own[:, i, None]
            packed[:, i, j] = found
            packed[:, j, i] = found.swapaxes(1, 2)
    return packed


def _panel(
    joint: np.ndarray, grouped: np.ndarray | None, start: int, places: np.ndarray, d: int
) -> Float[np.ndarray, "d d rows columns"]:
    """C of a panel's poses with all from its first on."""
    count = len(places) // d
    rows, columns = min(PANEL, count - start), count - start
    chosen = slice(start * d, (start + rows) * d)
    if places[0] == 0 and (np.diff(places) == 1).all():  # in order already: nothing to copy
        right = joint[chosen, start * d :]
    else:
        right = np.take(joint[places[chosen]], places[start * d :], axis=1)
    if grouped is None:
        left = right.reshape(rows, d, columns, d)
        return np.ascontiguousarray(left.transpose(1, 3, 0, 2))
    own = grouped[start // PANEL][: rows * d, : rows * d]
    right = own @ right
    groups, width = len(grouped) - start // PANEL, PANEL * d
    wide = np.zeros((rows * d, groups * width))
    wide[:, : columns * d] = right
    blocks = np.ascontiguousarray(wide.reshape(rows * d, groups, width).swapaxes(0, 1))
    left = blocks @ np.ascontiguousarray(grouped[start // PANEL :].swapaxes(1, 2))
    left = left.reshape(groups, rows, d, PANEL, d).transpose(2, 4, 1, 0, 3)
    return left.reshape(d, d, rows, groups * PANEL)[..., :columns]


def _block_diagonals(adjoint: Float[np.ndarray, "k d d"]) -> Float[np.ndarray, "groups w w"]:
    """Block-diagonal matrices of `PANEL` adjoints each; zeros beyond the last."""
    count, d, _ = adjoint.shape
    groups = -(-count // PANEL)
    full = np.zeros((groups * PANEL, d, d))
    full[:count] = adjoint
    result = np.zeros((groups, PANEL, d, PANEL, d))
    for k in range(PANEL):
        result[:, k, :, k] = full[k::PANEL]
    return result.reshape(groups, PANEL * d, PANEL * d)


def checked_joint(joint: object, size: int, name: str) -> Float[np.ndarray, "n n"]:
    """A user's joint covariance as float64.

    Raises:
        InputError: for another shape, an entry that is not finite, a matrix that is not symmetric
            (to 1e-6 of its largest entry).
    """
    matrix = np.asarray(joint, dtype=np.float64)
    if matrix.shape != (size, size):
        raise InputError(
            f"{name}: shape {matrix.shape}; expected {(size, size)}, a block for each touched pose"
        )
    tolerance = SYMMETRY_TOLERANCE * np.diagonal(matrix).max(initial=0.0)
    if not _largest_skew(matrix) <= tolerance:  # NaN and infinity make it NaN
        _raise_culprit(matrix, tolerance, name)
    return matrix


def _largest_skew(matrix: np.ndarray) -> float:
    """The largest difference between entries across the diagonal; NaN if any is not finite.

    By square tiles, since one of a matrix and its transpose is read across the cache.
    """
    largest = 0.0
    starts = range(0, len(matrix), TILE)
    for row in starts:
        for column in range(0, row + 1, TILE):
            tile = matrix[row : row + TILE, column : column + TILE]
            skew = tile - matrix[column : column + TILE, row : row + TILE].T
            largest = np.maximum(largest, np.maximum(skew.max(), -skew.min()))
    return float(largest)


def _raise_culprit(matrix: np.ndarray, tolerance: float, name: str) -> None:
    wrong = np.argwhere(~np.isfinite(matrix))
    if len(wrong):
        i, j = wrong[0]
        raise InputError(f"{name}[{i}, {j}]: {matrix[i, j]}; expected finite numbers")
    largest = np.abs(matrix).max(initial=0.0)
    skew = np.abs(matrix - matrix.T)
    if skew.max() > SYMMETRY_TOLERANCE * largest:
        i, j = np.unravel_index(np.argmax(skew), skew.shape)
        raise InputError(
            f"{name}[{i}, {j}]: {matrix[i, j]} differs from {matrix[j, i]} across the diagonal; "
            "expected a symmetric matrix"
        )
