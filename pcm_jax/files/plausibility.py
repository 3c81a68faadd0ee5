"""Doubts about how information was read, from the numbers alone, without a loop.

A standard deviation of more than a turn says nothing of a rotation, and one of more than a step's
length nothing of a step. Where the sigmas of a map's odometry are such, its file may hold
covariances, or the information's square root; a reading is proposed only where its sigmas would be
plausible, which none is that widens them further.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from pcm_jax import lie
from pcm_jax.files.coordinates import inverted
from pcm_jax.graph.loop_closures import LoopClosures
from pcm_jax.graph.pose_graph import PoseGraph

TURN = 2.0 * np.pi
SMALLEST_SHARE = 1e-6  # of a step: smaller sigmas are no measurement's
SEVERE = 2.0  # times a step or a turn: what a reader is warned of
ENOUGH = 5000  # measurements to take a median of
APART = 300.0  # times: between robots of one team whose sigmas are in one unit


class Sigmas(NamedTuple):
    """Medians over measurements: metres and radians."""

    translation: float
    rotation: float


def doubts(
    maps: Sequence[PoseGraph], closures: LoopClosures, how: str
) -> Iterator[tuple[str, bool]]:
    """Lines on information that cannot be meant as it was read.

    Args:
        maps: the robots' maps.
        closures: what joins them.
        how: how the information was read: "as-written", "sqrt" or "covariance".

    Yields:
        each line, and whether it is worth a warning.
    """
    typical = {}
    for one in maps:
        odometry = np.abs(np.asarray(one.tail) - np.asarray(one.head)) == 1
        information = np.asarray(one.information)[odometry if odometry.any() else slice(None)]
        information = information[:: 1 + len(information) // ENOUGH]
        if not len(information):
            continue
        step = _step(one, odometry)
        sigmas = _sigmas(information, one.group)
        typical[one.name] = sigmas
        if not _plausible(sigmas, step):
            yield (
                f"robot {one.name}: {_doubt(sigmas, step, 'a step')}"
                + _proposal(information, one.group, step, how),
                not _plausible(sigmas, SEVERE * step),
            )
    yield from _between(closures, maps, how)
    yield from _far_apart(typical)


def _between(
    closures: LoopClosures, maps: Sequence[PoseGraph], how: str
) -> Iterator[tuple[str, bool]]:
    if not len(closures):
        return
    information = np.asarray(closures.information)
    sigmas = _sigmas(information, closures.group)
    places = [np.ptp(np.asarray(lie.translation(lie.as_numpy(one.poses))), axis=0) for one in maps]
    extent = max(float(np.linalg.norm(place)) for place in places) or np.inf
    if not _plausible(sigmas, extent):
        doubt = _doubt(sigmas, extent, "maps")
        proposal = _proposal(information, closures.group, extent, how)
        yield f"closures: {doubt}{proposal}", not _plausible(sigmas, SEVERE * extent)


def _far_apart(typical: dict[str, Sigmas]) -> Iterator[tuple[str, bool]]:
    for index, unit in enumerate(("m", "rad")):
        ordered = sorted(typical, key=lambda name: typical[name][index])
        if len(ordered) > 1:
            small, large = (typical[ordered[end]][index] for end in (0, -1))
            if large > APART * small:
                yield (
                    f"robot {ordered[-1]}: its sigmas of {large:.3g} {unit} are {large / small:.3g}"
                    f" times robot {ordered[0]}'s; are both files in one unit?",
                    True,
                )


def _step(one: PoseGraph, odometry: np.ndarray) -> float:
    length = np.linalg.norm(np.asarray(lie.translation(lie.as_numpy(one.measurement))), axis=-1)
    moving = length[odometry & (length > 0.0)]
    return float(np.median(moving)) if moving.size else np.inf


def _sigmas(information: Float[np.ndarray, "e d d"], group: type[Any]) -> Sigmas:
    space = lie.module_of(group).MATRIX_DIM - 1
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        variances = np.abs(np.diagonal(_inverse(information), axis1=1, axis2=2))
    translation, rotation = variances[:, :space].mean(axis=1), variances[:, space:].mean(axis=1)
    return Sigmas(*(float(np.sqrt(np.median(part))) for part in (translation, rotation)))


def _inverse(matrices: Float[np.ndarray, "e d d"]) -> Float[np.ndarray, "e d d"]:
    try:
        return inverted(matrices)
    except np.linalg.LinAlgError:
        return np.linalg.pinv(matrices, hermitian=True)


def _plausible(sigmas: Sigmas, length: float) -> bool:
    return sigmas.translation <= length and sigmas.rotation <= TURN


def _doubt(sigmas: Sigmas, length: float, what: str) -> str:
    size = f" for {what} of {length:.3g} m" if np.isfinite(length) else ""
    return (
        f"sigmas of {sigmas.translation:.3g} m and {sigmas.rotation:.3g} rad{size} cannot be meant"
    )


def _proposal(
    information: Float[np.ndarray, "e d d"], group: type[Any], length: float, how: str
) -> str:
    """The reading that would be plausible, if one is."""
    if how == "as-written":
        upper = np.triu(information)
        readings = {
            "covariance": ("covariances", _inverse(information)),
            "sqrt": ("the information's square root", np.swapaxes(upper, 1, 2) @ upper),
        }
    elif how == "covariance":
        readings = {"as-written": ("information", _inverse(information))}
    else:
        return ""
    for name, (words, other) in readings.items():
        sigmas = _sigmas(other, group)
        if _plausible(sigmas, length) and sigmas.translation > SMALLEST_SHARE * min(length, 1e6):
            return (
                f"; read as {words} they are {sigmas.translation:.3g} m and"
                f" {sigmas.rotation:.3g} rad (--information {name})"
            )
    return ""
