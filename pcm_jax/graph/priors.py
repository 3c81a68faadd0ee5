"""Poses of one map that were measured by themselves, by GPS or against a known place."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph import checked, validation
from pcm_jax.graph.checked import batch_size

NEGATIVE = 1e-9  # of the largest eigenvalue: rounding, not a negative information


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

    @classmethod
    def from_arrays(
        cls, *, pose: Any, measurement: Any, information: Any, source: Any = None
    ) -> Priors:
        """Makes validated priors, float64.

            gps = Priors.from_arrays(pose=[0, 40], measurement=fixes, information=weights)
            graph = dataclasses.replace(graph, priors=gps)

        Args:
            pose: integers `[k]`, indices of the map's poses.
            measurement: `jaxlie.SE2` or `jaxlie.SE3` `[k]`, or homogeneous matrices.
            information: `[k, d, d]`, symmetric and positive semidefinite; (translation, rotation).
            source: strings `[k]`, where each was read.

        Raises:
            InputError: for a wrong shape, a negative index, a matrix that is not a rigid motion,
                information that is not finite, symmetric and positive semidefinite.
        """
        given = checked.as_transforms(measurement, "measurement")
        count, d = batch_size(given), lie.tangent_dim(given)
        index = validation.as_indices(pose, None, "pose", "poses")
        if len(index) != count:
            raise InputError(
                f"pose: {len(index)} entries given, expected {count}, one per measurement"
            )
        matrices = np.asarray(information, np.float64)
        if matrices.shape != (count, d, d):
            raise InputError(f"information: shape {matrices.shape}, expected {(count, d, d)}")
        _check_semidefinite(matrices)
        names = checked.as_names(source, count)
        return cls(index.astype(np.int32), lie.as_numpy(given), matrices, names)

    def __getitem__(self, rows: Any) -> Priors:
        """Some of the priors, by a mask `[k]` or indices."""
        chosen = np.asarray(rows)
        measurement = lie.take(self.measurement, chosen)
        return Priors(self.pose[chosen], measurement, self.information[chosen], self.source[chosen])

    def shifted(self, poses: int) -> Priors:
        """The same priors on poses that many places later."""
        return dataclasses.replace(self, pose=(self.pose + poses).astype(np.int32))

    @classmethod
    def concatenate(cls, parts: list[Priors]) -> Priors:
        """Joins priors end to end; at least one part."""
        return cls(
            np.concatenate([part.pose for part in parts]).astype(np.int32),
            lie.concatenate([lie.as_numpy(part.measurement) for part in parts]),
            np.concatenate([part.information for part in parts]),
            np.concatenate([part.source for part in parts]),
        )

    def __repr__(self) -> str:
        return f"Priors({len(self)}, {type(self.measurement).__name__})"


def _check_semidefinite(matrices: Float[np.ndarray, "k d d"]) -> None:
    bad = ~np.isfinite(matrices).all(axis=(1, 2))
    if not bad.any():
        bad = np.abs(matrices - matrices.swapaxes(1, 2)).max(axis=(1, 2), initial=0.0) > (
            NEGATIVE * np.abs(matrices).max(axis=(1, 2), initial=0.0)
        )
    if not bad.any() and len(matrices):
        values = np.linalg.eigvalsh(matrices)
        bad = values[:, 0] < -NEGATIVE * values[:, -1]
    if bad.any():
        raise InputError(
            f"information[{np.flatnonzero(bad)[0]}]: expected a finite, symmetric and positive"
            " semidefinite matrix"
        )
