"""Drives through a grid of streets in the plane or in space, as a kernel.

The law of `streets`: straight on, or to a side now and then, never back and never out of town. In
space streets run along all three axes, and "to a side" is up and down as well.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from pcm_jax import lie
from pcm_jax.simulation._streets import TURN_PROBABILITY
from pcm_jax.simulation.measurements import space_dim

_BLOCK = 5  # m between streets, and steps of 1 m between crossings, as in `city`


def town_drive(chance: Float[Array, "c w"], group: Any, poses: int, blocks: int | None) -> Any:
    """True poses `[n]`: a pose every metre, corners as in `streets.block_poses`."""
    space = space_dim(group)
    if blocks is None:  # the same number of poses for each place of a larger town
        blocks = max(2, round((2 * poses / _BLOCK**2) ** (1 / space)))
    places, headings = _crossings(chance, blocks, space)
    after = np.maximum(np.arange(poses) - 1, 0)
    along = np.where(np.arange(poses) == 0, 0.0, after % _BLOCK + 1.0)[:, None]
    heading = headings[after // _BLOCK]
    directions, rotations = _headings(group)
    position = _BLOCK * places[after // _BLOCK] + along * directions[heading]
    return group(jnp.concatenate([rotations[heading], position], axis=1))


def crossings_left(poses: int) -> int:
    """The number of crossings that a robot leaves."""
    return -(-(poses - 1) // _BLOCK)


def _crossings(
    chance: Float[Array, "c w"], blocks: int, space: int
) -> tuple[Int[Array, "c-1 s"], Int[Array, " c-1"]]:
    """Crossings passed, and the direction that each is left by; never back, never out of town."""
    directions = np.concatenate([np.eye(space, dtype=np.int32), -np.eye(space, dtype=np.int32)])
    ways = np.arange(2 * space)

    def leave(state: tuple[Any, Any], chance: Any) -> tuple[Any, Any]:
        (place, heading), turns, eager = state, chance[0] < TURN_PROBABILITY, chance[1:]
        ahead = place + directions
        inside = jnp.all((ahead >= 0) & (ahead <= blocks), axis=1)
        eager += jnp.where(ways == heading, jnp.where(turns, -1.0, 1.0), 0.0)
        eager -= 2.0 * (ways == (heading + space) % len(ways))
        chosen = jnp.argmax(jnp.where(inside, eager, -jnp.inf)).astype(np.int32)
        return (ahead[chosen], chosen), (place, chosen)

    start = index_below(chance[0, 1 : 1 + space], blocks + 1), index_below(chance[0, 0], len(ways))
    return jax.lax.scan(leave, start, chance[1:])[1]


def index_below(chance: Float[Array, "*batch"], count: int) -> Int[Array, "*batch"]:
    """Numbers below `count`, each as likely, from uniform ones in [0, 1)."""
    return jnp.minimum(chance * count, count - 1).astype(np.int32)


def _headings(group: Any) -> tuple[Float[Array, "h s"], Float[Array, "h r"]]:
    """Directions of travel, and the rotations (as parameters) that look that way, x ahead."""
    space = space_dim(group)
    directions = np.concatenate([np.eye(space), -np.eye(space)])
    matrices: Any = np.tile(np.eye(space + 1), (len(directions), 1, 1))
    for matrix, ahead in zip(matrices, directions, strict=True):
        if space == 2:
            axes = [ahead, (-ahead[1], ahead[0])]
        else:
            upright = np.eye(3)[0] if ahead[2] else np.eye(3)[2]
            left = np.cross(upright, ahead)
            axes = [ahead, left, np.cross(ahead, left)]
        matrix[:space, :space] = np.transpose(axes)
    rotations = lie.parameters(lie.from_matrix(matrices))[:, :-space]
    return jnp.asarray(directions), jnp.asarray(rotations)
