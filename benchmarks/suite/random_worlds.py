"""Small random maps with loops, and closures between them, in either group.

Every measurement is `true · exp(δ)`, δ normal of a random covariance, which is the one recorded.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jaxlie
import numpy as np
from jaxtyping import Float

from pcm_jax import LoopClosures, PoseGraph, lie

RANK = 60
"""Of the joint covariances of `between_chains`."""
NOISE = 0.02
"""Of map edges, radians and metres: small enough for first-order propagation to hold."""


def random_map(
    group: Any, generator: np.random.Generator, *, poses: int = 30, loops: int = 15
) -> PoseGraph:
    """A random walk with loops, its poses the true ones."""
    tangents: Any = generator.normal(scale=0.3, size=(poses - 1, lie.tangent_dim(group)))
    tangents[:, 0] += 1.0
    steps = lie.exp(group, tangents)
    truth = [lie.identity(group)]
    for k in range(poses - 1):
        truth.append(lie.compose(truth[-1], lie.take(steps, k)))
    tail = np.append(np.arange(poses - 1), generator.integers(0, poses - 2, loops))
    head = tail + 1
    head[poses - 1 :] = generator.integers(tail[poses - 1 :] + 2, poses)
    ends = (lie.take(lie.stack(truth), index) for index in (tail, head))
    measurement, covariance = _measured(generator, lie.between(*ends), NOISE)
    return PoseGraph.from_arrays(
        poses=lie.stack(truth),
        tail=tail,
        head=head,
        measurement=measurement,
        covariance=covariance,
    )


def random_closures(
    generator: np.random.Generator,
    maps: Sequence[PoseGraph],
    count: int,
    *,
    truth: Sequence[Any] | None = None,
    noise: float = 0.1,
    once: bool = False,
) -> LoopClosures:
    """Closures from random poses of the first map to random poses of the second.

    Args:
        generator: source of randomness.
        maps: two of them.
        count: number of closures.
        truth: true poses of both maps, by default the maps' own.
        noise: standard deviation, about.
        once: whether a pose is touched at most once.
    """
    poses = truth or [lie.as_numpy(graph.poses) for graph in maps]
    touched = [generator.choice(graph.num_poses, count, replace=not once) for graph in maps]
    ends = (lie.take(each, index) for each, index in zip(poses, touched, strict=True))
    measurement, covariance = _measured(generator, lie.between(*ends), noise)
    return LoopClosures.from_arrays(
        robot_a=np.zeros(count, int),
        pose_a=touched[0],
        robot_b=np.ones(count, int),
        pose_b=touched[1],
        measurement=measurement,
        covariance=covariance,
    )


def between_chains(count: int, poses: int | None = None) -> dict[str, Any]:
    """Closures between two chains of poses in space.

    The joint covariances are random ones of low rank: a kernel's time does not depend on them, and
    finding those of 6,000 coordinates would take longer than all the rest.

    Args:
        count: of closures.
        poses: of either chain; by default as many as closures, each of which has its own.

    Returns:
        What `consistency_problem` takes.
    """
    generator = np.random.default_rng(count)
    maps = []
    for _ in range(2):
        tangents: Any = generator.normal(size=(poses or count, 6))
        chain = lie.exp(jaxlie.SE3, tangents)
        maps.append(PoseGraph.from_trajectory(chain, sigma_translation=0.1, sigma_rotation=0.01))
    closures = random_closures(generator, maps, count, once=poses is None)
    touched = [len(np.unique(each)) for each in (closures.pose_a, closures.pose_b)]
    roots = [generator.normal(scale=0.01, size=(6 * own, RANK)) for own in touched]
    marginals = tuple(root @ root.T for root in roots)
    return {"map_a": maps[0], "map_b": maps[1], "closures": closures, "marginals": marginals}


def moved(graph: PoseGraph, generator: np.random.Generator, distance: float) -> PoseGraph:
    """The same map in another frame, so far away."""
    tangent: Any = generator.normal(size=graph.tangent_dim)
    tangent[:2] = distance
    motion = lie.exp(graph.group, tangent)
    poses = lie.compose(motion, lie.as_numpy(graph.poses))
    return graph.with_poses(lie.as_device(lie.normalize(poses)))


def _measured(
    generator: np.random.Generator, truth: Any, noise: float
) -> tuple[Any, Float[np.ndarray, "k d d"]]:
    """Noisy measurements and the covariances of their noise."""
    group = lie.group_of(truth)
    count, d = len(lie.parameters(truth)), lie.tangent_dim(group)
    roots = noise * (np.eye(d) + 0.3 * generator.normal(size=(count, d, d)))
    error: Any = np.einsum("kij,kj->ki", roots, generator.normal(size=(count, d)))
    return lie.compose(truth, lie.exp(group, error)), roots @ roots.transpose(0, 2, 1)
