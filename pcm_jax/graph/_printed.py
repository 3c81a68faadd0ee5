"""Numbers of decimals that measurements were printed with, told by the numbers.

A number that is a whole multiple of 10⁻ⁿ was most likely printed with n decimals. A float of full
precision is none of a multiple that coarse, and short numbers ("1.5") are as likely meant exactly,
so that only multiples with some digits count as rounded.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

FEWEST, MOST = 3, 6  # decimals of a rounded number: more are as good as exact
DIGITS = 1e4  # a number of five digits or more is rounded whatever its decimals
SLACK = 1e-10  # of a number in units of its last decimal
BY_ANGLE, BY_QUATERNION = 0.5, 2.0
"""Radians that a rotation is off by, in units of a printed angle's or quaternion's last decimal."""


class Steps(NamedTuple):
    """Sizes of the last decimal printed, 0 where numbers are exact: metres, and radians.

    Attributes:
        shift: `[k]`, of translations.
        turn: `[k]`, that rotations may be off by.
    """

    shift: Float[np.ndarray, " k"]
    turn: Float[np.ndarray, " k"]


def steps(parameters: Float[np.ndarray, "k p"]) -> Steps:
    """The last decimals of transforms, jaxlie's parameters `[k, 4]` or `[k, 7]`."""
    if parameters.shape[1] == 4:
        theta = np.arctan2(parameters[:, 1], parameters[:, 0])
        turned = [_step(theta + turns) for turns in (0.0, 2.0 * np.pi, -2.0 * np.pi)]
        return _filled(_coarsest(parameters[:, 2:]), np.max(turned, axis=0), BY_ANGLE)
    if parameters.shape[1] == 7:
        turn = _quaternion_step(parameters[:, :4])
        return _filled(_coarsest(parameters[:, 4:]), turn, BY_QUATERNION)
    return Steps(np.zeros(len(parameters)), np.zeros(len(parameters)))


def _filled(shift: np.ndarray, turn: np.ndarray, factor: float) -> Steps:
    """Steps of both, one from the other where its numbers happen to end in zeros."""
    finest = 10.0**-FEWEST
    return Steps(
        np.where(shift > 0.0, shift, turn),
        factor * np.where(turn > 0.0, turn, np.minimum(shift, finest)),
    )


def _coarsest(values: Float[np.ndarray, "k c"]) -> Float[np.ndarray, " k"]:
    return np.max([_step(column) for column in values.T], axis=0)


def _step(values: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """10⁻ⁿ of the fewest decimals n that give each number; 0 for what counts as exact."""
    found, open_ = np.zeros(len(values)), np.ones(len(values), bool)
    for decimals in range(MOST + 1):
        units = np.abs(values) * 10.0**decimals
        whole = open_ & (np.abs(units - np.rint(units)) <= SLACK * (1.0 + units))
        counts = (decimals >= FEWEST) | (units >= DIGITS)
        found[whole & counts] = 10.0**-decimals
        open_ &= ~whole
    return found


def _quaternion_step(quaternions: Float[np.ndarray, "k 4"]) -> Float[np.ndarray, " k"]:
    """The same of quaternions that were scaled to unit length when they were read."""
    rows = np.arange(len(quaternions))
    largest = np.abs(quaternions[rows, np.abs(quaternions).argmax(axis=1)])
    found, open_ = np.zeros(len(quaternions)), np.ones(len(quaternions), bool)
    for decimals in range(1, MOST + 1):
        unit = 10.0**decimals
        whole = np.zeros(len(quaternions), bool)
        for near in range(-3, 4):
            scale = (np.rint(largest * unit) + near) / (largest * unit)
            scaled = quaternions * (scale * unit)[:, None]
            fits = (np.abs(scaled - np.rint(scaled)) <= SLACK * unit).all(axis=1)
            whole |= fits & (np.abs(scale - 1.0) <= 2.5 / unit)
        whole &= open_
        if decimals >= FEWEST:
            found[whole] = 1.0 / unit
        open_ &= ~whole
    return found
