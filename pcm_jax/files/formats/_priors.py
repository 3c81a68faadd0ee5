"""g2o's lines that measure a single pose.

| tag | columns | weighs |
|---|---|---|
| `EDGE_PRIOR_SE2` | id x y θ Ω(3) | the pose |
| `EDGE_PRIOR_SE2_XY` | id x y Ω(2) | the position, in the map's frame |
| `EDGE_SE3_PRIOR` | id offset x y z qx qy qz qw Ω(6) | the pose times the offset of that number |
| `EDGE_SE3_PRIORXYZ` | id x y z Ω(3) | the position, in the map's frame |

A position's information is turned into the frame of the pose's own vertex, where the tangent is:
with R its rotation, Ω = Rᵀ Ω_file R for the translation, and nothing is known of the rotation.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jaxlie
import numpy as np
from jaxtyping import Float

from pcm_jax import lie
from pcm_jax.files import coordinates
from pcm_jax.files.pose_file import Lines, Reading
from pcm_jax.files.text import Rows
from pcm_jax.graph.loop_closures import find

OFFSETS = "PARAMS_SE3OFFSET"
WIDTHS = {
    "EDGE_PRIOR_SE2": 11,
    "EDGE_PRIOR_SE2_XY": 7,
    "EDGE_SE3_PRIOR": 31,
    "EDGE_SE3_PRIORXYZ": 11,
}


def read_priors(
    rows: Mapping[str, Rows], group: type[Any], vertices: Lines, reading: Reading
) -> tuple[list[Lines], dict[str, int]]:
    """The priors of each tag, and how many of each had to be left out.

    Args:
        rows: lines by tag.
        group: of the file's poses.
        vertices: the file's, whose rotations positions need.
        reading: the options of reading.
    """
    found, left_out = [], {}
    flat = group is jaxlie.SE2
    for tag, width in WIDTHS.items():
        own = rows.get(tag)
        if own is None:
            continue
        lines = None
        if flat == ("SE2" in tag) and (own.widths == width).all():
            read = _positions if tag.endswith(("XY", "XYZ")) else _poses
            lines = read(own, rows, vertices, reading)
        kept = 0 if lines is None else len(lines)
        if lines is not None and kept:
            found.append(lines)
        if kept < len(own):
            left_out[tag] = len(own) - kept
    return found, left_out


def _poses(own: Rows, rows: Mapping[str, Rows], _: Lines, reading: Reading) -> Lines:
    flat = own.widths[0] == WIDTHS["EDGE_PRIOR_SE2"]
    start, stop = (2, 5) if flat else (3, 10)
    values = own.floats(start, stop)
    transforms = coordinates.parameters("angle" if flat else "quaternion", values, own.fault)
    triangle = own.floats(stop, int(own.widths[0]))
    information = coordinates.information(triangle, how=reading.information, fault=own.fault)
    lines = Lines(own.integers(1, 2), transforms, information, own.line)
    return lines if flat else _without_offset(lines, own.integers(2, 3)[:, 0], rows.get(OFFSETS))


def _without_offset(lines: Lines, numbers: np.ndarray, offsets: Rows | None) -> Lines:
    """Priors on the poses themselves, from priors on the poses times an offset O.

    z exp(δ) O⁻¹ = z O⁻¹ exp(Ad(O) δ), so Ω = Ad(O)⁻ᵀ Ω_file Ad(O)⁻¹.
    """
    if offsets is None or not (offsets.widths == 9).all():
        return lines
    slot, missing = find(offsets.integers(1, 2)[:, 0], numbers)
    given = coordinates.parameters("quaternion", offsets.floats(2, 9), offsets.fault)[slot]
    given[missing] = lie.parameters(lie.identity(jaxlie.SE3))
    back = lie.inverse(jaxlie.SE3(given))  # type: ignore[arg-type]
    turn = np.asarray(lie.adjoint(back))
    poses = lie.compose(jaxlie.SE3(lines.transforms), back)  # type: ignore[arg-type]
    information = np.swapaxes(turn, 1, 2) @ lines.information @ turn
    return Lines(lines.ids, np.asarray(lie.parameters(poses)), information, lines.line)


def _positions(own: Rows, _: Mapping[str, Rows], vertices: Lines, reading: Reading) -> Lines | None:
    space = 2 if own.widths[0] == WIDTHS["EDGE_PRIOR_SE2_XY"] else 3
    if not len(vertices):
        return None
    ids = own.integers(1, 2)
    slot, missing = find(vertices.ids[:, 0], ids[:, 0])
    transforms = vertices.transforms[slot].copy()
    transforms[:, -space:] = own.floats(2, 2 + space)
    group = jaxlie.SE2 if space == 2 else jaxlie.SE3
    rotation = np.asarray(lie.as_matrix(group(transforms)))[:, :space, :space]  # type: ignore[arg-type]
    stated = _square(own.floats(2 + space, int(own.widths[0])), reading, own)
    information = np.zeros((len(own), lie.tangent_dim(group), lie.tangent_dim(group)))
    information[:, :space, :space] = np.swapaxes(rotation, 1, 2) @ stated @ rotation
    return Lines(ids, transforms, information, own.line)[~missing]


def _square(triangle: np.ndarray, reading: Reading, own: Rows) -> Float[np.ndarray, "k s s"]:
    return coordinates.information(triangle, how=reading.information, fault=own.fault)
