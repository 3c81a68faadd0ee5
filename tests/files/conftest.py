"""Small files written by hand, and random graphs."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(11)


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Writes lines to a file in a folder of its own and gives its path."""

    def make(*lines: str, name: str = "graph.g2o") -> Path:
        path = tmp_path / name
        path.write_text("\n".join(lines) + "\n")
        return path

    return make


def definite(rng: np.random.Generator, count: int, d: int) -> np.ndarray:
    root = rng.normal(size=(count, d, d))
    return root @ np.swapaxes(root, 1, 2) + np.eye(d)


@pytest.fixture
def make_robots(rng: np.random.Generator) -> Callable[..., MultiRobotGraph]:
    """Chains with loops, and random closures between consecutive robots."""

    def make(
        group: Any, names: tuple[str, ...] = ("a", "b"), ids: Any = None, n: int = 8, m: int = 5
    ) -> MultiRobotGraph:
        d = lie.tangent_dim(group)
        maps = []
        for robot, name in enumerate(names):
            tail, head = np.r_[np.arange(n - 1), 6, 0, 0], np.r_[np.arange(1, n), 2, 5, 5]
            maps.append(
                PoseGraph.from_arrays(
                    poses=lie.exp(group, rng.normal(size=(n, d))),
                    tail=tail,
                    head=head,
                    measurement=lie.exp(group, rng.normal(size=(len(tail), d))),
                    information=definite(rng, len(tail), d),
                    ids=None if ids is None else ids[robot],
                    name=name,
                )
            )
        if len(names) < 2:
            return MultiRobotGraph(tuple(maps))
        robot = rng.integers(0, len(names), m)
        closures = LoopClosures.from_arrays(
            robot_a=robot,
            pose_a=rng.integers(0, n, m),
            robot_b=(robot + 1) % len(names),
            pose_b=rng.integers(0, n, m),
            measurement=lie.exp(group, rng.normal(size=(m, d))),
            information=definite(rng, m, d),
        )
        return MultiRobotGraph(tuple(maps), closures)

    return make


@pytest.fixture
def assert_same() -> Callable[[MultiRobotGraph, MultiRobotGraph], None]:
    """Two graphs agree: names, ids, order, and numbers to 1e-12; q and −q are one rotation."""

    def check(first: MultiRobotGraph, second: MultiRobotGraph) -> None:
        assert first.names == second.names
        for one, other in zip(first.maps, second.maps, strict=True):
            np.testing.assert_array_equal(one.ids, other.ids)
            same_transforms(one.poses, other.poses)
            same_transforms(one.measurement, other.measurement)
            np.testing.assert_array_equal(one.tail, other.tail)
            np.testing.assert_array_equal(one.head, other.head)
            np.testing.assert_allclose(one.information, other.information, rtol=1e-12)
        same_transforms(first.closures.measurement, second.closures.measurement)
        for a, b in zip(
            jax.tree.leaves(first.closures)[:4], jax.tree.leaves(second.closures)[:4], strict=True
        ):
            np.testing.assert_array_equal(a, b)
        np.testing.assert_allclose(
            first.closures.information, second.closures.information, rtol=1e-12
        )

    return check


def same_transforms(first: Any, second: Any) -> None:
    a, b = (np.asarray(lie.parameters(lie.as_numpy(some))) for some in (first, second))
    assert a.shape == b.shape
    if a.shape[1] == 7:
        b = np.concatenate(
            [
                b[:, :4] * np.sign(np.sum(a * b, 1, where=[True] * 4 + [False] * 3))[:, None],
                b[:, 4:],
            ],
            1,
        )
    np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
