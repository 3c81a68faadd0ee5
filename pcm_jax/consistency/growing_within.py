"""`GrowingWithin`: closures inside one map that come one by one, and what a row of Q says of each.

What q² needs of a closure by itself (`_closed_form`: T and Z) is kept, with S at its two poses; so
a row takes no look at the map, however long (`within`: any pair's covariance is a difference of S).
Odometry that is appended adds to S behind what is there, and changes nothing before. The frame is
the first one, which does not move, where `within_problem` takes the mean of the poses touched:
q² is the same but for rounding.

All numbers are for odometry as stated; a scale of its errors multiplies S as it is read. Host; a
row is computed in NumPy until compiling pays.
"""

from __future__ import annotations

import copy
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.compiling import is_worth_compiling
from pcm_jax.consistency._closed_form import sides_of_one_map, squared_one_way
from pcm_jax.consistency.growing import AT_ONCE, SMALLEST, WORTH
from pcm_jax.consistency.mahalanobis import SECONDS_A_PAIR
from pcm_jax.consistency.problem import recentred
from pcm_jax.consistency.within import added_by_steps, forward
from pcm_jax.graph import PoseGraph
from pcm_jax.graph.spanning_tree import spanning_tree_poses
from pcm_jax.lie import unrolled


class GrowingWithin:
    """The closures inside one map, one more at a time.

        growing = GrowingWithin(odometry)
        growing.append(tail, head, measurement, information)    # any number
        forward, backward = growing.row(4)                      # q²_u4 and q²_4u of u = 0 … 3

    Args:
        odometry: a chain: as its edges the steps from each pose to the next, in order.
    """

    def __init__(self, odometry: PoseGraph) -> None:
        self._module = lie.module_of(odometry.group)
        self._dim = lie.tangent_dim(odometry.group)
        packed = self._dim * (self._dim + 1) // 2
        entries = lie.parameters(lie.identity(odometry.group)).shape[-1]
        ends = np.cumsum([entries, packed, packed, packed])
        self._parts = [slice(a, b) for a, b in zip([0, *ends[:-1]], ends, strict=True)]
        self._numbers = np.zeros((int(ends[-1]), SMALLEST))
        self._poses = np.zeros((2, SMALLEST), np.int64)
        self.count = 0
        start, end, steps, covariance = forward(*_edges_of(odometry))
        self._chain = recentred(spanning_tree_poses(start, end, steps, odometry.num_poses))
        added = added_by_steps(lie.take(self._chain, slice(1, None)), covariance)
        self._cumulated = np.cumsum(np.concatenate([np.zeros((1, packed)), added]), axis=0)

    def __len__(self) -> int:
        return self.count

    @on_host
    def extend(
        self,
        tail: Int[np.ndarray, " s"],
        head: Int[np.ndarray, " s"],
        measurement: Any,
        information: Float[np.ndarray, "s d d"],
    ) -> None:
        """Appends odometry, a step from the last pose to the next and so on, in order."""
        _, _, steps, covariance = forward(tail, head, measurement, information)
        reached = [lie.take(self._chain, slice(-1, None))]
        for step in range(len(covariance)):
            reached.append(lie.compose(reached[-1], lie.take(steps, slice(step, step + 1))))
        new = lie.normalize(lie.concatenate(reached[1:]))
        added = np.cumsum(added_by_steps(new, covariance), axis=0)
        self._chain = lie.concatenate([self._chain, new])
        self._cumulated = np.concatenate([self._cumulated, self._cumulated[-1] + added])

    @on_host
    def append(
        self,
        tail: Int[np.ndarray, " c"],
        head: Int[np.ndarray, " c"],
        measurement: Any,
        information: Float[np.ndarray, "c d d"],
    ) -> None:
        """Takes closures in, behind those there are."""
        start, end, measured, covariance = forward(tail, head, measurement, information)
        pose_a, pose_b = (lie.take(self._chain, poses) for poses in (start, end))
        reached = lie.compose(pose_a, measured)
        placed = np.asarray(lie.parameters(lie.compose(reached, lie.inverse(pose_b))))
        noise = added_by_steps(reached, covariance)
        numbers = [placed, noise, self._cumulated[start], self._cumulated[end]]
        count = self.count + len(start)
        while count > self._numbers.shape[1]:
            self._numbers, self._poses = (
                np.concatenate([table, np.zeros_like(table)], axis=1)
                for table in (self._numbers, self._poses)
            )
        some = slice(self.count, count)
        self._numbers[:, some] = np.concatenate(numbers, axis=1).T
        self._poses[:, some] = start, end
        self.count = count

    def remove(self, slot: int) -> None:
        """Takes a closure out; those behind it move up by one."""
        self._numbers, self._poses = (
            np.concatenate([table[:, :slot], table[:, slot + 1 :], table[:, [slot]]], axis=1)
            for table in (self._numbers, self._poses)
        )
        self.count -= 1

    def copy(self) -> GrowingWithin:
        """Copies the state; until one of the two has room to make, tables are shared.

        What is appended lies behind the count, so the copy of before goes on where it was; of two
        that both go on only the last one is good.
        """
        return copy.copy(self)

    @on_host
    def own(self, slot: int, factor: float = 1.0) -> float:
        """q² of the loop that a closure makes with odometry alone.

        Args:
            slot: its place here.
            factor: on odometry's standard deviations.
        """
        placed, noise, start, end = (self._numbers[part, slot] for part in self._parts)
        error = self._module.log(self._module.inverse(tuple(placed)))
        total = tuple(factor**2 * (end - start) + noise)
        return float(unrolled.inverse_quadratic_form(unrolled.unpack(total), error))

    @on_host
    def row(
        self, slot: int, factor: float = 1.0
    ) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """q² of all closures before one with it, and of it with them.

        Args:
            slot: its place here, m.
            factor: on odometry's standard deviations.
        """
        scale = np.ones((len(self._numbers), 1))
        scale[self._parts[2].start :] = factor**2
        new = scale * self._numbers[:, [slot]], self._poses[:, [slot]]
        old = scale * self._numbers[:, :slot], self._poses[:, :slot]
        so_far = 2 * slot * max(slot, WORTH) * SECONDS_A_PAIR[self._dim]
        if not is_worth_compiling(so_far):
            with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
                found = np.stack(_both_ways(self._module, self._parts, *old, *new))
            return found[0], found[1]
        compiled = _compiled(self._module, tuple((part.start, part.stop) for part in self._parts))
        found = np.empty((2, slot))
        for start in range(0, slot, AT_ONCE):
            some = slice(start, min(start + AT_ONCE, slot))
            both = compiled(*(_padded(table[:, some]) for table in old), *new)
            found[:, some] = np.asarray(both)[:, : some.stop - start]
        return found[0], found[1]


def _edges_of(graph: PoseGraph) -> tuple[np.ndarray, np.ndarray, Any, np.ndarray]:
    tail, head, information = map(np.asarray, (graph.tail, graph.head, graph.information))
    return tail, head, lie.as_numpy(graph.measurement), information


def _both_ways(
    module: Any, parts: Any, numbers: Any, poses: Any, other: Any, its_poses: Any
) -> tuple[Any, Any]:
    """q²_uv and q²_vu of closures u and one v."""
    (t_u, z_u, *from_to_u), (t_v, z_v, *from_to_v) = (
        [tuple(table[part]) for part in parts] for table in (numbers, other)
    )
    (i, k), (j, l) = (  # noqa: E741
        tuple(zip(where, cumulated, strict=True))
        for where, cumulated in ((poses, from_to_u), (its_poses, from_to_v))
    )
    side_a, side_b, both_sides = sides_of_one_map(i, j, k, l)
    fixed = tuple(a + z + own for a, z, own in zip(side_a, z_u, z_v, strict=True))
    ways = (t_v, t_u)
    return tuple(  # type: ignore[return-value]
        squared_one_way(module, t_u, t_v, at, fixed, side_b, None, both_sides) for at in ways
    )


@functools.cache
def _compiled(module: Any, parts: tuple[tuple[int, int], ...]) -> Any:
    some = [slice(*part) for part in parts]

    def both(numbers: Any, poses: Any, other: Any, its_poses: Any) -> Any:
        return jnp.stack(_both_ways(module, some, numbers, poses, other, its_poses))

    return jax.jit(both)


def _padded(table: Any) -> Any:
    """Filled up with zeros, of which NaN comes and is cut off."""
    padded = np.zeros((len(table), AT_ONCE), table.dtype)
    padded[:, : table.shape[1]] = table
    return padded
