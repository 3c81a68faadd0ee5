"""`GrowingPair`: closures between two robots that come one by one, and which of them agree.

What Q needs of a closure by itself (`_closed_form`: where it puts map b, T, and its own noise, Z)
is kept; of the maps' covariance only the block of each touched pose. What a new closure adds to G,

    G_ij = C_ii + C_jj − C_ij − C_ijᵀ     of a new pose i and all j so far,

takes one column of each map's covariance (`MapCovariance.column`), and is not kept: memory is that
of the closures. Most new closures need none. The covariance of a difference is at most

    G_ij  ⪯  2 (C_ii + C_jj)

so M (`_closed_form`) with these in place of Ga and Gb is too large, and q² by it too small: pairs
that it tells apart are apart. A false closure is mostly told from all others by that alone. For
most pairs the trace of M's translations, which is at least its largest eigenvalue, says as much: of
T_v T_u⁻¹ the translation is as long as that between T_u⁻¹ and T_v⁻¹, and Log shortens none.

Left perturbations are in a frame that stays (`MapCovariance.origin`), so what was found before
stays true. Host; a row of Q is computed in NumPy until compiling pays.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.compiling import is_worth_compiling
from pcm_jax.consistency._closed_form import squared_one_way
from pcm_jax.consistency.limit import carried, comparable
from pcm_jax.consistency.mahalanobis import SECONDS_A_PAIR
from pcm_jax.graph import LoopClosures
from pcm_jax.graph.unsaid import noise_of
from pcm_jax.lie import unrolled
from pcm_jax.mapping import MapCovariance

AT_ONCE = 256
"""Closures that a compiled row is padded to: one program serves any number of them."""
SMALLEST = 64
"""Closures that there is room for at first; then twice as many, again and again."""
ROUNDING = 1e-6
"""By which rounding may move a bound, relative to the gate: far more than it does."""
WORTH = 1000
"""Pairs that take NumPy as long as all of its calls for a row take by themselves."""
WAYS = 0, 1
"""Directions of a pair of closures, u so far and v new: q²_uv and q²_vu."""


class GrowingPair:
    """The closures between two robots, one more at a time.

        pair = GrowingPair(covariances, gate)
        for one in closures:
            agrees = pair.agreeing(one)     # with those so far
            pair.append()

    Args:
        covariances: of map a and of map b.
        gate: γ².
    """

    def __init__(self, covariances: tuple[MapCovariance, MapCovariance], gate: float) -> None:
        self.covariances, self.gate = covariances, gate
        self.count = 0
        group = covariances[0].pose_graph.group
        self._module, self._dim = lie.module_of(group), lie.tangent_dim(group)
        packed = self._dim * (self._dim + 1) // 2
        entries = lie.parameters(lie.identity(group)).shape[-1]
        ends = np.cumsum([entries, packed, packed, packed, self._dim**2])
        self._parts = [slice(a, b) for a, b in zip([0, *ends[:-1]], ends, strict=True)]
        self._numbers = np.zeros((int(ends[-1]), SMALLEST))
        self._reach = np.zeros((len(self._reach_of(self._numbers)), SMALLEST))
        self._poses = np.zeros((2, SMALLEST), np.int64)
        self._unsaid = np.zeros(SMALLEST, bool)

    def __len__(self) -> int:
        return self.count

    @on_host
    def agreeing(self, one: LoopClosures) -> Bool[np.ndarray, " m"]:
        """Marks the closures so far that a further one agrees with; it is not taken in by that.

        Args:
            one: a single closure, from robot a to robot b.

        Raises:
            InputError: for a map whose information is singular.
        """
        self._next = new = self._one(one)
        agrees = np.zeros(self.count, bool)
        left = np.arange(self.count)
        old = self._numbers[:, : self.count]
        if not (new.unsaid or self._unsaid[: self.count].any()):
            left = self._not_apart(old, new)
        if len(left):
            old = old[:, left]
            squared = self._row(old, new, self._sides(old, new, self._poses[:, left]))
            agrees[left] = (squared <= self.gate).all(axis=0)
        return agrees

    def append(self) -> None:
        """Takes in the closure that `agreeing` was asked about last."""
        if self.count == len(self._unsaid):
            self._double()
        self._numbers[:, self.count] = self._next.numbers[:, 0]
        self._reach[:, self.count] = self._next.reach[:, 0]
        self._poses[:, self.count] = self._next.poses
        self._unsaid[self.count] = self._next.unsaid
        self.count += 1

    @on_host
    def take_in(self, closures: LoopClosures) -> None:
        """Takes in many closures, without weighing them against any.

        Args:
            closures: from robot a to robot b.

        Raises:
            InputError: as `agreeing`.
        """
        owns = []
        for covariance, touched in zip(
            self.covariances, (closures.pose_a, closures.pose_b), strict=True
        ):
            poses, at = np.unique(np.asarray(touched), return_inverse=True)
            owns.append(_twice(covariance.diagonal(poses, side="left"))[:, at] / 2.0)
        numbers, unsaid = self._kept(closures, owns)
        count = self.count + len(closures)
        while count > len(self._unsaid):
            self._double()
        some = slice(self.count, count)
        self._numbers[:, some], self._reach[:, some] = numbers, self._reach_of(numbers)
        self._poses[:, some] = closures.pose_a, closures.pose_b
        self._unsaid[some], self.count = unsaid, count

    def moved_to(self, other: GrowingPair) -> Float[np.ndarray, " m"]:
        """Bounds how far distances move as closures do: q of two by at most the sum of theirs.

        The same closures in maps that changed have T exp'd by τ and C less by D. With M ⪰ Z_u + Z_v
        (module docstring; the loop's own adjoint taken for the identity, as it is where closures
        nearly agree) the error r moves by at most ‖τ_u‖ + ‖τ_v‖ in the metric of M⁻¹, and M by at
        most 2 (D_u + D_v), which is the fraction δ of Z_u + Z_v that it is of either. So

            |q' − q|  ≤  Σ ‖τ‖_Z⁻¹ + γ Σ (1 / √(1 − δ) − 1)     for q up to γ,

        exact for maps that information was only added to, else to first order.

        Args:
            other: of the same closures, in their order.
        """
        some = slice(0, self.count)
        was, now = self._numbers[:, some], other._numbers[:, some]
        (t, z, *owns, _), (t_now, _, *owns_now, _) = (
            [table[part] for part in self._parts] for table in (was, now)
        )
        t_was, t_is = tuple(t), tuple(t_now)
        shift = np.stack(self._module.log(self._module.compose(t_is, self._module.inverse(t_was))))
        lower = np.linalg.cholesky(_unpacked(z, self._dim))
        turned = np.linalg.solve(lower, shift.T[..., None])[..., 0]
        less = np.zeros(self.count)
        adjoint = np.asarray(lie.adjoint(lie.group_of(self.covariances[0].frame)(t.T)))
        for side, (before, after) in enumerate(zip(owns, owns_now, strict=True)):
            change = _unpacked(after - before, self._dim)
            change = adjoint @ change @ adjoint.swapaxes(1, 2) if side else change
            whitened = np.linalg.solve(lower, change)
            whitened = np.linalg.solve(lower, whitened.swapaxes(1, 2))
            less += 2.0 * np.abs(np.linalg.eigvalsh(whitened)).max(axis=1, initial=0.0)
        with np.errstate(divide="ignore"):
            narrowed = 1.0 / np.sqrt(np.maximum(0.0, 1.0 - less)) - 1.0
        return np.linalg.norm(turned, axis=1) + np.sqrt(self.gate) * narrowed

    def keep(self, slots: Bool[np.ndarray, " m"], other: GrowingPair) -> None:
        """Takes what `other` holds of some closures for what is held of them here."""
        rows = np.flatnonzero(slots)
        self._numbers[:, rows] = other._numbers[:, rows]
        self._reach[:, rows] = other._reach[:, rows]

    def copy(self) -> GrowingPair:
        """Copies the state; until one of the two has room to make, tables are shared.

        What is appended lies behind the count, so the copy of before goes on where it was; of two
        that both go on only the last one is good.
        """
        return copy.copy(self)

    def remove(self, slot: int) -> None:
        """Takes a closure out; those behind it move up by one."""
        self._each_table(
            lambda of: np.concatenate(
                [of[..., :slot], of[..., slot + 1 :], of[..., [slot]]], axis=-1
            )
        )
        self.count -= 1

    def _double(self) -> None:
        self._each_table(lambda table: np.concatenate([table, np.zeros_like(table)], axis=-1))

    def _each_table(self, change: Callable[[np.ndarray], np.ndarray]) -> None:
        tables = self._numbers, self._reach, self._poses, self._unsaid
        self._numbers, self._reach, self._poses, self._unsaid = map(change, tables)

    def _one(self, one: LoopClosures) -> _One:
        poses = int(one.pose_a[0]), int(one.pose_b[0])
        owns = [
            _twice(covariance.own(pose)[None]) / 2.0
            for covariance, pose in zip(self.covariances, poses, strict=True)
        ]
        numbers, unsaid = self._kept(one, owns)
        return _One(numbers, self._reach_of(numbers), poses, unsaid)

    def _kept(
        self, closures: LoopClosures, owns: list[np.ndarray]
    ) -> tuple[Float[np.ndarray, "s c"], bool]:
        """The numbers that are kept of closures, and whether any leaves directions unsaid."""
        covariance, free = noise_of(np.asarray(closures.information, np.float64))
        frame_a, frame_b = (
            lie.take(each.frame, np.asarray(touched))
            for each, touched in zip(
                self.covariances, (closures.pose_a, closures.pose_b), strict=True
            )
        )
        measured = lie.as_numpy(closures.measurement)
        reached = lie.compose(frame_a, measured)
        adjoint = np.asarray(lie.adjoint(reached))
        placed = np.asarray(lie.parameters(lie.compose(reached, lie.inverse(frame_b)))).T
        noise = _twice(adjoint @ covariance @ adjoint.swapaxes(1, 2)) / 2.0
        unsaid = np.zeros((self._dim, self._dim, len(closures)))
        if free is not None:
            unsaid[: free.shape[-1]] = carried(_Unsaid(measured, frame_a, free))
        parts = placed, noise, *owns, unsaid.reshape(self._dim**2, -1)
        return np.concatenate(parts), free is not None

    def _not_apart(self, old: Float[np.ndarray, "s n"], new: _One) -> Int[np.ndarray, " k"]:
        """Finds those that the bounds do not tell from a new one, in one direction, then both."""
        gate = self.gate * (1.0 + ROUNDING)
        squared, largest = self._lengths(
            self._reach[:, : old.shape[1]], self._reach_of(new.numbers)
        )
        left = np.flatnonzero(~(squared > gate * largest))
        for way in WAYS:
            if len(left):
                (bound,) = self._row(old[:, left], new, self._bounds(old[:, left], new), (way,))
                left = left[~(bound > gate)]
        return left

    def _reach_of(self, numbers: Float[np.ndarray, "s n"]) -> Float[np.ndarray, "r n"]:
        """Takes of T⁻¹ the translation and its square; traces of 2 C_a + Z and, twice, 4 C_b."""
        placed, noise, own_a, own_b, _ = (numbers[part] for part in self._parts)
        packed = [k for k, (i, j) in enumerate(unrolled.packed_indices(self._dim)) if i == j]
        space = self._module.MATRIX_DIM - 1
        there, turned = packed[:space], packed[space:]
        away = np.stack(self._module.inverse(tuple(placed))[-space:])
        return np.concatenate(
            [
                away,
                np.sum(away * away, axis=0, keepdims=True),
                np.sum(2.0 * own_a[there] + noise[there], axis=0, keepdims=True),
                np.sum(4.0 * own_b[there], axis=0, keepdims=True),
                np.sum(4.0 * own_b[turned], axis=0, keepdims=True),
            ]
        )

    def _lengths(
        self, old: Float[np.ndarray, "r n"], new: Float[np.ndarray, "r 1"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Squared translations of T_v T_u⁻¹, and more than the largest eigenvalue of theirs in M.

        For X ⪰ 0 the translations' block of Ad(T) X Ad(T)ᵀ has at most the trace
        2 (tr X_tt + |t|² tr X_rr).
        """
        apart = old[:-4] - new[:-4]
        fixed, there, turned = old[-3:] + new[-3:]
        nearer = np.minimum(old[-4], new[-4])
        return np.sum(apart * apart, axis=0), fixed + there + nearer * turned

    def _bounds(self, old: Float[np.ndarray, "s n"], new: _One) -> list[np.ndarray]:
        """More than Ga_ij and Gb_ij, packed: 2 (C_ii + C_jj)."""
        return [2.0 * (old[part] + new.numbers[part]) for part in self._parts[2:4]]

    def _sides(
        self, old: Float[np.ndarray, "s n"], new: _One, poses: Int[np.ndarray, "2 n"]
    ) -> list[np.ndarray]:
        """Ga_ij and Gb_ij, packed, of the new closure's poses i and some others."""
        return [
            old[part] + new.numbers[part] - _twice(covariance.column(pose, others))
            for part, covariance, pose, others in zip(
                self._parts[2:4], self.covariances, new.poses, poses, strict=True
            )
        ]

    def _row(
        self,
        old: Float[np.ndarray, "s n"],
        new: _One,
        sides: list[np.ndarray],
        ways: tuple[int, ...] = WAYS,
    ) -> Float[np.ndarray, "w n"]:
        """q² of some closures with a new one, a row for each direction."""
        of_old, of_new = ([table[part] for part in self._parts] for table in (old, new.numbers))
        t_u, t_v = of_old[0], of_new[0]
        fixed, side_b = sides[0] + of_old[1] + of_new[1], sides[1]
        unsaid = [each for each in (of_old[4], of_new[4]) if each.any()]
        count = old.shape[1]
        so_far = 2 * self.count * max(count, WORTH) * SECONDS_A_PAIR[self._dim]
        if unsaid or not is_worth_compiling(so_far):
            return np.stack([self._in_numpy(t_u, t_v, fixed, side_b, way, unsaid) for way in ways])
        compiled, at = _compiled(self._module), (np.broadcast_to(t_v, t_u.shape), t_u)
        found = np.empty((len(ways), count))
        for start in range(0, count, AT_ONCE):
            part = slice(start, min(start + AT_ONCE, count))
            given = [_padded(table[:, part]) for table in (t_u, fixed, side_b)]
            for row, way in zip(found, ways, strict=True):
                squared = compiled(t_v, _padded(at[way][:, part]), *given)
                row[part] = np.asarray(squared)[: part.stop - start]
        return found

    def _in_numpy(
        self, t_u: Any, t_v: Any, fixed: Any, side_b: Any, way: int, unsaid: list[np.ndarray]
    ) -> Float[np.ndarray, " n"]:
        """q² in one direction; where closures leave directions unsaid as for one gate."""
        at = (t_v, t_u)[way]
        u, v, turning, packed = (tuple(each) for each in (t_u, t_v, at, fixed))
        shape = self._dim, self._dim, -1
        columns = [tuple(one) for side in unsaid for one in side.reshape(shape)]
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            found = squared_one_way(self._module, u, v, turning, packed, side_b, columns or None)
        return comparable(found.squared, found.freedom, self._dim) if unsaid else found


class _Unsaid(NamedTuple):
    """Closures as `carried` takes them."""

    measurement: Any
    pose_a: Any
    free: Float[np.ndarray, "c d f"]


class _One(NamedTuple):
    """A closure to be taken in.

    Attributes:
        numbers: what is kept of it: T, Z, C_ii of both maps, unsaid directions; all packed.
        reach: see `GrowingPair._reach_of`.
        poses: in map a and map b.
        unsaid: whether it leaves directions unsaid.
    """

    numbers: Float[np.ndarray, "s 1"]
    reach: Float[np.ndarray, "r 1"]
    poses: tuple[int, int]
    unsaid: bool


def _unpacked(packed: Float[np.ndarray, "q m"], dim: int) -> Float[np.ndarray, "m d d"]:
    row, column = np.transpose(unrolled.packed_indices(dim))
    blocks = np.empty((packed.shape[1], dim, dim))
    blocks[:, row, column] = blocks[:, column, row] = packed.T
    return blocks


def _twice(blocks: Float[np.ndarray, "m d d"]) -> Float[np.ndarray, "q m"]:
    """C + Cᵀ, packed."""
    row, column = np.transpose(unrolled.packed_indices(blocks.shape[-1]))
    return (blocks[:, row, column] + blocks[:, column, row]).T


@functools.cache
def _compiled(module: Any) -> Any:
    def one_way(t_v: Any, at: Any, t_u: Any, fixed: Any, side_b: Any) -> Any:
        u, v, turning, packed = (tuple(entries) for entries in (t_u, t_v, at, fixed))
        return squared_one_way(module, u, v, turning, packed, side_b)

    return jax.jit(one_way)


def _padded(table: Float[np.ndarray, "s m"]) -> Float[np.ndarray, "s AT_ONCE"]:
    """Filled up with zeros, of which NaN comes and is cut off."""
    padded = np.zeros((len(table), AT_ONCE))
    padded[:, : table.shape[1]] = table
    return padded
