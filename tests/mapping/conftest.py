"""Small random maps with loops, for the tests of step i."""

from collections.abc import Callable

import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.graph import PoseGraph


def random_map(
    group: type = jaxlie.SE2, poses: int = 30, loops: int = 15, seed: int = 0, noise: float = 0.01
) -> PoseGraph:
    """A random walk with odometry and random loops; noise of random covariance, matched."""
    rng = np.random.default_rng(seed)
    d = lie.tangent_dim(group)
    steps = rng.normal(scale=0.4, size=(poses - 1, d))
    steps[:, 0] += 1.0
    truth = [lie.identity(group)]
    for step in steps:
        truth.append(lie.compose(truth[-1], lie.exp(group, step)))
    truth = lie.stack(truth)
    pairs = rng.integers(0, poses, (4 * loops, 2))
    pairs = pairs[np.abs(pairs[:, 0] - pairs[:, 1]) > 1][:loops]
    tail = np.concatenate([np.arange(poses - 1), pairs[:, 0]])
    head = np.concatenate([np.arange(1, poses), pairs[:, 1]])
    root = noise * (np.eye(d) + 0.3 * rng.normal(size=(len(tail), d, d)))
    covariance = root @ root.transpose(0, 2, 1)
    error = np.einsum("eij,ej->ei", root, rng.normal(size=(len(tail), d)))
    measured = lie.compose(
        lie.between(lie.take(truth, tail), lie.take(truth, head)), lie.exp(group, error)
    )
    return PoseGraph.from_arrays(
        poses=truth, tail=tail, head=head, measurement=measured, covariance=covariance
    )


@pytest.fixture(scope="session")
def make_map() -> Callable[..., PoseGraph]:
    """The function `random_map`."""
    return random_map
