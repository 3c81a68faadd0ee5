"""The numbers that the page's scripts draw: positions, closures, distances between closures.

Positions are integers of a unit, axis by axis: a power of ten that resolves the smallest map to a
ten-thousandth of its extent. Distances are bytes in base 64, the strict upper triangle row by row:

    q / γ ≤ 1 (the two agree)   floor(127 q / γ)
    q / γ > 1                   128 + min(127, floor(12 log2(q / γ)))
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.consistency import chi2_gate, joint_consistency
from pcm_jax.consistency.joint import thinned
from pcm_jax.integrity import way_of
from pcm_jax.merging import MergeResult
from pcm_jax.plots.maps import widest_plane
from pcm_jax.report._facts import FATES, Facts, ends_of, found_members, ratios, rival_members
from pcm_jax.report._words import more
from pcm_jax.selection import PairSelection

MOST_POSES = 20_000
"""Poses that are drawn; of more, every second, third, ... of each robot."""
MOST_DISTANCES = 1_200_000
"""Distances that are drawn, of all pairs of robots; 1.6 MB."""
MOST_CLOSURES = 1_000
"""Closures of one pair of robots whose distances are drawn."""
ALIGNED = 60
"""Closures of a refused set that its alignment is found from, evenly spaced."""
STEPS = 12.0
"""Bytes to a doubling of q / γ beyond the gate."""
ELLIPSE = 0.95
"""Probability inside the ellipses of the anchors."""


def drawings(
    result: MergeResult, facts: Facts, rows: Sequence[dict[str, Any]] = ()
) -> dict[str, Any]:
    """Gathers what the page draws, as plain data.

    Args:
        result: of `merge`.
        facts: on its closures.
        rows: of the report, one a closure, for what they tell besides.
    """
    own, merged = (_positions(maps) for maps in (result.maps, result.graph.maps))
    unit = _unit([*own, *merged])
    every = max(1, math.ceil(sum(map(len, own)) / MOST_POSES))
    pairs = result.selection.pairs if result.selection else ()
    return {
        "space": own[0].shape[1],
        "plane": widest_plane(merged),
        "unit": unit,
        "every": every,
        "robots": [
            {
                "name": one.name,
                "own": _axes(own[robot], unit, every),
                "merged": _axes(merged[robot], unit, every),
            }
            for robot, one in enumerate(result.graph.maps)
        ],
        "groups": [list(members) for members in result.groups],
        "closures": _closures(result, facts, unit)
        | {"more": [more(row) for row in rows], "worst": [_worst(row) for row in rows]},
        "pairs": [_pair(pair, _most(len(pairs))) for pair in pairs],
        "anchors": _anchors(result, unit),
    }


def _worst(row: dict[str, Any]) -> int:
    """The closure that one misses by most, as its sentence names it; -1 where none is known."""
    worst = row["worst_conflict"]
    return -1 if worst is None else worst["with"]


def _positions(maps: Any) -> list[Float[np.ndarray, "n s"]]:
    return [np.asarray(lie.translation(lie.as_numpy(one.poses))) for one in maps]


def _unit(positions: list[np.ndarray]) -> float:
    """The largest power of ten that is at most a ten-thousandth of the smallest map."""
    extents = [float(np.ptp(one, axis=0).max()) for one in positions]
    least = min((extent for extent in extents if extent > 0.0), default=1.0)
    return 10.0 ** math.floor(math.log10(least * 1e-4))


def _axes(positions: Float[np.ndarray, "n s"], unit: float, every: int = 1) -> list[list[int]]:
    chosen = positions[::every]
    if (len(positions) - 1) % every:
        chosen = np.concatenate([chosen, positions[-1:]])
    return np.rint(chosen / unit).astype(np.int64).T.tolist()


def _closures(result: MergeResult, facts: Facts, unit: float) -> dict[str, Any]:
    closures, maps = result.candidates, result.graph.maps
    ends = {
        f"{state}_{end}": _axes(np.asarray(lie.translation(poses)), unit)
        for state, some in (("own", result.maps), ("merged", maps))
        for end, poses in zip("ab", ends_of(closures, some), strict=True)
    }
    return {
        "a": np.asarray(closures.robot_a).tolist(),
        "b": np.asarray(closures.robot_b).tolist(),
        "fate": [FATES[fate] for fate in facts.fate],
        **ends,
        "claimed": _axes(facts.claimed, unit),
    }


def _most(pairs: int) -> int:
    """Closures of each pair of robots whose distances are drawn."""
    return min(MOST_CLOSURES, int(math.sqrt(2.0 * MOST_DISTANCES / max(pairs, 1))))


def _pair(pair: PairSelection, most: int) -> dict[str, Any]:
    rival, found = rival_members(pair), found_members(pair)
    shown = _shown(pair, found | rival, most)
    graph = pair.consistent()[np.ix_(shown, shown)]
    apart = ratios(pair)
    known = None if apart is None else apart[np.ix_(shown, shown)]
    return {
        "a": pair.robot_a,
        "b": pair.robot_b,
        "closures": pair.closures[shown].tolist(),
        "left_out": len(pair.accepted) - len(shown),
        "accepted": bool(pair.accepted.any()),
        "members": np.flatnonzero(found[shown]).tolist(),
        "rival": np.flatnonzero(rival[shown]).tolist(),
        "limit": math.sqrt(pair.gate),
        "measured": known is not None,
        "distances": _packed(graph, known),
        "alignments": _alignments(pair) if rival.any() else {},
    }


def _alignments(pair: PairSelection) -> dict[str, list[list[float]]]:
    """The pose of map b in map a by the rival, and by the set found if that was refused."""
    implied = {"rival": pair.verdict.rival.joint.alignment}
    if not pair.accepted.any():
        found = thinned(np.flatnonzero(found_members(pair)), ALIGNED)
        implied = {"found": joint_consistency(pair.evidence, found).alignment, **implied}
    return {
        name: np.asarray(lie.as_matrix(lie.as_numpy(alignment))).tolist()
        for name, alignment in implied.items()
    }


def _shown(pair: PairSelection, first: Bool[np.ndarray, " k"], most: int) -> Int[np.ndarray, " n"]:
    """The closures whose distances are drawn, by place: along robot a's way, then b's."""
    count = len(pair.accepted)
    chosen = np.arange(count)
    if count > most:
        rest = np.flatnonzero(~first)
        room = max(most - int(first.sum()), 0)
        spaced = rest[np.linspace(0, len(rest) - 1, min(room, len(rest))).astype(int)]
        chosen = np.union1d(np.flatnonzero(first)[:most], spaced)
    measured, maps = pair.evidence.measured, pair.evidence.maps
    if measured is None or maps is None:
        return chosen
    ways = (
        way_of(maps[0])[np.asarray(measured.pose_a)],
        way_of(maps[1])[np.asarray(measured.pose_b)],
    )
    return chosen[np.lexsort((chosen, ways[1][chosen], ways[0][chosen]))]


def _packed(graph: Bool[np.ndarray, "n n"], apart: Float[np.ndarray, "n n"] | None) -> str:
    if apart is None:
        levels = np.where(graph, 64, 255)
    else:
        with np.errstate(divide="ignore", invalid="ignore"):
            beyond = 128.0 + np.minimum(127.0, np.floor(STEPS * np.log2(apart)))
        beyond = np.where(np.isfinite(apart), np.clip(beyond, 128.0, 255.0), 255.0)
        within = np.floor(127.0 * np.minimum(np.nan_to_num(apart), 1.0))
        levels = np.where(graph, within, beyond)
    rows = levels.astype(np.uint8)[np.triu_indices(len(graph), 1)]
    return base64.b64encode(rows.tobytes()).decode("ascii")


@on_host
def _anchors(result: MergeResult, unit: float) -> list[dict[str, Any] | None]:
    """The middle of each merged map that is tied to another, and its place's covariance there.

    The covariance of δ in `T_r t(m) exp(δ)` has its translation in the map's own axes: turned into
    the group's by T_r's rotation.
    """
    placed = {robot: members[0] for members in result.groups for robot in members}
    if all(robot == first for robot, first in placed.items()):
        return [None] * len(result.maps)
    covariances, scale = result.anchor_covariance_at_middle, float(chi2_gate(ELLIPSE, 2))
    rows: list[dict[str, Any] | None] = []
    for robot, one in enumerate(result.graph.maps):
        middle = lie.translation(lie.as_numpy(one.poses)).mean(axis=0)
        space = len(middle)
        turn = np.asarray(lie.as_matrix(lie.take(lie.as_numpy(result.anchors), robot)))
        turn = turn[:space, :space]
        rows.append(
            None
            if robot == placed[robot] or not np.isfinite(covariances[robot]).all()
            else {
                "robot": robot,
                "middle": np.rint(middle / unit).astype(np.int64).tolist(),
                "covariance": (turn @ covariances[robot][:space, :space] @ turn.T).tolist(),
                "scale": scale,
            }
        )
    return rows
