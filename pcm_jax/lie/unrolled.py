"""Small matrices as nested tuples of arrays: one array per entry, the batch in its trailing axes.

Products of such matrices are elementwise arithmetic on long arrays, which XLA fuses into one
vectorised loop (a batched 6x6 `dot_general` costs hundreds of times more on a CPU), and which NumPy
runs as well. An entry that is structurally zero or one is the Python number 0.0 or 1.0, and
products skip it. Nothing here loops over the batch; the loops over entries unroll at trace time.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from pcm_jax.arrays import namespace

Vector = Sequence[Any]
Matrix = Sequence[Sequence[Any]]
STRUCTURAL = (0.0, 1.0)


def _is_number(entry: Any, number: float) -> bool:
    return type(entry) is float and entry == number


def product(a: Any, b: Any) -> Any:
    """Product of two entries, structural zeros and ones skipped."""
    if _is_number(a, 0.0) or _is_number(b, 0.0):
        return 0.0
    if _is_number(a, 1.0):
        return b
    return a if _is_number(b, 1.0) else a * b


def total(a: Any, b: Any) -> Any:
    """Sum of two entries, structural zeros skipped."""
    if _is_number(a, 0.0):
        return b
    return a if _is_number(b, 0.0) else a + b


def dot(a: Vector, b: Vector) -> Any:
    """Σ aᵢ bᵢ.

    The sum of `product` by `total`, written out: small arrays in NumPy take no longer than calls.
    """
    result: Any = 0.0
    for left, right in zip(a, b, strict=True):
        if type(left) is float and left in STRUCTURAL:
            term = left if left == 0.0 else right
        elif type(right) is float and right in STRUCTURAL:
            term = right if right == 0.0 else left
        else:
            term = left * right
        if type(term) is float and term == 0.0:
            continue
        result = term if type(result) is float and result == 0.0 else result + term
    return result


def identity(size: int) -> Matrix:
    """The identity, every entry structural."""
    return tuple(tuple(float(i == j) for j in range(size)) for i in range(size))


def transpose(a: Matrix) -> Matrix:
    """Aᵀ."""
    return tuple(zip(*a, strict=True))


def add(*terms: Matrix) -> Matrix:
    """The sum A + B + …."""
    first, *rest = terms
    for other in rest:
        first = tuple(
            tuple(total(x, y) for x, y in zip(left, right, strict=True))
            for left, right in zip(first, other, strict=True)
        )
    return first


def multiply(a: Matrix, b: Matrix) -> Matrix:
    """A B."""
    columns = transpose(b)
    return tuple(tuple(dot(row, column) for column in columns) for row in a)


def apply(a: Matrix, vector: Vector) -> Vector:
    """A v."""
    return tuple(dot(row, vector) for row in a)


def block(rows: Sequence[Sequence[Matrix]]) -> Matrix:
    """One matrix from a grid of blocks."""
    return tuple(
        tuple(entry for part in parts for entry in part)
        for blocks in rows
        for parts in zip(*blocks, strict=True)
    )


def skew(v: Vector) -> Matrix:
    """[v]×, the matrix of the cross product with v."""
    x, y, z = v
    return ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))


def cross(a: Vector, b: Vector) -> Vector:
    """The cross product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def mirror(lower: Matrix) -> Matrix:
    """The symmetric matrix whose lower triangle is `lower` (rows of length 1, 2, …, or more)."""
    size = len(lower)
    return tuple(tuple(lower[max(i, j)][min(i, j)] for j in range(size)) for i in range(size))


def sandwich(a: Matrix, symmetric: Matrix) -> Matrix:
    """A S Aᵀ for a symmetric S; one triangle is computed."""
    half = multiply(a, symmetric)
    return mirror([[dot(half[i], a[j]) for j in range(i + 1)] for i in range(len(a))])


def cholesky(symmetric: Matrix) -> Matrix:
    """L with S = L Lᵀ, lower triangular, zeros structural.

    An S that is not positive definite gives NaN.
    """
    size = len(symmetric)
    xp = namespace(symmetric[0][0])
    lower: list[list[Any]] = [[0.0] * size for _ in range(size)]
    for j in range(size):
        pivot = symmetric[j][j] - dot(lower[j][:j], lower[j][:j])
        lower[j][j] = xp.sqrt(pivot)
        for i in range(j + 1, size):
            entry = total(symmetric[i][j], product(-1.0, dot(lower[i][:j], lower[j][:j])))
            lower[i][j] = 0.0 if _is_number(entry, 0.0) else entry / lower[j][j]
    return tuple(tuple(row) for row in lower)


def solve_lower(lower: Matrix, vector: Vector) -> Vector:
    """L⁻¹ v by forward substitution."""
    solution: list[Any] = []
    for i, row in enumerate(lower):
        entry = total(vector[i], product(-1.0, dot(row[:i], solution)))
        solution.append(0.0 if _is_number(entry, 0.0) else entry / row[i])
    return tuple(solution)


def inverse_quadratic_form(symmetric: Matrix, vector: Vector) -> Any:
    """vᵀ S⁻¹ v for a positive definite S, by S = L D Lᵀ (no square roots); NaN for any other."""
    lower, pivots = _ldl(symmetric)
    reduced = solve_unit_lower(lower, vector)
    form = dot(reduced, [product(x, pivot) for x, pivot in zip(reduced, pivots, strict=True)])
    xp = namespace(form)
    return xp.where(functools.reduce(xp.minimum, pivots) > 0.0, form, xp.nan)


def solve_symmetric(symmetric: Matrix, vector: Vector) -> Vector:
    """S⁻¹ v for a positive definite S; NaN for any other."""
    lower = cholesky(symmetric)
    reduced = solve_lower(lower, vector)
    upper = tuple(row[::-1] for row in transpose(lower)[::-1])
    return solve_lower(upper, reduced[::-1])[::-1]


def _ldl(symmetric: Matrix) -> tuple[Matrix, Vector]:
    """S = L D Lᵀ: L of unit diagonal, and the reciprocals of D."""
    size = len(symmetric)
    lower = [list(row) for row in identity(size)]
    reciprocals: list[Any] = []
    for i in range(size):
        scaled: list[Any] = []  # row i of L D
        for j in range(i):
            known = product(-1.0, dot(lower[j][:j], scaled))
            scaled.append(total(symmetric[i][j], known))
            lower[i][j] = product(scaled[j], reciprocals[j])
        pivot = total(symmetric[i][i], product(-1.0, dot(lower[i][:i], scaled)))
        reciprocals.append(1.0 / pivot)
    return tuple(map(tuple, lower)), reciprocals


def solve_unit_lower(lower: Matrix, vector: Vector) -> Vector:
    """L⁻¹ v for an L of unit diagonal, by forward substitution."""
    solution: list[Any] = []
    for i, row in enumerate(lower):
        solution.append(total(vector[i], product(-1.0, dot(row[:i], solution))))
    return tuple(solution)


def packed_indices(size: int) -> list[tuple[int, int]]:
    """(row, column) of each entry of a packed symmetric matrix: the lower triangle, row by row."""
    return [(i, j) for i in range(size) for j in range(i + 1)]


def unpack(packed: Vector) -> Matrix:
    """Symmetric matrix from its d(d+1)/2 packed entries (an array's leading axis, or a tuple)."""
    size = int((2 * len(packed)) ** 0.5)
    rows = [[packed[i * (i + 1) // 2 + j] for j in range(i + 1)] for i in range(size)]
    return mirror(rows)


def pack(symmetric: Matrix) -> tuple[Any, ...]:
    """The d(d+1)/2 entries of a symmetric matrix: its lower triangle, row by row."""
    return tuple(symmetric[i][j] for i, j in packed_indices(len(symmetric)))


def from_array(array: Any) -> Matrix:
    """Entries of `[..., rows, columns]` as a nested tuple of `[...]` arrays."""
    rows, columns = array.shape[-2:]
    return tuple(tuple(array[..., i, j] for j in range(columns)) for i in range(rows))


def to_array(matrix: Matrix, like: Any) -> Any:
    """`[..., rows, columns]` from entries, with the batch shape and dtype of the array `like`."""
    xp = namespace(like, *(entry for row in matrix for entry in row))
    if xp is np:  # a stack of broadcasts takes fifty times as long for few
        array = np.empty((*like.shape, len(matrix), len(matrix[0])), like.dtype)
        for i, row in enumerate(matrix):
            for j, entry in enumerate(row):
                array[..., i, j] = entry
        return array
    full = [xp.broadcast_to(xp.asarray(x, like.dtype), like.shape) for row in matrix for x in row]
    return xp.stack(full, axis=-1).reshape(*like.shape, len(matrix), len(matrix[0]))
