"""Information that lacks directions: its rank, and what a closure leaves unsaid.

A planar or a 4-DoF closure between maps in space has zeros in its information: of some directions
it says nothing. Such an Ω is kept as it is. Its covariance is finite where it says something and
without bound elsewhere, so it is handed on in two parts, of which only the span of the second
matters (`consistency.limit` lets the variance along it grow without bound, exactly):

    Z = S V diag(1/λ, fill) Vᵀ S,     N = S V₀,      S Ω S = V diag(λ, 0) Vᵀ,   Sᵢᵢ = Ωᵢᵢ^(−1/2)

What is zero is decided after scaling Ω to a diagonal of ones, so that units play no part.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

AXES = {1: ("x",), 3: ("x", "y", "yaw"), 6: ("x", "y", "z", "roll", "pitch", "yaw")}
"""What the directions are called, by d."""
ALONG = 1e-6
"""Share of a direction off its axis below which it is called by it."""
ZERO = 1e-12
"""Eigenvalues of scaled information that are rounding: turning a closure round leaves 1e-15."""
FILL = 100.0
"""Variance along unsaid directions, in units of the stated ones: any value gives the same q²."""
TURN_VARIANCE, SHIFT_VARIANCE = 1e-2, 1.0  # rad², m²: where nothing of the kind is stated
TINY = 1e-14
"""Of the largest entry of its kind on the diagonal: smaller ones are rounding too."""
HELD = 1e-9
"""Information along unsaid directions in a solve, of the matrix's largest eigenvalue."""
INFLATED = 1e-2 / ZERO
"""Ωᵢᵢ Zᵢᵢ below which no eigenvalue of scaled information can be rounding."""


def ranks(information: Float[np.ndarray, "m d d"]) -> Int[np.ndarray, " m"]:
    """The rank of each symmetric matrix `[m, d, d]`; −1 where it has a negative eigenvalue."""
    values = np.linalg.eigvalsh(_scaled(information)[0])
    count = (values > ZERO).sum(axis=1)
    return np.where((values < -ZERO).any(axis=1), -1, count)


def said(information: Float[np.ndarray, "m d d"]) -> Float[np.ndarray, "m d d"]:
    """Computes projections of residuals `[m, d, d]` to what is said of them: rᵀ Ω r is unchanged.

    What is taken out are the directions N that the information leaves unsaid, along which a
    residual means nothing.
    """
    result = np.tile(np.eye(information.shape[-1]), (len(information), 1, 1))
    for row in np.flatnonzero(rank_deficient(information)):
        scaled, scale = _scaled(information[row][None])
        values, vectors = np.linalg.eigh(scaled[0])
        kept = vectors[:, values > ZERO]
        result[row] = scale[0][:, None] * (kept @ kept.T) / scale[0][None, :]
    return result


def noise_of(
    information: Float[np.ndarray, "m d d"],
) -> tuple[Float[np.ndarray, "m d d"], Float[np.ndarray, "m d f"] | None]:
    """The covariance of measurements, and the directions that they say nothing of.

    Args:
        information: `[m, d, d]`, positive semidefinite; over (translation, rotation).

    Returns:
        Covariances, some finite value in place of those without bound; and a basis of the unsaid
        directions, filled up with zeros to as many columns for each. None where all is said.
    """
    if not len(information):
        return np.zeros(information.shape), None
    inverse = _inverse(information)
    if inverse is not None:
        own = np.diagonal(information, axis1=1, axis2=2) * np.diagonal(inverse, axis1=1, axis2=2)
        if np.abs(own).max(initial=0.0) < INFLATED:
            return inverse, None
    scaled, scale = _scaled(information)
    values, vectors = np.linalg.eigh(scaled)
    zero = values <= ZERO
    if not zero.any():
        return np.linalg.inv(information), None
    variances = np.where(zero, FILL, 1.0 / np.where(zero, 1.0, values))
    turned = scale[:, :, None] * vectors
    covariance = (turned * variances[:, None, :]) @ np.swapaxes(turned, 1, 2)
    free = (turned * zero[:, None, :])[
        :, :, : int(zero.sum(axis=1).max())
    ]  # ascending: zeros first
    return 0.5 * (covariance + np.swapaxes(covariance, 1, 2)), free


def held(information: Float[np.ndarray, "m d d"]) -> Float[np.ndarray, "m d d"]:
    """Information for a solve: unsaid directions get 1e-9 of the matrix's largest eigenvalue.

    So what no closure determines stays as the closures' measurements have it, and what some
    determine moves by a billionth. Matrices of full rank are returned as they are.
    """
    lacking = np.flatnonzero(rank_deficient(information))
    if not lacking.size:
        return information
    largest = np.linalg.eigvalsh(information[lacking])[:, -1, None, None]
    _, free = noise_of(information[lacking])
    result = np.array(information)
    if free is not None:
        basis = np.linalg.svd(free, full_matrices=False)
        along = basis[0] * (basis[1] > ZERO * basis[1][:, :1])[:, None, :]
        result[lacking] += HELD * largest * (along @ np.swapaxes(along, 1, 2))
    return result


def told(information: Float[np.ndarray, "m d d"]) -> Iterator[str]:
    """Says how many closures leave directions unsaid, one line for each kind.

    Args:
        information: of the closures.
    """
    lacking, d = rank_deficient(information), information.shape[-1]
    rows = np.flatnonzero(lacking)
    kinds = Counter(
        (int(rank), *_axes(information[row]))
        for row, rank in zip(
            rows.tolist(), ranks(information[rows]).tolist() if rows.size else [], strict=True
        )
    )
    for (rank, *axes), count in sorted(kinds.items()):
        named = f" ({', '.join(axes)})" if axes else ""
        yield (
            f"{count} of {len(information)} closures say {rank} of {d} degrees of freedom{named}:"
            " judged with as many as two of them have in common"
        )


def _axes(information: Float[np.ndarray, "d d"]) -> tuple[str, ...]:
    """The axes that are said, where what is said lies along axes; else nothing."""
    values, vectors = np.linalg.eigh(_scaled(information[None])[0][0])
    share = (vectors[:, values > ZERO] ** 2).sum(axis=1)
    if (np.minimum(share, 1.0 - share) > ALONG).any():
        return ()
    names = AXES[len(information)]
    return tuple(name for name, part in zip(names, share, strict=True) if part > 0.5)


def rank_deficient(information: Float[np.ndarray, "m d d"]) -> np.ndarray:
    """Marks the matrices `[m]` of less than full rank."""
    if not len(information):
        return np.zeros(0, bool)
    return ranks(information) < information.shape[-1]


def _inverse(information: np.ndarray) -> np.ndarray | None:
    try:
        return np.linalg.inv(information)
    except np.linalg.LinAlgError:
        return None


def _scaled(information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """S Ω S and the diagonal of S, which of an axis that is not stated is that of its kind."""
    d = information.shape[-1]
    space = {1: 1, 3: 2, 6: 3}[d]
    variance = np.empty((len(information), d))
    for kind, otherwise in ((slice(0, space), SHIFT_VARIANCE), (slice(space, d), TURN_VARIANCE)):
        own = np.diagonal(information, axis1=1, axis2=2)[:, kind]
        least = np.maximum(TINY * own.max(axis=1, initial=0.0), np.finfo(np.float64).tiny)
        stated = own > least[:, None]
        each = np.where(stated, 1.0 / np.where(stated, own, 1.0), 0.0)
        mean = each.sum(axis=1) / np.maximum(stated.sum(axis=1), 1)
        mean = np.where(stated.any(axis=1), mean, otherwise)
        variance[:, kind] = np.where(stated, each, mean[:, None])
    scale = np.sqrt(variance)
    return scale[:, :, None] * information * scale[:, None, :], scale
