"""Poses of one map that were measured by themselves, by GPS or against a known place."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pcm_jax.graph.checked import batch_size


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Priors:
    """Measurements of single poses in the map's own frame.

    Prior k says that pose `pose[k]` is `measurement[k]`, with an error in its right perturbation
    `z exp(δ)`, δ = (translation, rotation) in metres and radians. Information may lack directions
    (a position without an attitude has none for rotations): it is positive semidefinite.

    Attributes:
        pose: int32 `[k]`, indices.
        measurement: `jaxlie.SE2` or `jaxlie.SE3` `[k]`, NumPy-backed.
        information: `[k, d, d]`.
        source: object `[k]` of strings, "file:line".
    """

    pose: Int[np.ndarray, " k"]
    measurement: Any
    information: Float[np.ndarray, "k d d"]
    source: np.ndarray

    def __len__(self) -> int:
        return batch_size(self.measurement)

    def __repr__(self) -> str:
        return f"Priors({len(self)}, {type(self.measurement).__name__})"
