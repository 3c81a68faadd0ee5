"""The rows of a merge's report: what was made of each closure, and of each pair of robots."""

from __future__ import annotations

from typing import Any

import numpy as np

from pcm_jax import lie
from pcm_jax.integrity import explain
from pcm_jax.selection import PairSelection

POSE_FIELDS = {3: ("x", "y", "theta"), 6: ("x", "y", "z", "qx", "qy", "qz", "qw")}


def closure_rows(result: Any) -> list[dict[str, Any]]:
    """The rows of a report on the candidate closures."""
    return [
        {
            "index": told.index,
            "a": told.a,
            "b": told.b,
            "source": str(result.candidates.source[told.index]),
            "accepted": told.accepted,
            **told.as_dict(),
        }
        for told in explain(result)
    ]


def pair_rows(result: Any) -> list[dict[str, Any]]:
    """The rows on the pairs of robots that candidates join."""
    maps, closures = result.graph.maps, result.candidates
    decided = result.selection.pairs if result.selection else ()
    certificates = {(pair.robot_a, pair.robot_b): pair for pair in decided}
    rows = []
    for a, b in closures.pairs():
        _, indices = closures.between(a, b)
        pair = certificates.get((a, b))
        row = {
            "a": maps[a].name,
            "b": maps[b].name,
            "measured": len(indices),
            "accepted": int(result.accepted[indices].sum()),
            "optimal": pair and pair.optimal,
            "upper_bound": pair and pair.upper_bound,
        }
        row |= _judged(pair)
        if pair is not None and pair.weight is not None:
            row |= {"weight": pair.weight, "weight_bound": pair.weight_bound}
        rows.append(row)
    return rows


def _judged(pair: PairSelection | None) -> dict[str, Any]:
    """The fields of a report on what was found between two robots, and why it is believed."""
    if pair is None or pair.verdict is None:
        names = ("found", "places", "chance", "rival", "ambiguous", "joint", "why")
        return dict.fromkeys(names)
    verdict, joint = pair.verdict, pair.joint
    return {
        "found": verdict.found,
        "places": verdict.places,
        "chance": verdict.chance.p_value if verdict.chance else None,
        "rival": _rival(verdict.rival),
        "ambiguous": verdict.ambiguous,
        "joint": {"chi2": joint.chi2, "dof": joint.dof, "p": joint.p} if joint else None,
        "why": verdict.why,
    }


def _rival(rival: Any) -> dict[str, Any] | None:
    if rival is None:
        return None
    return {
        "size": rival.size,
        "places": rival.places,
        "shared": rival.shared,
        "alignment": pose_fields(rival.joint.alignment),
        "chance": rival.chance.p_value if rival.chance else None,
    }


def pose_fields(pose: Any) -> dict[str, float]:
    """A pose as numbers by name: translation in metres; an angle in radians, or a quaternion."""
    if lie.tangent_dim(pose) == 3:
        cos, sin, x, y = map(float, lie.components(lie.as_numpy(pose)))
        values = [x, y, float(np.arctan2(sin, cos))]
    else:
        w, *axis, x, y, z = map(float, lie.components(lie.as_numpy(pose)))
        values = [x, y, z, *axis, w]
    return dict(zip(POSE_FIELDS[lie.tangent_dim(pose)], values, strict=True))
