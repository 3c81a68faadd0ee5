"""Consistent pairs among closures whose measurements are shuffled among them. Host, NumPy.

What a shuffle leaves as it is, is found once: the maps, and G. Of q²_uv (`_closed_form`) only
T = X z Y⁻¹ and Z change. Nearly all pairs of shuffled closures contradict each other by their
headings alone. Let φ be the rotation's share of the error and M_φφ its covariance, a block of M:

    q²  ≥  φᵀ M_φφ⁻¹ φ  ≥  |φ|² / λ,     λ = λ(Ga_φφ) + λ(Gb_φφ) + λ(Σu_φφ) + λ(Σv_φφ)

with λ(·) the largest eigenvalue, since Ad(T) only turns the rotation's block. As
cos x ≥ 1 − x²/2, a pair within the gate has

    cos φ  ≥  1 − γ² λ / 2,      cos φ = R_u : R_v in the plane (first columns),
                                         (R_u : R_v − 1) / 2 in space

which one product of small matrices shows for all pairs; only those that pass are weighed. None is
where too few do for a clique as large as is asked for: closures of too low a degree leave until
none does. So the larger the set that shuffles are compared with, the less one costs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import host_scope
from pcm_jax.compiling import is_worth_compiling
from pcm_jax.consistency._closed_form import squared_one_way
from pcm_jax.consistency.graph import consistency_graph
from pcm_jax.consistency.limit import columns_of, comparable
from pcm_jax.consistency.mahalanobis import SECONDS_A_PAIR, limits_of
from pcm_jax.consistency.problem import ConsistencyProblem
from pcm_jax.lie import unrolled

if TYPE_CHECKING:
    from pcm_jax.graph import LoopClosures

PAIRS_AT_ONCE = 1 << 20
"""Pairs of closures that are looked at together, over all shuffles."""
CHUNK = 4096
"""Pairs that are weighed together: what they take stays in a core's cache."""
DENSE = 0.2
"""Share of the pairs that are left to weigh, above which a compiled program weighs all sooner."""
UNBOUNDED = 1e30
"""A variance of which single precision still knows that it is finite."""
SLACK = 1e-5
"""By which rounding to single precision may move a sum of a few cosines."""


class ConsistentPairs(NamedTuple):
    """The pairs of closures that agree, of several shuffles.

    Attributes:
        shuffle: int64 [p], ascending.
        u: int64 [p].
        v: int64 [p], greater than u.
        squared: float64 [p], the larger q² of the two directions.
    """

    shuffle: Int[np.ndarray, " p"]
    u: Int[np.ndarray, " p"]
    v: Int[np.ndarray, " p"]
    squared: Float[np.ndarray, " p"]

    def of(self, shuffle: int) -> ConsistentPairs:
        """Those of one shuffle."""
        return self.take(slice(*np.searchsorted(self.shuffle, [shuffle, shuffle + 1])))

    def take(self, some: Any) -> ConsistentPairs:
        """Those of a slice, a mask or indices."""
        return ConsistentPairs._make(each[some] for each in self)

    def peeled(self, at_least: int) -> ConsistentPairs:
        """Leaves out pairs of closures that agree with too few others for a clique so large."""
        count = 1 + int(self.v.max(initial=0))
        return self.take(_peeled(self.shuffle, self.u, self.v, count, at_least))


class ShuffledClosures:
    """The closures between two robots, ready to have their measurements shuffled.

    Args:
        problem: of the k closures, float64, see `PairEvidence.problem`.
        gate: γ².
        joined: bool [k, k], symmetric: the pairs that are of interest; None: all.
    """

    def __init__(
        self,
        problem: ConsistencyProblem,
        gate: float,
        joined: Bool[np.ndarray, "k k"] | None = None,
    ) -> None:
        count = int(np.count_nonzero(np.asarray(problem.valid)))
        self.count, self.gate = count, gate
        self._problem = problem
        self._module = lie.module_of(lie.group_of(problem.measurement))
        self._measured = _entries(problem.measurement, count)
        self._pose_a = _entries(problem.pose_a, count)
        self._from_b = self._module.inverse(_entries(problem.pose_b, count))
        self._covariance = np.asarray(problem.measurement_covariance)[:count]
        self._free = None if problem.free is None else np.asarray(problem.free)[:count]
        d = self._covariance.shape[-1]
        self._turning, axes = _rotation_entries(d), slice(2 if d == 3 else 3, d)
        own = self._covariance[:, axes, axes]
        self._own_spread = _largest_eigenvalue(unrolled.pack(unrolled.from_array(own)))
        if self._free is not None:  # headings do not tell apart what leaves a rotation unsaid
            self._own_spread[self._free[:, axes].any(axis=(1, 2))] = UNBOUNDED
        self._rows = np.asarray(problem.row_a)[:count], np.asarray(problem.row_b)[:count]
        self._relative = (
            np.asarray(problem.relative_covariance_a),
            np.asarray(problem.relative_covariance_b),
        )
        self._floor = self._least_cosines(joined)
        self._seconds = 0.0  # that weighing dense shuffles has taken in NumPy, about

    @property
    def together(self) -> int:
        """The number of shuffles that are best weighed at once."""
        return max(1, PAIRS_AT_ONCE // max(1, self.count**2))

    def weigh(self, order: Int[np.ndarray, "b k"], *, at_least: int = 0) -> ConsistentPairs:
        """Weighs shuffles; where headings tell little apart, by the compiled closed form.

        Args:
            order: `[b, k]`: closure u gets the measurement, and its covariance, of `order[·, u]`.
            at_least: size of the cliques that are of interest: pairs that no clique so large has
                may be left out.
        """
        measured = tuple(entry[order] for entry in self._measured)
        reached = self._module.compose(self._pose_a, measured)
        placed = _full(order, self._module.compose(reached, self._from_b))
        shuffle, u, v = self._near(order, placed)
        kept = _peeled(shuffle, u, v, self.count, at_least)
        shuffle, u, v = shuffle[kept], u[kept], v[kept]
        if self._free is None and len(u) > DENSE * len(order) * self.count * (self.count - 1) / 2:
            found = self._all_pairs(order, len(u))
            if found is not None:
                return found
        covariance = unrolled.from_array(self._covariance[order])
        noise = _full(order, unrolled.pack(self._module.adjoint_sandwich(reached, covariance)))
        free = None if self._free is None else self._carried(order, reached)
        larger = np.empty(len(u))
        for start in range(0, len(larger), CHUNK):
            part = slice(start, start + CHUNK)
            larger[part] = self._squared(shuffle[part], u[part], v[part], placed, noise, free)
        return ConsistentPairs(shuffle, u, v, larger).take(larger <= self.gate)

    def _all_pairs(self, order: Int[np.ndarray, "b k"], near: int) -> ConsistentPairs | None:
        """As `weigh`, of all pairs at once; None where a compiled program is not worth it yet.

        It is once these shuffles, of which nobody knows how many follow, have cost as much.
        """
        self._seconds += 2 * near * SECONDS_A_PAIR[self._covariance.shape[-1]]
        if not is_worth_compiling(self._seconds):
            return None
        found, of = [], np.arange(len(np.asarray(self._problem.valid)))
        for shuffle, each in enumerate(order):
            of[: self.count] = each
            shuffled = dataclasses.replace(
                self._problem,
                measurement=lie.take(lie.as_numpy(self._problem.measurement), of),
                measurement_covariance=np.asarray(self._problem.measurement_covariance)[of],
            )
            with host_scope():
                squared = np.asarray(limits_of(shuffled).squared)
            larger = np.fmax(squared, squared.T)
            u, v = np.nonzero((larger <= self.gate) & (self._floor < np.inf))
            found.append(ConsistentPairs(np.full(len(u), shuffle), u, v, larger[u, v]))
        parts: Any = (np.concatenate(each) for each in zip(*found, strict=True))
        return ConsistentPairs(*parts)

    def _least_cosines(self, joined: np.ndarray | None) -> Float[np.ndarray, "k k"]:
        """1 − γ² (λ(Ga_φφ) + λ(Gb_φφ)) / 2, float32; infinite where a pair is of no interest."""
        spread = np.zeros((self.count, self.count))
        for relative, rows in zip(self._relative, self._rows, strict=True):
            spread += _largest_eigenvalue([relative[k] for k in self._turning])[np.ix_(rows, rows)]
        least = 1.0 - SLACK - 0.5 * self.gate * spread
        wanted = np.ones_like(least, bool) if joined is None else joined
        return np.where(np.triu(wanted, 1), least, np.inf).astype(np.float32)

    def _near(self, order: np.ndarray, placed: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pairs (shuffle, u, v) that headings alone do not tell apart."""
        own = 0.5 * self.gate * self._own_spread[order]
        if len(self._turning) == 1:
            turned, shift = list(placed[:2]), own
        else:  # the trace of a relative rotation is 1 + 2 cos φ
            rotation = self._module.to_matrix(placed)
            half = np.sqrt(0.5)
            turned = [half * rotation[i][j] for i in range(3) for j in range(3)]
            shift = own - 0.25
        one = np.ones_like(own)
        left = np.stack([*turned, shift, one], axis=-1).astype(np.float32)
        right = np.stack([*turned, one, shift], axis=-1).astype(np.float32)
        # One by one: a stack of such products takes a hundred times as long on several threads.
        pairs = zip(left, right, strict=True)
        at = [(a @ b.T >= self._floor).ravel().nonzero()[0] for a, b in pairs]
        shuffle = np.repeat(np.arange(len(at)), [len(each) for each in at])
        return shuffle, *np.divmod(np.concatenate(at), self.count)

    def _carried(self, order: np.ndarray, reached: Any) -> Float[np.ndarray, "f d b k"]:
        """The directions that shuffled measurements leave unsaid, in map a's frame."""
        adjoint, free = self._module.adjoint(reached), self._free[order]  # type: ignore[index]
        of_each = (np.moveaxis(free[..., k], -1, 0) for k in range(free.shape[-1]))
        carried = (unrolled.apply(adjoint, tuple(column)) for column in of_each)
        return np.stack([np.stack([*_full(order, column)]) for column in carried])

    def _squared(
        self,
        shuffle: np.ndarray,
        u: np.ndarray,
        v: np.ndarray,
        placed: Any,
        noise: Any,
        free: Float[np.ndarray, "f d b k"] | None,
    ) -> Float[np.ndarray, " p"]:
        """The larger q² of either direction; infinite where the first is outside already.

        With `free` as `comparable` has it.
        """
        side_a, side_b = (
            relative[:, rows[u], rows[v]]
            for relative, rows in zip(self._relative, self._rows, strict=True)
        )
        fixed = tuple(
            side + z[shuffle, u] + z[shuffle, v] for side, z in zip(side_a, noise, strict=True)
        )
        t_u, t_v = (tuple(entry[shuffle, end] for entry in placed) for end in (u, v))
        columns = None
        if free is not None:
            columns = columns_of(free, lambda k: k[:, :, shuffle, u], lambda k: k[:, :, shuffle, v])
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            forward = self._one_way(t_u, t_v, t_v, fixed, side_b, columns)
            inside = np.flatnonzero(forward <= self.gate)
            t_u, t_v, fixed = (tuple(each[inside] for each in part) for part in (t_u, t_v, fixed))
            if columns is not None:
                columns = [tuple(entry[inside] for entry in column) for column in columns]
            backward = self._one_way(t_u, t_v, t_u, fixed, side_b[:, inside], columns)
        result = np.full(len(u), np.inf)
        result[inside] = np.where(np.isnan(backward), np.inf, np.fmax(forward[inside], backward))
        return result

    def _one_way(
        self, t_u: Any, t_v: Any, at: Any, fixed: Any, side_b: Any, free: Any
    ) -> Float[np.ndarray, " p"]:
        found = squared_one_way(self._module, t_u, t_v, at, fixed, side_b, free)
        if free is None:
            return found
        return comparable(found.squared, found.freedom, self._covariance.shape[-1])


class ShuffledByMetric:
    """Closures of a metric of one's own, with the face of `ShuffledClosures`.

    Args:
        closures: all from one robot to one other.
        metric: from closures to squared distances [k, k].
        gate: γ².
        joined: bool [k, k], the pairs that are of interest; None: all.
    """

    together = 1

    def __init__(
        self,
        closures: LoopClosures,
        metric: Callable[[LoopClosures], Float[np.ndarray, "k k"]],
        gate: float,
        joined: Bool[np.ndarray, "k k"] | None = None,
    ) -> None:
        self.count, self.gate = len(closures), gate
        self._closures, self._metric = closures, metric
        wanted = np.ones((self.count, self.count), bool) if joined is None else joined
        self._joined = np.triu(wanted, 1)

    def weigh(self, order: Int[np.ndarray, "b k"], *, at_least: int = 0) -> ConsistentPairs:
        """Weighs shuffles, one after another; see `ShuffledClosures.weigh`."""
        del at_least
        found = []
        for shuffle, each in enumerate(order):
            squared = np.asarray(self._metric(_reordered(self._closures, each)))
            agree = np.asarray(consistency_graph(squared, self.gate))  # type: ignore[arg-type]
            u, v = np.nonzero(agree & self._joined)
            larger = np.maximum(squared[u, v], squared[v, u])
            found.append((np.full(len(u), shuffle), u, v, larger))
        parts: Any = [np.concatenate(each) for each in zip(*found, strict=True)]
        return ConsistentPairs(*parts)


def _entries(transforms: Any, count: int) -> tuple[np.ndarray, ...]:
    return tuple(np.asarray(entry)[:count] for entry in lie.components(lie.as_numpy(transforms)))


def _full(order: np.ndarray, entries: Any) -> tuple[np.ndarray, ...]:
    return tuple(np.broadcast_to(entry, order.shape) for entry in entries)


def _rotation_entries(d: int) -> list[int]:
    """The rotation's block in a packed covariance, itself packed."""
    first = 2 if d == 3 else 3
    return [k for k, (i, j) in enumerate(unrolled.packed_indices(d)) if min(i, j) >= first]


def _largest_eigenvalue(packed: Sequence[np.ndarray]) -> np.ndarray:
    """λ of symmetric matrices of one row or three: by the cubic's trigonometric solution."""
    if len(packed) == 1:
        return np.array(packed[0])
    entries = dict(zip(unrolled.packed_indices(3), packed, strict=True))
    mean = (entries[0, 0] + entries[1, 1] + entries[2, 2]) / 3.0
    x, y, z = (entries[k, k] - mean for k in range(3))
    a, b, c = entries[1, 0], entries[2, 0], entries[2, 1]
    spread = np.sqrt((x * x + y * y + z * z + 2.0 * (a * a + b * b + c * c)) / 6.0)
    determinant = x * (y * z - c * c) - a * (a * z - b * c) + b * (a * c - b * y)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.where(spread > 0.0, determinant / (2.0 * spread**3), 1.0)
    return mean + 2.0 * spread * np.cos(np.arccos(np.clip(cosine, -1.0, 1.0)) / 3.0)


def _peeled(
    shuffle: np.ndarray, u: np.ndarray, v: np.ndarray, count: int, at_least: int
) -> Int[np.ndarray, " q"]:
    """Indices of the pairs left when closures with too few for a clique so large have gone."""
    kept = np.arange(len(u))
    while at_least > 2 and len(kept):
        ends = shuffle[kept] * count + u[kept], shuffle[kept] * count + v[kept]
        degree = np.bincount(np.concatenate(ends))
        enough = (degree[ends[0]] >= at_least - 1) & (degree[ends[1]] >= at_least - 1)
        if enough.all():
            break
        kept = kept[enough]
    return kept


def _reordered(closures: LoopClosures, order: np.ndarray) -> LoopClosures:
    return dataclasses.replace(
        closures,
        measurement=lie.take(lie.as_numpy(closures.measurement), order),
        information=np.asarray(closures.information)[order],
        weight=np.asarray(closures.weight)[order],
    )
