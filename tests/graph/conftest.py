"""Random pose graphs."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.graph import PoseGraph


def definite(rng: np.random.Generator, count: int, d: int) -> np.ndarray:
    """Random well-conditioned information matrices."""
    root = rng.normal(size=(count, d, d))
    return root @ np.swapaxes(root, 1, 2) + d * np.eye(d)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture
def make_graph(rng: np.random.Generator) -> Callable[..., PoseGraph]:
    """A chain with loops whose measurements agree exactly with its poses."""

    def make(group: Any, n: int = 12, loops: int = 8, **fields: Any) -> PoseGraph:
        d = lie.tangent_dim(group)
        poses = lie.exp(group, rng.normal(size=(n, d)))
        start = rng.integers(0, n - 2, loops)
        tail = np.concatenate([np.arange(n - 1), start])
        head = np.concatenate([np.arange(1, n), rng.integers(start + 2, n)])
        return PoseGraph.from_arrays(
            poses=poses,
            tail=tail,
            head=head,
            measurement=lie.between(lie.take(poses, tail), lie.take(poses, head)),
            information=definite(rng, len(tail), d),
            **fields,
        )

    return make
