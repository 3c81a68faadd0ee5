"""q² of closures that leave directions unsaid: the limit of a covariance without bound.

Let N = [N_u N_v] be the directions, carried to map a's frame, that closure u or v says nothing of.
With M + s N Nᵀ in place of M and s → ∞,

    q² = min over a of (r − N a)ᵀ M⁻¹ (r − N a),      d − rank N degrees of freedom,

whatever finite value M has along N (Sherman, Morrison and Woodbury's formula, s → ∞). With
M = L Lᵀ it is what is left of L⁻¹ r when the span of L⁻¹ N is taken out of it, one column after the
other; nothing is large, and no digit is lost.

A direction that differs from those before it by less than a thousandth is one of them: where the
closures of two planar maps each leave z, roll and pitch unsaid, these are three directions of every
pair and not six, though printing or optimising has tilted the poses by 1e-5. Closures that say
positions alone leave the rotation about each of two points unsaid: five directions, and what can be
compared is the distance of the points.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from pcm_jax import lie
from pcm_jax.arrays import namespace
from pcm_jax.lie import unrolled

DIFFERENT = 1e-3
"""Part of a direction, in standard deviations, that must lie outside the span of others."""


class Limit(NamedTuple):
    """Squared distances and the degrees of freedom that each has.

    Attributes:
        squared: q².
        freedom: as float, d − rank N.
    """

    squared: Any
    freedom: Any


def limit(symmetric: unrolled.Matrix, error: unrolled.Vector, free: Sequence[Any]) -> Limit:
    """The limit of q² where covariances along `free` grow without bound.

    Args:
        symmetric: M, positive definite; NaN comes of any other.
        error: r.
        free: columns of N; a zero one counts for nothing.
    """
    lower = unrolled.cholesky(symmetric)
    white = unrolled.solve_lower(lower, error)
    outside = outside_of(lower, free)
    left = unrolled.apply(outside, white)
    freedom = sum(row[i] for i, row in enumerate(outside))
    return Limit(unrolled.dot(left, left), namespace(white[0]).round(freedom))


def outside_of(lower: unrolled.Matrix, free: Sequence[Any]) -> unrolled.Matrix:
    """The projector P to what the span of L⁻¹ N leaves: q² = |P L⁻¹ r|².

    Args:
        lower: L of M = L Lᵀ.
        free: columns of N; a zero one counts for nothing.
    """
    like = lower[0][0]
    xp = namespace(like)

    def without(outside: Any, column: Any) -> Any:
        """The projector to what lies outside the columns so far, and one more of them."""
        whole = unrolled.solve_lower(lower, tuple(column))
        rest = unrolled.apply(outside, whole)
        length = unrolled.dot(rest, rest)
        new = length > DIFFERENT**2 * unrolled.dot(whole, whole)
        scale = xp.where(new, 1.0 / xp.where(new, length, 1.0), 0.0)
        scaled = tuple(x * scale for x in rest)
        return tuple(
            tuple(p - x * y for p, y in zip(row, rest, strict=True))
            for row, x in zip(outside, scaled, strict=True)
        )

    outside = tuple(
        tuple(xp.full_like(like, float(i == j)) for j in range(len(lower)))
        for i in range(len(lower))
    )
    if xp is np:
        for column in free:
            outside = without(outside, column)
        return outside
    shape = like.shape  # compiled once for all columns
    columns = xp.stack([xp.stack([xp.broadcast_to(x, shape) for x in one]) for one in free])
    return jax.lax.scan(lambda p, x: (without(p, x), None), outside, columns)[0]


def carried(closures: Any) -> Float[Array, "f d m"] | None:
    """N_u of each closure as a left perturbation in map a's frame; None where all is said.

    Args:
        closures: a problem, or anything else with its `measurement`, `pose_a` and `free`.
    """
    free = getattr(closures, "free", None)
    if free is None:
        return None
    module = lie.module_of(lie.group_of(closures.measurement))
    pose_a, measured = lie.components(closures.pose_a), lie.components(closures.measurement)
    adjoint = module.adjoint(module.compose(pose_a, measured))
    xp = namespace(free)
    columns = []
    for k in range(free.shape[-1]):
        column = unrolled.apply(adjoint, tuple(free[:, i, k] for i in range(free.shape[1])))
        columns.append(xp.stack(column))
    return xp.stack(columns)


def columns_of(free: Any, of_u: Any, of_v: Any) -> list[Any]:
    """The columns of N for pairs: what `of_u` and `of_v` take out of `carried`."""
    return [tuple(side) for side in (*of_u(free), *of_v(free))]


def comparable(
    squared: Float[np.ndarray, "*batch"], freedom: Any, dim: int
) -> Float[np.ndarray, "*batch"]:
    """Squared distances of d degrees of freedom that are as likely as those of fewer.

    So one gate serves all pairs: a pair of n degrees is within the gate γ² = χ²_d(p) exactly if its
    q² is within χ²_n(p). Pairs of no degree have nothing to compare: infinite, they agree with no
    other.

    Args:
        squared: q².
        freedom: degrees of each, as many or one for all.
        dim: d.
    """
    from scipy.special import gammaincc, gammainccinv

    squared = np.asarray(squared, np.float64)
    freedom = np.broadcast_to(np.asarray(freedom, np.float64), squared.shape)
    result = np.where(freedom == 0.0, np.inf, squared)
    fewer = np.flatnonzero(((freedom < dim) & (freedom > 0.0)).ravel())
    own = squared.ravel()[fewer]
    tail = gammaincc(0.5 * freedom.ravel()[fewer], 0.5 * np.maximum(own, 0.0))
    with np.errstate(invalid="ignore"):
        mapped = 2.0 * gammainccinv(0.5 * dim, tail)
    # Where the tail underflows q² is past every gate; of more degrees it would be larger still.
    result.ravel()[fewer] = np.where(np.isfinite(mapped), mapped, own)
    return result


def gates(gate: float, dim: int) -> Float[np.ndarray, " dim+1"]:
    """The gate of pairs of 0 … d degrees of freedom, as likely as γ² of d; −1 for none."""
    from scipy.special import gammaincc, gammainccinv

    tail = gammaincc(0.5 * dim, 0.5 * gate)
    found = np.full(dim + 1, -1.0)
    found[1:] = 2.0 * gammainccinv(0.5 * np.arange(1, dim + 1), tail)
    found[dim] = gate
    return found
