"""GTSAM's readers on every kind of file we write: all factors, and our cost."""

import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.files import write_g2o
from pcm_jax.graph import MultiRobotGraph, symbols

gtsam = pytest.importorskip("gtsam")
KEYS = {letter: symbols.keys(letter, np.arange(8)) for letter in "ab"}
LABELS = [(ord("g") << 56 | ord(label) << 48) + np.arange(8) for label in "AB"]


def cost(graph: MultiRobotGraph) -> float:
    """0.5 Σ rᵀ Ω r over edges and closures, r = Log(z⁻¹ X_i⁻¹ X_j)."""
    whole = [lie.as_numpy(one.poses) for one in graph.maps]

    def half(tail, head, measured):
        residual = lie.log(lie.between(lie.as_numpy(measured.measurement), lie.between(tail, head)))
        return 0.5 * np.einsum("ei,eij,ej->", residual, measured.information, residual)

    total = sum(
        half(lie.take(poses, one.tail), lie.take(poses, one.head), one)
        for poses, one in zip(whole, graph.maps, strict=True)
    )
    if not len(graph.closures):
        return total
    c, group = graph.closures, graph.group
    ends = [
        group(
            np.stack([np.asarray(lie.parameters(whole[r]))[k] for r, k in zip(*end, strict=True)])
        )
        for end in ((c.robot_a, c.pose_a), (c.robot_b, c.pose_b))
    ]
    return total + half(*ends, c)


@pytest.mark.parametrize("ids", ["original", "sequential"])
@pytest.mark.parametrize(
    ("names", "known"),
    [
        (("a",), None),
        (("rover",), [np.arange(8) * 3 + 5]),
        (("a", "b"), None),
        (("b", "a"), [KEYS["b"], KEYS["a"]]),
        (("one, two", 'three "four"'), [np.arange(8) + 100, np.arange(8)[::-1]]),
        (("A", "B"), LABELS),
        (("left", "right"), LABELS),
    ],
)
def test_every_factor_at_our_cost(tmp_path, make_robots, group, names, known, ids):
    graph = make_robots(group, names, known)
    path = tmp_path / "graph.g2o"
    write_g2o(path, graph, ids=ids)
    factors, values = gtsam.readG2o(str(path), group is jaxlie.SE3)
    count = sum(one.num_edges for one in graph.maps) + len(graph.closures)
    assert factors.size() == count
    assert values.size() == sum(one.num_poses for one in graph.maps)
    np.testing.assert_allclose(factors.error(values), cost(graph), rtol=1e-9)
