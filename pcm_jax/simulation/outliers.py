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
from jaxtyping import Array, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import namespace
from pcm_jax.errors import InputError
from pcm_jax.simulation.measurements import measure, space_dim

RANDOM_LABEL = -1
# Places that are mistaken for each other lie at least this fraction of the maps' diagonal apart.
ALIAS_SEPARATION = 0.25
ALIAS_DRAWS = 64

_Indices = Int[np.ndarray, " n"] | Int[Array, " n"]


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

    i, k = (
        generator.integers(len(lie.translation(t)), size=ALIAS_DRAWS) for t in (truth_a, truth_b)
    )
    shift = generator.uniform(-reach, reach, size=space_dim(lie.group_of(truth_a)))
    moved = lie.compose(wrong_alignment((i, k), shift, truth_a, truth_b), truth_b)
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


def wrong_alignment(
    draws: tuple[_Indices, _Indices],
    shift: Float[np.ndarray, " s"] | Float[Array, " s"],
    path_a: Any,
    path_b: Any,
) -> Any:
    """W = P_i s P_k⁻¹, which carries the surroundings of a pose k of b to a pose i of a far away.

    Safe under jit and vmap.

    Args:
        draws: random poses of a, and of b, `ALIAS_DRAWS` each: the first two that are far enough
            apart are taken, or those that are farthest apart.
        shift: s, random along every axis, m. It keeps W off the grid of streets, where two
            independent draws could coincide.
        path_a: poses of robot a, Lie `[n]`.
        path_b: poses of robot b.
    """
    (i, k), group = draws, lie.group_of(path_a)
    xp = namespace(shift, lie.translation(path_a))
    apart = squared_lengths(lie.translation(path_a)[i] - lie.translation(path_b)[k])
    low, high = bounding_box(path_a, path_b)
    far = apart >= ALIAS_SEPARATION**2 * squared_lengths(high - low)
    drawn = xp.argmax(xp.where(far.any(), far, apart))
    tangent = xp.concatenate([shift, xp.zeros(lie.tangent_dim(group) - len(shift))])
    shifted = lie.compose(lie.take(path_a, i[drawn]), lie.exp(group, tangent))
    return lie.compose(shifted, lie.inverse(lie.take(path_b, k[drawn])))


def bounding_box(path_a: Any, path_b: Any) -> tuple[Float[Array, " s"], Float[Array, " s"]]:
    """The lowest and the highest corner of the box around both paths, m."""
    places = [lie.translation(path_a), lie.translation(path_b)]
    both = namespace(*places).concatenate(places)
    return both.min(axis=0), both.max(axis=0)


def squared_lengths(vectors: Float[Array, "*batch s"]) -> Float[Array, "*batch"]:
    """Squared lengths along the last axis."""
    return (vectors**2).sum(axis=-1)


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
        place = generator.uniform(*bounding_box(truth_a, truth_b), size=(count, space))
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
