"""Measurements that are stated more than once, from either end.

Two measurements are one when they join the same two poses and say the same: z, or its inverse the
other way round, to the digits that files print. Their information must agree as well, as it is
written or carried over to the other end (Ω' = Ad(z)⁻ᵀ Ω Ad(z)⁻¹); programs do either. Two
different measurements of one pair of poses stay two.

Candidates for a match are found by sorting along one fixed direction in the space of the
measurements' numbers, so that the cost is that of sorting.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie

EQUAL = 1e-5  # relative: what copies of a printed number may differ by
CARRIED = 1e-4  # likewise, of information carried over by a measurement that was printed itself
NEGLIGIBLE = 1e-9  # metres: a zero, carried over
NEIGHBOURS = 3  # ranks along the direction within which copies are looked for


def first_copies(
    ends: Int[np.ndarray, "k 4"], measurement: Any, information: Float[np.ndarray, "k d d"]
) -> Int[np.ndarray, " k"]:
    """For each measurement the index of the first one that says the same; its own where none does.

    Args:
        ends: robot and pose that it starts at, robot and pose that it ends at.
        measurement: NumPy-backed Lie `[k]`.
        information: `[k, d, d]` over the right perturbation.
    """
    count = len(ends)
    if count < 2:
        return np.arange(count)
    swapped = (ends[:, 0] > ends[:, 2]) | ((ends[:, 0] == ends[:, 2]) & (ends[:, 1] > ends[:, 3]))
    one_way = np.where(swapped[:, None], ends[:, [2, 3, 0, 1]], ends)
    _, pair = np.unique(one_way, axis=0, return_inverse=True)
    shared = np.bincount(pair.ravel())[pair.ravel()] > 1
    first = np.arange(count)
    rows = np.flatnonzero(shared)
    if rows.size:
        found = _matched(
            pair.ravel()[rows],
            swapped[rows],
            lie.take(measurement, rows),
            np.asarray(information)[rows],
        )
        first[rows] = rows[found]
    return first


def _matched(
    pair: Int[np.ndarray, " k"],
    swapped: Bool[np.ndarray, " k"],
    measurement: Any,
    information: Float[np.ndarray, "k d d"],
) -> Int[np.ndarray, " k"]:
    """`first_copies` of those that share their pair of poses with another one."""
    inverse = lie.inverse(measurement)
    matrices = np.asarray(lie.as_matrix(measurement))
    matrices = np.where(swapped[:, None, None], np.asarray(lie.as_matrix(inverse)), matrices)
    back = np.asarray(lie.adjoint(inverse))
    carried = np.swapaxes(back, 1, 2) @ information @ back
    carried = np.where(swapped[:, None, None], carried, information)
    numbers = matrices[:, :-1].reshape(len(pair), -1)
    order = np.lexsort((numbers @ _direction(numbers.shape[1]), pair))
    leader = np.arange(len(pair))
    for step in range(1, NEIGHBOURS + 1):
        a, b = order[:-step], order[step:]
        same = pair[a] == pair[b]
        a, b = a[same], b[same]
        same = _same_pose(matrices[a], matrices[b]) & (
            _same(carried[a], carried[b], CARRIED) & (swapped[a] != swapped[b])
            | _same(information[a], information[b], EQUAL)
        )
        for one, other in zip(a[same].tolist(), b[same].tolist(), strict=True):
            _join(leader, one, other)
    return np.array([_leader_of(leader, row) for row in range(len(pair))], np.int64)


def _direction(size: int) -> Float[np.ndarray, " size"]:
    """Fixed and generic: different measurements all but never meet along it."""
    return np.sqrt(np.arange(2.0, size + 2.0)) % 1.0 + 0.1


def _same_pose(a: np.ndarray, b: np.ndarray) -> Bool[np.ndarray, " k"]:
    """True where two batches of rigid motions `[k, s, s]` agree as printed numbers do."""
    turned = np.abs(a[:, :-1, :-1] - b[:, :-1, :-1]).max(axis=(1, 2), initial=0.0)
    places = np.abs(a[:, :-1, -1] - b[:, :-1, -1]).max(axis=1)
    size = np.maximum(np.abs(a[:, :-1, -1]).max(axis=1), np.abs(b[:, :-1, -1]).max(axis=1))
    return (turned <= EQUAL) & (places <= EQUAL * size + NEGLIGIBLE)


def _same(a: np.ndarray, b: np.ndarray, tolerance: float) -> Bool[np.ndarray, " k"]:
    size = np.maximum(np.abs(a).max(axis=(1, 2)), np.abs(b).max(axis=(1, 2)))
    return np.abs(a - b).max(axis=(1, 2)) <= tolerance * size


def _leader_of(leader: np.ndarray, row: int) -> int:
    while leader[row] != row:
        leader[row] = leader[leader[row]]
        row = int(leader[row])
    return row


def _join(leader: np.ndarray, one: int, other: int) -> None:
    """One set of two, led by the earlier row."""
    one, other = _leader_of(leader, one), _leader_of(leader, other)
    leader[max(one, other)] = min(one, other)


def counted_once(
    closures: Any,
) -> tuple[Any, Int[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
    """`LoopClosures` without those that state an earlier one again.

    Returns:
        The closures; for each of those given the index of the first one that says the same; and
        whether it says so the other way round.
    """
    names = ("robot_a", "pose_a", "robot_b", "pose_b")
    ends = np.stack([np.asarray(getattr(closures, name), np.int64) for name in names], axis=1)
    information = np.asarray(closures.information)
    first = first_copies(ends, lie.as_numpy(closures.measurement), information)
    again = first != np.arange(len(first))
    return (closures[~again] if again.any() else closures), first, (ends != ends[first]).any(axis=1)
