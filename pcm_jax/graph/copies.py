"""Measurements that are stated more than once, from either end.

Two measurements are one when they join the same two poses and say the same: z, or its inverse the
other way round, to the digits that files print. Their information must agree as well, as it is
written or carried over to the other end (Ω' = Ad(z)⁻ᵀ Ω Ad(z)⁻¹); programs do either. Two
different measurements of one pair of poses stay two.

Candidates for a match are found by sorting along one fixed direction in the space of the
measurements' numbers, so that the cost is that of sorting.

Where one of the two was printed with fewer digits (`_printed`), the other may be what it was
rounded from; turned round, each may be off by its own last digit. Their information then agrees as
far as a few digits say it. Information that was not stated but assumed agrees with any.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.graph._printed import Steps, steps

EQUAL = 1e-5  # relative: what copies of a printed number may differ by
CARRIED = 1e-4  # likewise, of information carried over by a measurement that was printed itself
ROUGHLY = 0.02  # likewise, of information beside measurements that were rounded
NEGLIGIBLE = 1e-9  # metres: a zero, carried over
NEIGHBOURS = 3  # ranks along the direction within which copies are looked for


def first_copies(
    ends: Int[np.ndarray, "k 4"],
    measurement: Any,
    information: Float[np.ndarray, "k d d"],
    assumed: Bool[np.ndarray, " k"] | None = None,
) -> Int[np.ndarray, " k"]:
    """For each measurement the index of the first one that says the same; its own where none does.

    Args:
        ends: robot and pose that it starts at, robot and pose that it ends at.
        measurement: NumPy-backed Lie `[k]`.
        information: `[k, d, d]` over the right perturbation.
        assumed: whether the information was not stated; of those that say the same, the first one
            is then the first whose information was stated.
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
            np.zeros(rows.size, bool) if assumed is None else assumed[rows],
        )
        first[rows] = rows[found]
    return first


def _matched(
    pair: Int[np.ndarray, " k"],
    swapped: Bool[np.ndarray, " k"],
    measurement: Any,
    information: Float[np.ndarray, "k d d"],
    assumed: Bool[np.ndarray, " k"],
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
    printed = steps(np.asarray(lie.parameters(measurement)))
    for step in range(1, NEIGHBOURS + 1):
        a, b = order[:-step], order[step:]
        same = pair[a] == pair[b]
        a, b = a[same], b[same]
        turned = swapped[a] != swapped[b]
        shift, turn = _rounding(printed, a, b, turned, matrices)
        rough = (shift > 0.0) | (turn > 0.0)
        stated = _same(carried[a], carried[b], np.where(rough, ROUGHLY, CARRIED)) & turned | _same(
            information[a], information[b], np.where(rough, ROUGHLY, EQUAL)
        )
        same = _same_pose(matrices[a], matrices[b], shift, turn)
        same &= stated | assumed[a] | assumed[b]
        for one, other in zip(a[same].tolist(), b[same].tolist(), strict=True):
            _join(leader, one, other)
    if assumed.any():
        return _led_by_stated(leader, assumed)
    return np.array([_leader_of(leader, row) for row in range(len(pair))], np.int64)


def _direction(size: int) -> Float[np.ndarray, " size"]:
    """Fixed and generic: different measurements all but never meet along it."""
    return np.sqrt(np.arange(2.0, size + 2.0)) % 1.0 + 0.1


def _rounding(
    printed: Steps,
    a: Int[np.ndarray, " k"],
    b: Int[np.ndarray, " k"],
    turned: Bool[np.ndarray, " k"],
    matrices: Float[np.ndarray, "n s s"],
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Bounds on how far two statements of one measurement are apart by rounding: metres, radians.

    Stated alike and with as many digits they are equal, if at all.
    """
    exact = (printed.shift[a] == printed.shift[b]) & (printed.turn[a] == printed.turn[b]) & ~turned
    space = matrices.shape[-1] - 1
    turn = np.where(exact, 0.0, printed.turn[a] + printed.turn[b])
    length = np.linalg.norm(matrices[a, :-1, -1], axis=1)
    shift = 0.5 * np.sqrt(space) * (printed.shift[a] + printed.shift[b]) + length * turn * turned
    return np.where(exact, 0.0, shift), turn


def _same_pose(a: np.ndarray, b: np.ndarray, shift: Any, turn: Any) -> Bool[np.ndarray, " k"]:
    """True where two batches of rigid motions `[k, s, s]` agree as printed numbers do."""
    turned = np.abs(a[:, :-1, :-1] - b[:, :-1, :-1]).max(axis=(1, 2), initial=0.0)
    places = np.abs(a[:, :-1, -1] - b[:, :-1, -1]).max(axis=1)
    size = np.maximum(np.abs(a[:, :-1, -1]).max(axis=1), np.abs(b[:, :-1, -1]).max(axis=1))
    return (turned <= EQUAL + turn) & (places <= EQUAL * size + NEGLIGIBLE + shift)


def _same(a: np.ndarray, b: np.ndarray, tolerance: np.ndarray) -> Bool[np.ndarray, " k"]:
    size = np.maximum(np.abs(a).max(axis=(1, 2)), np.abs(b).max(axis=(1, 2)))
    return np.abs(a - b).max(axis=(1, 2)) <= tolerance * size


def _led_by_stated(leader: np.ndarray, assumed: np.ndarray) -> Int[np.ndarray, " k"]:
    """The first row of each set whose information was stated, if there is one."""
    own = np.array([_leader_of(leader, row) for row in range(len(leader))], np.int64)
    best = np.arange(len(leader))
    for row in np.flatnonzero(~assumed)[::-1].tolist():
        best[own[row]] = row
    return best[own]


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
    closures: Any, assumed: Bool[np.ndarray, " m"] | None = None
) -> tuple[Any, Int[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
    """`LoopClosures` without those that state another one again.

    Args:
        closures: some.
        assumed: whether each one's information was not stated.

    Returns:
        The closures; for each of those given the index of the one that is kept for it; and
        whether it says so the other way round.
    """
    names = ("robot_a", "pose_a", "robot_b", "pose_b")
    ends = np.stack([np.asarray(getattr(closures, name), np.int64) for name in names], axis=1)
    information = np.asarray(closures.information)
    first = first_copies(ends, lie.as_numpy(closures.measurement), information, assumed)
    again = first != np.arange(len(first))
    return (closures[~again] if again.any() else closures), first, (ends != ends[first]).any(axis=1)
