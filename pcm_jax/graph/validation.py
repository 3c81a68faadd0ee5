"""Checks of a pose graph's arrays, vectorised, on the host.

Every check names its first culprit through a `Fault`: a callable that turns a row and a problem
into the exception to raise. Arrays given by a user are named `information[3]`; the file readers
pass one that names `file:line` instead.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax.arrays import as_array
from pcm_jax.errors import InputError, InputWarning
from pcm_jax.graph import unsaid

Fault = Callable[[int, str], InputError]

SYMMETRY_TOLERANCE = 1e-6  # of the matrix's largest entry
ROTATION_TOLERANCE = 1e-3  # of a quaternion's norm, or of a rotation matrix's entries
ROUNDING = 1e-2  # of a quaternion's norm: what is further off holds something else
LARGEST = 1e100  # products of a few such numbers still are float64
CLIP = 1e-9  # of the largest eigenvalue: what `repair="clip"` raises the others to


def argument_fault(argument: str) -> Fault:
    """A `Fault` that names a row of an argument."""
    return lambda row, problem: InputError(f"{argument}[{row}]: {problem}")


def raise_first(culprits: Any, fault: Fault, problem: Callable[[int], str]) -> None:
    """Raises `fault(row, problem(row))` for the first true entry of `culprits` `[n]`, if any."""
    if culprits.any():
        row = int(np.argmax(culprits))
        raise fault(row, problem(row))


def check_finite(values: Float[np.ndarray, "n *rest"], fault: Fault) -> None:
    """Every number of `values` `[n, ...]` is finite, and small enough for its square to be."""
    rows = values.reshape(len(values), -1) if values.size else np.zeros((len(values), 1))
    finite = np.abs(rows) <= LARGEST

    def problem(row: int) -> str:
        value = rows[row][~finite[row]][0]
        limit = f" below {LARGEST:g}" if np.isfinite(value) else ""
        return f"{value:g} given, expected a finite number{limit}"

    raise_first(~finite.all(axis=1), fault, problem)


def as_indices(values: Any, count: int | None, argument: str, of: str) -> Int[np.ndarray, " m"]:
    """Indices `[m]` as int32, each in 0 … count − 1.

    Args:
        values: integers `[m]`.
        count: how many there are to choose from; None where that is not known yet.
        argument: the name to use in messages.
        of: what is counted, in the plural.

    Raises:
        InputError: for another shape, for values that are not integers, and for one out of range.
    """
    indices = as_array(values, argument)
    if indices.ndim != 1:
        raise InputError(f"{argument}: shape {indices.shape} given, expected [m]")
    if indices.size and not np.issubdtype(indices.dtype, np.integer):
        raise InputError(f"{argument}: {indices.dtype} given, expected integers")
    limit = np.iinfo(np.int32).max if count is None else count
    known = "" if count is None else f" (there are {count} {of})"
    raise_first(
        (indices < 0) | (indices >= limit),
        argument_fault(argument),
        lambda row: f"index {indices[row]} is not in 0 … {limit - 1}{known}",
    )
    return indices.astype(np.int32)


def check_self_loops(
    tail: Int[np.ndarray, " e"], head: Int[np.ndarray, " e"], fault: Fault
) -> None:
    """No edge ends where it starts."""
    raise_first(
        tail == head,
        fault,
        lambda row: f"edge from pose {tail[row]} to itself, expected two different poses",
    )


def unit_rotations(
    parameters: Float[np.ndarray, "n p"], size: int, fault: Fault, *, columns: str = ""
) -> Float[np.ndarray, "n p"]:
    """Parameters of transforms with their rotations scaled to unit length.

    Args:
        parameters: `[n, p]`, the rotation in the first `size` columns (jaxlie's layout).
        size: 4 for a quaternion, 2 for cosine and sine, 0 where there is no rotation.
        fault: names the culprit.
        columns: the order in which a file should have them; "" for what was no file.

    Raises:
        InputError: through `fault`, for a norm of zero or infinity, and, in a file, for one that
            is more than 1 % from one: no rounding, but other columns.

    Warns:
        InputWarning: once, with the number of norms further than 1e-3 from one.
    """
    if size == 0:
        return parameters
    what = "quaternion" if size == 4 else "cosine and sine"
    with np.errstate(over="ignore", invalid="ignore"):
        norm = np.sqrt(np.sum(np.square(parameters[:, :size]), axis=1))
    none = (norm == 0.0) | ~np.isfinite(norm)
    raise_first(none, fault, lambda row: f"{what} of norm {norm[row]:g}, expected norm 1")
    raise_first(
        (np.abs(norm - 1.0) > ROUNDING) & bool(columns),
        fault,
        lambda row: (
            f"{what} of norm {norm[row]:.6g} is no rounding, expected norm 1: are the columns in"
            f" the order {columns}?"
        ),
    )
    far = np.abs(norm - 1.0) > ROTATION_TOLERANCE
    if far.any():
        row = int(np.argmax(far))
        message = fault(row, f"{what} of norm {norm[row]:.6g} scaled to norm 1")
        warnings.warn(InputWarning(f"{message} ({int(far.sum())} such in all)"), stacklevel=2)
    return np.concatenate([parameters[:, :size] / norm[:, None], parameters[:, size:]], axis=1)


def positive_definite(matrices: Float[np.ndarray, "m d d"]) -> Bool[np.ndarray, " m"]:
    """Finds which of the symmetric `[m, d, d]` have a Cholesky factor: bool `[m]`."""
    rest = np.array(matrices, dtype=np.float64)
    good = np.ones(len(rest), bool)
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is not definite
        for k in range(rest.shape[-1]):
            pivot = rest[:, k, k]
            good &= pivot > 0.0
            column = rest[:, k + 1 :, k] / np.where(good, pivot, np.inf)[:, None]
            rest[:, k + 1 :, k + 1 :] -= column[:, :, None] * rest[:, None, k, k + 1 :]
    return _factored(matrices, good)


def _factored(
    matrices: Float[np.ndarray, "m d d"], good: Bool[np.ndarray, " m"]
) -> Bool[np.ndarray, " m"]:
    """The good ones that LAPACK factors as well, whose rounding is another."""
    try:
        np.linalg.cholesky(np.asarray(matrices)[good])
    except np.linalg.LinAlgError:
        for row in np.flatnonzero(good).tolist():
            try:
                np.linalg.cholesky(matrices[row])
            except np.linalg.LinAlgError:
                good[row] = False
    return good


def check_information(
    matrices: Float[np.ndarray, "m d d"],
    fault: Fault,
    what: str = "information",
    *,
    singular: bool = False,
) -> Float[np.ndarray, "m d d"]:
    """`[m, d, d]` made exactly symmetric, after checking that it nearly was and is definite.

    Args:
        matrices: `[m, d, d]`.
        fault: names the culprit.
        what: the name to use in messages.
        singular: whether a matrix may lack directions (`graph.unsaid`), but not all of them.

    Raises:
        InputError: through `fault`, for a matrix that is not finite, not symmetric (to 1e-6 of its
            largest entry) or not positive definite.
    """
    check_finite(matrices, fault)
    transposed = np.swapaxes(matrices, -1, -2)
    largest = np.abs(matrices).max(axis=(-2, -1), initial=0.0)
    skewed = np.abs(matrices - transposed).max(axis=(-2, -1), initial=0.0)
    raise_first(
        skewed > SYMMETRY_TOLERANCE * largest,
        fault,
        lambda row: f"{what} is not symmetric: entries differ by {skewed[row]:.3g}",
    )
    symmetric = 0.5 * (matrices + transposed)
    bad = ~positive_definite(symmetric)
    if singular and bad.any():
        rank = unsaid.ranks(symmetric[bad])
        bad[bad] = (rank < 1) | (rank == symmetric.shape[-1])
    raise_first(
        bad, fault, lambda row: f"{what} is not positive definite ({_told(symmetric[row])})"
    )
    return symmetric


def _told(matrix: Float[np.ndarray, "d d"]) -> str:
    """The smallest eigenvalue, and the rank of a matrix that merely lacks directions."""
    values = np.linalg.eigvalsh(matrix)
    zero = 1e-12 * values[-1]
    text = f"smallest eigenvalue {values[0]:.6g}"
    if values[-1] <= 0.0 or values[0] < -zero:
        return text
    rank = int((values > zero).sum())
    return f"{text}; rank {rank} of {len(values)}: planar or 4-DoF measurements say nothing there"


def clip_to_definite(
    matrices: Float[np.ndarray, "m d d"],
) -> tuple[Float[np.ndarray, "m d d"], int]:
    """Symmetric `[m, d, d]` with every eigenvalue at least 1e-9 of the matrix's largest one.

    Only matrices without a Cholesky factor are touched.

    Returns:
        The matrices, and how many were changed.
    """
    bad = np.flatnonzero(~positive_definite(matrices))
    if not bad.size:
        return matrices, 0
    try:
        values, vectors = np.linalg.eigh(matrices[bad])
    except np.linalg.LinAlgError:  # entries at the end of floats: left to be refused
        return matrices, 0
    values = np.maximum(values, CLIP * values[:, -1:])
    clipped = np.array(matrices)
    clipped[bad] = (vectors * values[:, None, :]) @ np.swapaxes(vectors, -1, -2)
    clipped[bad] = 0.5 * (clipped[bad] + np.swapaxes(clipped[bad], -1, -2))
    return clipped, bad.size
