"""Columns that state a measurement's uncertainty, as their names say.

| names | state |
|---|---|
| `sigma_x`, `std_yaw`, `s_1`, … | standard deviations |
| `var_x`, `variance_theta`, … | variances |
| `cov_11`, `covariance_xy`, `cov_x_yaw`, … | a covariance's entries |
| `information_11`, `info_xx`, `I12`, `omega_xy`, … | entries of the information |
| `kappa`, `tau` | SE-Sync's and DPGO's precisions, 3D: Ω = diag(τ, τ, τ, 2κ, 2κ, 2κ) |

Directions are x, y, theta or x, y, z, roll, pitch, yaw, or counted from 1, in whatever order; of a
symmetric matrix either triangle will do, and the diagonal alone.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from pcm_jax.files import coordinates
from pcm_jax.files.text import Rows
from pcm_jax.graph.validation import SYMMETRY_TOLERANCE, check_information, raise_first

SMALLEST_SIGMA = 1e-30  # so that its information still is a number
_KINDS = {
    "sigma": ("sigma", "stddev", "std", "sd", "s"),
    "variance": ("variance", "var"),
    "covariance": ("covariance", "cov"),
    "information": ("information", "info", "inf", "omega", "i"),
}
_KIND = {word: kind for kind, words in _KINDS.items() for word in words}
_AXES = {
    3: (("x", "1"), ("y", "2"), ("theta", "th", "yaw", "rz", "t", "3")),
    6: (
        ("x", "1"),
        ("y", "2"),
        ("z", "3"),
        ("roll", "rx", "4"),
        ("pitch", "ry", "5"),
        ("yaw", "rz", "6"),
    ),
}
_WORDS = sorted({word for axes in _AXES.values() for names in axes for word in names}, key=len)
_AXIS = "|".join(reversed(_WORDS))
_NAME = re.compile(rf"({'|'.join(_KIND)})_?({_AXIS})(?:_?({_AXIS}))?")
PRECISIONS = {"tau": 0, "kappa": 3}

Entry = tuple[str, int, int]  # the kind and the directions that a column speaks of


def entry_of(name: str, d: int) -> Entry | None:
    """The statement of a column by its name, on d directions; None for another name."""
    if name in PRECISIONS:
        return ("precision", PRECISIONS[name], PRECISIONS[name]) if d == 6 else None
    found = _NAME.fullmatch(name)
    if found is None:
        return None
    kind = _KIND[found[1]]
    at = {word: axis for axis, words in enumerate(_AXES[d]) for word in words}
    if any(word not in at for word in found.groups()[1:] if word is not None):
        return None
    paired = kind in ("covariance", "information")
    if (found[3] is not None and not paired) or (
        paired and found[3] is None and found[2].isdigit()
    ):
        return None
    return kind, at[found[2]], at[found[3] or found[2]]


def stated(
    rows: Rows, columns: Sequence[int], entries: Sequence[Entry], d: int, how: str
) -> tuple[Float[np.ndarray, "m d d"], str]:
    """Information `[m, d, d]` from columns that state it, and how it was read, in words.

    Args:
        rows: the file's.
        columns: places of the columns.
        entries: what each of them states.
        d: number of directions.
        how: how to read what is called information, as `coordinates.information`.

    Raises:
        InputError: through the rows' fault, for columns of two kinds, a direction of which nothing
            is stated, a standard deviation or variance that is not positive, and a covariance
            that has no inverse.
    """
    kinds = sorted({kind for kind, _, _ in entries})
    if len(kinds) > 1:
        raise rows.fault(0, f"columns of {' and of '.join(kinds)} given, expected one kind")
    matrices = _matrices(rows, columns, entries, d)
    if kinds[0] == "precision":
        return matrices, "precisions kappa and tau"
    if kinds[0] == "information":
        return coordinates.information(
            coordinates.upper_triangle(matrices), how=how, fault=rows.fault
        ), how
    covariance = check_information(matrices, rows.fault, "covariance")
    return coordinates.inverted(covariance), f"{_PLURAL[kinds[0]]}, as its columns are called"


def _matrices(
    rows: Rows, columns: Sequence[int], entries: Sequence[Entry], d: int
) -> Float[np.ndarray, "m d d"]:
    """Covariances, or information where that is stated."""
    kind, given = entries[0][0], np.zeros((d, d), bool)
    matrices = np.zeros((len(rows), d, d))
    for index, (_, row, column) in zip(columns, entries, strict=True):
        value = rows.floats(index, index + 1)
        if kind in ("sigma", "variance"):
            positive(value, rows, "a standard deviation" if kind == "sigma" else "a variance")
            value = value**2 if kind == "sigma" else value
        if kind == "precision":
            own = np.arange(row, row + 3)
            matrices[:, own, own], given[own, own] = (2.0 if row else 1.0) * value, True
        else:
            matrices[:, row, column], given[row, column] = value[:, 0], True
    missing = np.flatnonzero(~np.diagonal(given))
    if missing.size:
        axis = _AXES[d][missing[0]][0]
        raise rows.fault(0, f"no column states the {kind} of {axis}, expected one")
    mirrored = given.T & ~given
    matrices[:, mirrored] = np.swapaxes(matrices, 1, 2)[:, mirrored]
    both = given & given.T
    return _checked(matrices, both, rows, kind)


def _checked(
    matrices: Float[np.ndarray, "m d d"], both: np.ndarray, rows: Rows, kind: str
) -> Float[np.ndarray, "m d d"]:
    """The same, unless two columns that state one entry differ."""
    turned = np.swapaxes(matrices, 1, 2)
    size = np.abs(matrices).max(axis=(1, 2), keepdims=True, initial=0.0)
    differ = (np.abs(matrices - turned) > SYMMETRY_TOLERANCE * size) & both
    raise_first(
        differ.any(axis=(1, 2)), rows.fault, lambda row: f"the {kind} given is not symmetric"
    )
    return matrices


_PLURAL = {"sigma": "standard deviations", "variance": "variances", "covariance": "covariances"}


def positive(values: Float[np.ndarray, "m k"], rows: Rows, expected: str) -> None:
    """Raises `InputError` through the rows' fault for a value that is no positive number."""
    wrong = values < SMALLEST_SIGMA
    raise_first(
        wrong.any(axis=1),
        rows.fault,
        lambda row: f"{values[row][wrong[row]][0]:g} given, expected {expected} above 0",
    )
