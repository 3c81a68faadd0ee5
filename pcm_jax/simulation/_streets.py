"""Drives through a grid of streets: which crossings a robot passes, turn by turn."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

# East, north, west, south: heading h is h quarter turns anticlockwise.
_DIRECTIONS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
# In 451 of City10000's crossings (22.6 %) the robot turns, those at the city's edge included.
TURN_PROBABILITY = 0.2


def drive(
    generator: np.random.Generator,
    *,
    crossings: int,
    blocks: int,
    start: tuple[np.ndarray, int] | None = None,
) -> tuple[Int[np.ndarray, "c 2"], Int[np.ndarray, " c-1"]]:
    """A random drive: straight on, or left or right now and then, never back and never out of town.

    Args:
        generator: source of randomness.
        crossings: how many crossings to pass, the first one included.
        blocks: blocks along each side of the square city.
        start: the first crossing (grid coordinates) and the heading to leave it by; random
            by default.

    Returns:
        Grid coordinates of the crossings, and the heading (quarter turns) between each two.
    """
    place, heading = start or (
        generator.integers(0, blocks + 1, size=2),
        int(generator.integers(4)),
    )
    places, headings = [place], []
    turns = generator.random(crossings - 1) < TURN_PROBABILITY
    turns[:1] = False
    left_first = generator.random(crossings - 1) < 0.5
    for turn, left in zip(turns, left_first, strict=True):
        sides = [1, -1] if left else [-1, 1]
        for change in [*sides, 0, 2] if turn else [0, *sides, 2]:
            ahead = place + _DIRECTIONS[(heading + change) % 4]
            if ahead.min() >= 0 and ahead.max() <= blocks:
                break
        place, heading = ahead, (heading + change) % 4
        places.append(place)
        headings.append(heading)
    return np.array(places), np.array(headings)


def block_poses(
    places: Int[np.ndarray, "c 2"], headings: Int[np.ndarray, " c-1"], *, steps: int
) -> tuple[Float[np.ndarray, "n 2"], Int[np.ndarray, " n"]]:
    """Positions (in blocks) and headings of a drive that takes `steps` equal steps a block.

    The robot reaches a crossing still looking the way it came and turns as it leaves, so that the
    step after it is one to the side: City10000's own convention.
    """
    offsets = np.arange(1, steps + 1) / steps
    moves = _DIRECTIONS[headings][:, None, :] * offsets[None, :, None]
    positions = (places[:-1, None, :] + moves).reshape(-1, 2)
    positions = np.concatenate([places[:1], positions])
    return positions, np.concatenate([headings[:1], np.repeat(headings, steps)])
