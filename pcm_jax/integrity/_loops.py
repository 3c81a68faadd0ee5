"""The loops of single pairs of closures: how far each misses, and through whose errors it may.

As in the closed form of eq. 4 (`consistency`), with T_u = X_i z_u Y_k⁻¹ where closure u alone puts
map b, S_u = X_i z_u, and left perturbations in the maps' frames,

    r = Log(T_v T_u⁻¹),    M = Ga_ij + Ad(T_v) Gb_kl Ad(T_v)ᵀ + Z_u + Z_v,    q²_uv = rᵀ M⁻¹ r

but for chosen pairs instead of all, in NumPy: of each map only the columns of its covariance that
pairs ask for are found (`MapCovariance.columns`), so neither Q nor a joint covariance is held.

Walked from the end of closure u, the loop ends at E = S_u⁻¹ T_v T_u⁻¹ S_u instead of at its start.
It misses by |t| metres and |θ| radians, t and θ those of E. An error e of M moves E to
`exp(Ad(S_u⁻¹) e) E`, and to first order |t| and |θ| by its parts along t and θ: hence the sigmas.
Parts of M's sum take part in q² as wᵀ(·)w with w = M⁻¹ r, which add up to q²: the shares.

Where closures leave directions N unsaid (`consistency.limit`), only what no step along N can mend
counts: with M = L Lᵀ and P the projector to what the span of L⁻¹ N leaves, r becomes L P L⁻¹ r, its
covariance L P Lᵀ, and w = L⁻ᵀ P L⁻¹ r. Distances are then as `PairEvidence.comparable` has them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.consistency.limit import comparable, outside_of
from pcm_jax.graph import LoopClosures
from pcm_jax.graph.unsaid import noise_of
from pcm_jax.lie import unrolled
from pcm_jax.mapping import MapCovariance

PARTNERS, PAIRS = 32, 50_000
"""Partners of which columns of a map's covariance are held at a time, and pairs: 90 MB in space."""


class Misses(NamedTuple):
    """The loops of p pairs of closures, each walked the way in which it fits worse.

    Attributes:
        squared: `[p]`, the larger of q²_uv and q²_vu; of fewer than d degrees of freedom, as likely
            with d.
        translation: `[p]`, metres by which the loop misses.
        rotation: `[p]`, radians.
        sigma: `[p, 2]`, their standard deviations for two right closures; metres, radians.
        shares: `[p, 3]`, of map a, map b and the two measurements in q²; they add up to 1.
    """

    squared: Float[np.ndarray, " p"]
    translation: Float[np.ndarray, " p"]
    rotation: Float[np.ndarray, " p"]
    sigma: Float[np.ndarray, "p 2"]
    shares: Float[np.ndarray, "p 3"]


class _Weighed(NamedTuple):
    """Errors of p loops, weighed by their covariances.

    Attributes:
        squared: `[p]`, q², comparable.
        error: `[p, d]`, the part of r that counts.
        covariance: `[p, d, d]`, of it.
        weight: `[p, d]`, w.
    """

    squared: Any
    error: Any
    covariance: Any
    weight: Any


class Loops:
    """The loops that a pair of robots' closures make, of as many pairs as are asked for.

    Args:
        covariances: a `MapCovariance` of map a and of map b.
        closures: all from a to b.
    """

    def __init__(self, covariances: tuple[MapCovariance, MapCovariance], closures: LoopClosures):
        a, b = covariances
        poses = np.asarray(closures.pose_a), np.asarray(closures.pose_b)
        measured = lie.as_numpy(closures.measurement)
        self.reached = lie.compose(lie.take(a.frame, poses[0]), measured)
        self.placed = lie.compose(self.reached, lie.inverse(lie.take(b.frame, poses[1])))
        information = np.asarray(closures.information, np.float64)
        adjoint = np.asarray(lie.adjoint(self.reached))
        noise, free = noise_of(information)
        self._noise = adjoint @ noise @ adjoint.swapaxes(1, 2)
        self._free = None if free is None else adjoint @ free
        self._sides = _Side(a, poses[0]), _Side(b, poses[1])

    def squared(
        self, rows: Int[np.ndarray, " r"], columns: Int[np.ndarray, " c"]
    ) -> Float[np.ndarray, "r c"]:
        """The larger of q²_uv and q²_vu of all u in `rows` and v in `columns`; 0 for u = v."""
        if len(columns) > len(rows):
            return self.squared(columns, rows).T
        u, v = np.repeat(rows, len(columns)), np.tile(columns, len(rows))
        found = np.zeros(len(u))
        for some in self._portions(v):
            error, parts = self._parts(u[some], v[some])
            found[some] = self._both_ways(error, parts, u[some], v[some]).max(axis=1)
        return np.where(u == v, 0.0, found).reshape(len(rows), len(columns))

    def misses(self, u: Int[np.ndarray, " p"], v: Int[np.ndarray, " p"]) -> Misses:
        """Walks the loops of pairs of closures."""
        found = Misses(*(np.zeros((len(u), *shape)) for shape in ((), (), (), (2,), (3,))))
        for some in self._portions(v):
            for whole, own in zip(found, self._missed(u[some], v[some]), strict=True):
                whole[some] = own
        return found

    def of_maps(self) -> tuple[Float[np.ndarray, "k k d d"], Float[np.ndarray, "k k d d"]]:
        """G of map a and of map b, in either's own frame, for every two closures."""
        count, d = self._noise.shape[:2]
        u, v = np.repeat(np.arange(count), count), np.tile(np.arange(count), count)
        found = [np.zeros((count * count, d, d)) for _ in self._sides]
        for some in self._portions(v):
            for whole, side in zip(found, self._sides, strict=True):
                whole[some] = side.between(u[some], v[some])
        of_a, of_b = (whole.reshape(count, count, d, d) for whole in found)
        return of_a, of_b

    def whitened(self, u: Int[np.ndarray, " p"], v: Int[np.ndarray, " p"]) -> Any:
        """L⁻¹ of each pair's M = L Lᵀ, `[p, d, d]`: with it r is of unit covariance.

        Of zero covariance along what closures leave unsaid: it is P L⁻¹.
        """
        _, parts = self._parts(u, v)
        lower = np.linalg.cholesky(parts[:, :, 0].sum(axis=1))
        white = np.linalg.inv(lower)
        free = self._unsaid(u, v)
        return white if free is None else _outside(lower, free) @ white

    def _portions(self, partners: Int[np.ndarray, " p"]) -> list[Int[np.ndarray, " q"]]:
        """The pairs, cut into portions of few partners and few pairs."""
        which, counts = np.unique(partners, return_inverse=True, return_counts=True)[1:]
        ends, held, last = [], 0, 0
        for partner, count in enumerate(counts.tolist()):
            if held and (held + count > PAIRS or partner - last == PARTNERS):
                ends.append(partner)
                held, last = 0, partner
            held += count
        order = np.argsort(which, kind="stable")
        return np.split(order, np.searchsorted(which[order], ends))

    def _parts(
        self, u: Int[np.ndarray, " p"], v: Int[np.ndarray, " p"]
    ) -> tuple[Float[np.ndarray, "p d"], Float[np.ndarray, "p 3 2 d d"]]:
        """The error r of each loop, and what the maps and the closures add to M, either way."""
        t_u, t_v = lie.take(self.placed, u), lie.take(self.placed, v)
        error = np.asarray(lie.log(lie.compose(t_v, lie.inverse(t_u))))
        of_a, of_b = (side.between(u, v) for side in self._sides)
        turned = [_carried(np.asarray(lie.adjoint(t)), of_b) for t in (t_v, t_u)]
        noise = self._noise[u] + self._noise[v]
        parts = [np.stack(both, axis=1) for both in ((of_a, of_a), turned, (noise, noise))]
        return error, np.stack(parts, axis=1)

    def _both_ways(
        self, error: Any, parts: Any, u: Int[np.ndarray, " p"], v: Int[np.ndarray, " p"]
    ) -> Float[np.ndarray, "p 2"]:
        """q²_uv and q²_vu, comparable."""
        ways = (parts[:, :, way].sum(axis=1) for way in (0, 1))
        return np.stack([self._weighed(error, way, u, v).squared for way in ways], axis=1)

    def _weighed(
        self, error: Any, total: Any, u: Int[np.ndarray, " p"], v: Int[np.ndarray, " p"]
    ) -> _Weighed:
        free = self._unsaid(u, v)
        if free is None:
            weight = _solved(total, error)
            return _Weighed(np.einsum("pd,pd->p", weight, error), error, total, weight)
        lower = np.linalg.cholesky(total)
        outside = _outside(lower, free)
        left = np.einsum("pij,pj->pi", outside, _solved(lower, error))
        squared = comparable(
            np.einsum("pd,pd->p", left, left),
            np.round(np.trace(outside, axis1=1, axis2=2)),
            error.shape[1],
        )
        counting = np.einsum("pij,pj->pi", lower, left)
        weight = _solved(lower.swapaxes(1, 2), left)
        return _Weighed(squared, counting, lower @ outside @ lower.swapaxes(1, 2), weight)

    def _unsaid(
        self, u: Int[np.ndarray, " p"], v: Int[np.ndarray, " p"]
    ) -> Float[np.ndarray, "p d f"] | None:
        """N of each pair; None where all is said."""
        if self._free is None:
            return None
        return np.concatenate([self._free[u], self._free[v]], axis=2)

    def _missed(self, u: Int[np.ndarray, " p"], v: Int[np.ndarray, " p"]) -> Misses:
        error, parts = self._parts(u, v)
        both = self._both_ways(error, parts, u, v)
        backward = both[:, 1] > both[:, 0]
        parts = np.where(backward[:, None, None, None], parts[:, :, 1], parts[:, :, 0])
        weighed = self._weighed(error, parts.sum(axis=1), u, v)
        shares = np.einsum("pi,psij,pj->ps", weighed.weight, parts, weighed.weight)
        about = lie.take(self.reached, np.where(backward, v, u))
        way: Any = np.where(backward, -1.0, 1.0)[:, None] * weighed.error
        back = lie.inverse(about)
        loop = lie.compose(lie.compose(back, lie.exp(lie.group_of(about), way)), about)
        seen = _carried(np.asarray(lie.adjoint(back)), weighed.covariance)
        translation = np.asarray(lie.translation(loop))
        space = translation.shape[1]
        rotation = np.asarray(lie.log(loop))[:, space:]
        sigma = np.stack(
            [
                _along(translation, seen[:, :space, :space]),
                _along(rotation, seen[:, space:, space:]),
            ],
            axis=1,
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = shares / shares.sum(axis=1, keepdims=True)
        lengths = np.linalg.norm(translation, axis=1), np.linalg.norm(rotation, axis=1)
        return Misses(both.max(axis=1), *lengths, sigma, shares)


class _Side:
    """One map: G of any pairs of closures, from columns of its covariance."""

    def __init__(self, covariance: MapCovariance, touching: Int[np.ndarray, " k"]):
        self._covariance, self._touching = covariance, touching
        self._own: dict[int, np.ndarray] = {}

    def between(
        self, u: Int[np.ndarray, " p"], v: Int[np.ndarray, " p"]
    ) -> Float[np.ndarray, "p d d"]:
        """G_ij = Σ_ii + Σ_jj − Σ_ij − Σ_ijᵀ of the poses that closures u and v touch."""
        rows, row = np.unique(self._touching[u], return_inverse=True)
        columns, column = np.unique(self._touching[v], return_inverse=True)
        found = self._covariance.columns(columns, side="left").rows(rows, side="left")
        cross = found[row, :, :, column]
        same: Bool[np.ndarray, " p"] = self._touching[u] == self._touching[v]
        own = self._diagonal(rows)[row] + self._diagonal(columns)[column]
        return np.where(same[:, None, None], 0.0, own - cross - cross.swapaxes(1, 2))

    def _diagonal(self, poses: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n d d"]:
        missing = np.array([pose for pose in poses.tolist() if pose not in self._own], np.int64)
        if len(missing):
            own = self._covariance.diagonal(missing, side="left")
            self._own |= dict(zip(missing.tolist(), own, strict=True))
        return np.stack([self._own[pose] for pose in poses.tolist()])


def _carried(adjoint: Float[np.ndarray, "p d d"], covariance: Any) -> Float[np.ndarray, "p d d"]:
    return adjoint @ covariance @ adjoint.swapaxes(1, 2)


def _outside(
    lower: Float[np.ndarray, "p d d"], free: Float[np.ndarray, "p d f"]
) -> Float[np.ndarray, "p d d"]:
    """P of each pair, see `consistency.limit`."""
    entries: unrolled.Matrix = tuple(tuple(row) for row in lower.transpose(1, 2, 0))
    rows = outside_of(entries, [tuple(column) for column in free.transpose(2, 1, 0)])
    return np.stack([np.stack(row) for row in rows]).transpose(2, 0, 1)


def _solved(matrices: Any, vectors: Any) -> Float[np.ndarray, "p d"]:
    """M⁻¹ r; NaN where M is singular."""
    try:
        return np.linalg.solve(matrices, vectors[..., None])[..., 0]
    except np.linalg.LinAlgError:
        singular = np.linalg.matrix_rank(matrices) < matrices.shape[-1]
        safe = np.where(singular[:, None, None], np.eye(matrices.shape[-1]), matrices)
        return np.where(
            singular[:, None], np.nan, np.linalg.solve(safe, vectors[..., None])[..., 0]
        )


def form(matrices: Any, vectors: Any) -> Float[np.ndarray, " p"]:
    """The squares rᵀ M⁻¹ r; NaN where M is singular."""
    return np.einsum("pd,pd->p", vectors, _solved(matrices, vectors))


def _along(vectors: Float[np.ndarray, "p s"], covariance: Float[np.ndarray, "p s s"]) -> Any:
    """The standard deviation of a vector's length; of one of no length, that of a mean axis."""
    length = np.linalg.norm(vectors, axis=1)
    none = length < np.finfo(float).tiny
    unit = vectors / np.where(none, 1.0, length)[:, None]
    mean = np.trace(covariance, axis1=1, axis2=2) / vectors.shape[1]
    return np.sqrt(np.where(none, mean, np.einsum("pi,pij,pj->p", unit, covariance, unit)))
