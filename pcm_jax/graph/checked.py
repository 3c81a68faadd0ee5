"""Poses, measurements and their uncertainty as a user may pass them, checked, in NumPy."""

from __future__ import annotations

from typing import Any

import jax
import jaxlie
import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import as_array
from pcm_jax.errors import InputError, check_class
from pcm_jax.graph import validation
from pcm_jax.graph.validation import ROTATION_TOLERANCE, Fault, argument_fault

ORDERS = ("translation-rotation", "rotation-translation")


def batch_size(transform: Any) -> int:
    """The size of a batch `[n]`, under a vmap's leading axes too; 0 where no shape is known."""
    if isinstance(transform, jaxlie.MatrixLieGroup):
        leaves = [lie.parameters(transform)]  # flattening takes longer
    else:
        leaves = jax.tree.leaves(transform)
    shape = getattr(leaves[0], "shape", ()) if leaves else ()
    return shape[-2] if len(shape) > 1 else 0


def rotation_size(group: type) -> int:
    """Leading parameters that are the rotation: 2 (cos, sin), 4 (quaternion), 0 on the line."""
    module = lie.module_of(group)
    return module.PARAMETERS_DIM - (module.MATRIX_DIM - 1)


def as_transforms(values: Any, argument: str, fault: Fault | None = None) -> Any:
    """A NumPy-backed batch `[n]` of float64 transforms with unit rotations.

    Args:
        values: `jaxlie.SE2`, `jaxlie.SE3` or `R1` with one batch axis, or homogeneous matrices
            `[n, 3, 3]` or `[n, 4, 4]`.
        argument: the name to use in messages.
        fault: names a culprit; by default `argument[row]`.

    Raises:
        InputError: for anything else, for numbers that are not finite, a quaternion of norm zero,
            and a matrix that is no rigid motion (to 1e-3).
    """
    fault = fault or argument_fault(argument)
    if isinstance(values, jaxlie.MatrixLieGroup):
        transforms = lie.as_numpy(values)
    else:
        transforms = _from_matrices(values, argument, fault)
    rows = np.asarray(lie.parameters(transforms))
    if rows.ndim != 2:
        raise InputError(f"{argument}: batch shape {rows.shape[:-1]} given, expected one axis [n]")
    validation.check_finite(rows, fault)
    group = lie.group_of(transforms)
    return group(validation.unit_rotations(rows, rotation_size(group), fault))


def as_floats(values: Any, argument: str, expected: str) -> np.ndarray:
    """`values` as a float64 array; `InputError` with what was expected where they are none."""
    try:
        array = np.asarray(values)
        array = array.astype(np.float64) if array.dtype.kind in "biufO" else None
    except (TypeError, ValueError):
        array = None
    if array is None or isinstance(values, np.ma.MaskedArray):
        raise InputError(f"{argument}: {type(values).__name__} given, expected {expected}")
    return array


def _from_matrices(values: Any, argument: str, fault: Fault) -> Any:
    expected = "jaxlie.SE2, jaxlie.SE3 or homogeneous matrices [n, 3, 3] or [n, 4, 4]"
    matrices: Any = as_floats(values, argument, expected)
    if matrices.ndim != 3 or matrices.shape[1:] not in ((3, 3), (4, 4)):
        raise InputError(
            f"{argument}: shape {matrices.shape} given, expected homogeneous matrices [n, 3, 3] "
            "(SE(2)) or [n, 4, 4] (SE(3))"
        )
    validation.check_finite(matrices, fault)
    size = matrices.shape[-1]
    rotation, bottom = matrices[:, :-1, :-1], matrices[:, -1]
    skewed = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(size - 1)).max(axis=(1, 2))
    validation.raise_first(
        (np.linalg.det(rotation) <= 0.0) | (skewed > ROTATION_TOLERANCE),
        fault,
        lambda _: f"the upper left {size - 1}x{size - 1} block is not a rotation matrix",
    )
    validation.raise_first(
        np.abs(bottom - np.eye(size)[-1]).max(axis=1) > ROTATION_TOLERANCE,
        fault,
        lambda row: f"last row {bottom[row].tolist()} given, expected zeros and a one",
    )
    return lie.from_matrix(matrices)


def as_information(
    information: Any,
    covariance: Any,
    transforms: Any,
    tangent_order: str,
    *,
    singular: bool = False,
) -> Float[np.ndarray, "m d d"]:
    """Information `[m, d, d]` over (translation, rotation), symmetric and positive definite.

    Args:
        information: `[m, d, d]`, or None where `covariance` is given.
        covariance: `[m, d, d]`, or None where `information` is given.
        transforms: the measurements, NumPy-backed `[m]`.
        tangent_order: one of `ORDERS`, of the rows and columns given.
        singular: whether information may lack directions (`graph.unsaid`), but not all of them.

    Raises:
        InputError: unless exactly one is given; for a wrong shape; for a matrix that is not
            finite, symmetric and positive definite.
    """
    if (information is None) == (covariance is None):
        raise InputError("information, covariance: give exactly one of the two")
    argument = "information" if covariance is None else "covariance"
    group = lie.group_of(transforms)
    d, count = lie.tangent_dim(group), len(lie.parameters(transforms))
    given = information if covariance is None else covariance
    matrices = as_floats(given, argument, f"an array {(count, d, d)}")
    if matrices.shape != (count, d, d):
        raise InputError(f"{argument}: shape {matrices.shape} given, expected {(count, d, d)}")
    singular = singular and covariance is None
    matrices = validation.check_information(
        matrices, argument_fault(argument), argument, singular=singular
    )
    if covariance is not None:
        matrices = np.linalg.inv(matrices)
        matrices = 0.5 * (matrices + np.swapaxes(matrices, 1, 2))
    return _reordered(matrices, d, lie.module_of(group).MATRIX_DIM - 1, tangent_order)


def _reordered(
    matrices: Float[np.ndarray, "m d d"], d: int, translation: int, tangent_order: str
) -> Float[np.ndarray, "m d d"]:
    if tangent_order not in ORDERS:
        raise InputError(f"tangent_order: {tangent_order!r} given, expected one of {ORDERS}")
    if tangent_order == ORDERS[0]:
        return matrices
    order = np.roll(np.arange(d), translation)
    return matrices[:, order][:, :, order]


def as_ids(ids: Any, count: int) -> Int[np.ndarray, " n"]:
    """int64 `[count]`, all different; 0 … count − 1 for None."""
    if ids is None:
        return np.arange(count, dtype=np.int64)
    values = as_array(ids, "ids")
    if values.shape != (count,):
        raise InputError(f"ids: shape {values.shape} given, expected ({count},), one per pose")
    if count and not np.issubdtype(values.dtype, np.integer):
        raise InputError(f"ids: {values.dtype} given, expected integers")
    if values.dtype.kind == "u" and count and values.max() > np.iinfo(np.int64).max:
        raise InputError(f"ids: {values.max()} given, expected integers below 2^63")
    unique, counts = np.unique(values, return_counts=True)
    if len(unique) < count:
        raise InputError(f"ids: {unique[np.argmax(counts)]} occurs more than once")
    return values.astype(np.int64)


def as_mask(mask: Any, argument: str, count: int) -> Bool[np.ndarray, " m"]:
    """Bool `[count]`, one per closure.

    Raises:
        InputError: for another shape or dtype.
    """
    values = np.asarray(mask)
    if values.dtype != bool or values.shape != (count,):
        raise InputError(
            f"{argument}: {values.dtype} {list(values.shape)} given, expected bool [{count}], one "
            "per closure"
        )
    return values


def as_weights(weights: Any, count: int) -> Float[np.ndarray, " m"]:
    """float64 `[count]`, finite and at least 0; ones for None."""
    if weights is None:
        return np.ones(count)
    values = as_floats(weights, "weight", f"an array ({count},)")
    if values.shape != (count,):
        raise InputError(f"weight: shape {values.shape} given, expected ({count},)")
    validation.raise_first(
        ~(np.isfinite(values) & (values >= 0.0)),
        argument_fault("weight"),
        lambda row: f"{values[row]} given, expected a finite number of at least 0",
    )
    return values


def as_names(names: Any, count: int) -> np.ndarray:
    """Object array `[count]` of strings; empty ones for None."""
    out = np.full(count, "", dtype=object)
    if names is not None:
        check_class("source", names, "strings", list, tuple, np.ndarray)
        if as_array(names, "source").shape != (count,):
            raise InputError(f"source: {len(names)} entries given, expected {count}")
        out[:] = list(names)
    return out
