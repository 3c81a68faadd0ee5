"""The facts on every closure that figures need: its fate, and how far it is off when merged.

A closure between pose i of robot a and pose k of robot b claims, once the maps are merged, that k
is at `P_i z`; it is off by Log(P_k⁻¹ P_i z).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.graph import LoopClosures
from pcm_jax.merging import MergeResult
from pcm_jax.selection import PairSelection

ACCEPTED, REFUSED, RIVAL, REJECTED = range(4)
FATES = ("accepted", "refused", "rival", "rejected")
"""Fates: refused is a member of the set that was found between two robots and not accepted."""


@dataclass(frozen=True, eq=False)
class Facts:
    """The facts on m closures.

    Attributes:
        fate: int `[m]`, an index of `FATES`.
        away: float `[m]`, how far off it is in the merged maps, metres; NaN between maps that are
            not in one frame.
        turned: float `[m]`, likewise, degrees.
        claimed: float `[m, s]`, where it puts its second pose, in the merged maps' frame.
    """

    fate: Int[np.ndarray, " m"]
    away: Float[np.ndarray, " m"]
    turned: Float[np.ndarray, " m"]
    claimed: Float[np.ndarray, "m s"]


def facts_of(result: MergeResult) -> Facts:
    """Gathers what a merge knows of every candidate closure."""
    fate = np.where(result.accepted, ACCEPTED, REJECTED)
    for pair in result.selection.pairs if result.selection else ():
        fate[pair.closures[rival_members(pair)]] = RIVAL
        fate[pair.closures[found_members(pair)]] = REFUSED
        fate[result.accepted] = ACCEPTED
    return Facts(fate, *_residuals(result))


def rival_members(pair: PairSelection) -> np.ndarray:
    """The closures `[k]` of the best set that implies another alignment; none without one."""
    rival = pair.verdict.rival if pair.verdict else None
    return np.zeros(len(pair.accepted), bool) if rival is None else rival.members


def found_members(pair: PairSelection) -> np.ndarray:
    """The closures `[k]` of the set that the method found, accepted or not; one is no set."""
    if pair.members is None or np.count_nonzero(pair.members) < 2:
        return pair.accepted
    return pair.members


def ratios(pair: PairSelection) -> Float[np.ndarray, "k k"] | None:
    """Q / γ of every two closures, the larger of both directions; None where it is streamed."""
    if pair.evidence.is_streamed:
        return None
    squared = np.asarray(pair.squared, np.float64)
    return np.sqrt(np.maximum(np.fmax(squared, squared.T), 0.0) / pair.gate)


def ends_of(closures: LoopClosures, maps: Any) -> tuple[Any, Any]:
    """The poses (Lie `[m]`, NumPy) that closures join, in some maps."""
    first, count = [], 0
    for one in maps:
        first.append(count)
        count += one.num_poses
    poses = lie.concatenate([lie.as_numpy(one.poses) for one in maps])
    start = np.asarray(first)
    at_a = start[np.asarray(closures.robot_a)] + np.asarray(closures.pose_a)
    at_b = start[np.asarray(closures.robot_b)] + np.asarray(closures.pose_b)
    return lie.take(poses, at_a), lie.take(poses, at_b)


def _residuals(result: MergeResult) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Metres and degrees by which each closure is off, and where it puts its second pose."""
    closures = result.candidates
    pose_a, pose_b = ends_of(closures, result.graph.maps)
    claimed = lie.compose(pose_a, lie.as_numpy(closures.measurement))
    error = lie.between(pose_b, claimed)
    space = lie.translation(error).shape[-1]
    away = np.linalg.norm(lie.translation(error), axis=-1)
    turned = np.degrees(np.linalg.norm(np.asarray(lie.log(error))[:, space:], axis=-1))
    group = np.zeros(len(result.maps), int)
    for number, members in enumerate(result.groups):
        group[list(members)] = number
    apart = group[np.asarray(closures.robot_a)] != group[np.asarray(closures.robot_b)]
    away[apart] = turned[apart] = np.nan
    return away, turned, np.asarray(lie.translation(claimed))
