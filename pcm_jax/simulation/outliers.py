"""False closures between two robots: the aliased ones and the random ones.

The outliers' law is not in the paper and decides every false positive rate. Here:

- a *random* outlier ties two random poses; its measurement says that pose k of robot b stands
  anywhere in the two robots' common bounding box, in any orientation (or, with a range given,
  anywhere within that range of pose i);
- an *aliased group* shares one wrong alignment of map b: a displacement W that carries one place
  onto another far from it. Its members are pose pairs that W brings together, as perceptual
  aliasing does, measured with the inliers' noise: `z = P_i⁻¹ W P_k exp(δ)`. They agree with each
  other exactly as well as true closures do.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jaxlie
import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.simulation.measurements import measure, space_dim

RANDOM_LABEL = -1
# Places that are mistaken for each other lie at least this fraction of the maps' diagonal apart.
ALIAS_SEPARATION = 0.25
ALIAS_DRAWS = 64


class Candidates(NamedTuple):
    """False closures from robot a to robot b, `[m]` each; labels as in `SimulatedWorld`."""

    pose_a: Int[np.ndarray, " m"]
    pose_b: Int[np.ndarray, " m"]
    measurement: jaxlie.MatrixLieGroup
    labels: Int[np.ndarray, " m"]

    @property
    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the poses at both ends."""
        return self.pose_a, self.pose_b


def false_closures(
    generator: np.random.Generator,
    truth_a: Any,
    truth_b: Any,
    *,
    groups: int,
    size: int,
    first_label: int,
    random: int,
    random_range: float | None,
    reach: float,
    covariance: Float[np.ndarray, "#m d d"],
) -> Candidates:
    """`groups` aliased groups of `size`, labelled from `first_label` on, then `random` others.

    `covariance` is the noise of each of the `groups · size + random`, of which only the aliased
    ones make use.
    """
    noise = np.broadcast_to(covariance, (groups * size + random, *covariance.shape[-2:]))
    parts = [
        aliased_closures(
            generator,
            truth_a,
            truth_b,
            size=size,
            label=first_label + k,
            reach=reach,
            covariance=noise[k * size : (k + 1) * size],
        )
        for k in range(groups)
    ]
    parts.append(
        random_closures(generator, truth_a, truth_b, count=random, largest_range=random_range)
    )
    pose_a, pose_b, measurement, labels = zip(*parts, strict=True)
    return Candidates(
        np.concatenate(pose_a),
        np.concatenate(pose_b),
        lie.concatenate(measurement),
        np.concatenate(labels),
    )


def aliased_closures(
    generator: np.random.Generator,
    truth_a: Any,
    truth_b: Any,
    *,
    size: int,
    label: int,
    reach: float,
    covariance: Float[np.ndarray, "#s d d"],
) -> Candidates:
    """`size` measurements of pose pairs that one wrong alignment of map b brings together.

    Pairs within `reach` of each other are as likely as each other; where there are fewer than
    `size`, the closest others follow.

    Raises:
        InputError: `size` is larger than the number of poses of robot a.
    """
    from scipy.spatial import KDTree

    moved = lie.compose(_wrong_alignment(generator, truth_a, truth_b, reach), truth_b)
    distance, nearest = map(
        np.asarray, KDTree(lie.translation(moved)).query(lie.translation(truth_a))
    )
    if size > len(nearest):
        raise InputError(
            f"aliased_size: {size} asked for, expected at most one for each of the "
            f"{len(nearest)} poses of the robot"
        )
    ties = generator.random(len(nearest))
    pose_a = np.lexsort((ties, np.maximum(distance, reach)))[:size]
    pose_b = nearest[pose_a]
    exact = lie.between(lie.take(truth_a, pose_a), lie.take(moved, pose_b))
    measurement = measure(generator, exact, covariance)
    return Candidates(pose_a, pose_b, measurement, np.full(size, label))


def _wrong_alignment(
    generator: np.random.Generator, truth_a: Any, truth_b: Any, reach: float
) -> Any:
    """W = P_i s P_k⁻¹ carries the surroundings of a random pose k of b to a pose i of a far away.

    The shift s, of up to `reach` along every axis, keeps W off the grid of streets, where two
    independent draws could coincide.
    """
    i = generator.integers(len(lie.translation(truth_a)), size=ALIAS_DRAWS)
    k = generator.integers(len(lie.translation(truth_b)), size=ALIAS_DRAWS)
    apart = np.linalg.norm(lie.translation(truth_a)[i] - lie.translation(truth_b)[k], axis=1)
    low, high = _bounding_box(truth_a, truth_b)
    far = apart >= ALIAS_SEPARATION * np.linalg.norm(high - low)
    drawn = np.argmax(far) if far.any() else np.argmax(apart)
    group = lie.group_of(truth_a)
    tangent: Any = np.zeros(lie.tangent_dim(group))
    tangent[: space_dim(group)] = generator.uniform(-reach, reach, size=space_dim(group))
    shifted = lie.compose(lie.take(truth_a, i[drawn]), lie.exp(group, tangent))
    return lie.compose(shifted, lie.inverse(lie.take(truth_b, k[drawn])))


def _bounding_box(truth_a: Any, truth_b: Any) -> tuple[np.ndarray, np.ndarray]:
    places = np.concatenate([lie.translation(truth_a), lie.translation(truth_b)])
    return places.min(axis=0), places.max(axis=0)


def random_closures(
    generator: np.random.Generator,
    truth_a: Any,
    truth_b: Any,
    *,
    count: int,
    largest_range: float | None = None,
) -> Candidates:
    """`count` measurements between random poses that say nothing about where the robots are.

    Args:
        generator: source of randomness.
        truth_a: true poses of robot a in the common frame.
        truth_b: true poses of robot b in the common frame.
        count: how many.
        largest_range: metres between the two poses; None: anywhere in the bounding box.
    """
    pose_a = generator.integers(len(lie.translation(truth_a)), size=count)
    pose_b = generator.integers(len(lie.translation(truth_b)), size=count)
    group, space = lie.group_of(truth_a), space_dim(lie.group_of(truth_a))
    rotation = _on_sphere(generator, count, lie.module_of(group).PARAMETERS_DIM - space)
    if largest_range is None:
        place = generator.uniform(*_bounding_box(truth_a, truth_b), size=(count, space))
        stands = group(np.concatenate([rotation, place], axis=1))
        measurement = lie.between(lie.take(truth_a, pose_a), stands)
    else:
        radius = largest_range * generator.random((count, 1)) ** (1.0 / space)
        place = radius * _on_sphere(generator, count, space)
        measurement = group(np.concatenate([rotation, place], axis=1))
    return Candidates(pose_a, pose_b, measurement, np.full(count, RANDOM_LABEL))


def _on_sphere(generator: np.random.Generator, count: int, size: int) -> Float[np.ndarray, "c k"]:
    """Uniform unit vectors; of four entries, and of two, they are uniform rotations."""
    vectors = generator.standard_normal((count, size))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
