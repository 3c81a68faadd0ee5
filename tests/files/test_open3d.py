"""Open3D's pose graphs: its own convention of an edge, and there and back."""

import json

import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcm_jax import lie
from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files import read_graph, write_graph


def column(matrix):
    return np.asarray(matrix).T.ravel().tolist()


def edge(source, target, poses, uncertain=False):
    """The transform that takes a source's points to the target's frame."""
    relative = np.linalg.inv(poses[target]) @ poses[source]
    weight = np.diag([1.0, 2, 3, 40, 50, 60])  # rotation first
    return {
        "class_name": "PoseGraphEdge",
        "source_node_id": source,
        "target_node_id": target,
        "transformation": column(relative),
        "information": column(weight),
        "uncertain": uncertain,
        "confidence": 0.5 if uncertain else 1.0,
    }


@pytest.fixture
def poses(rng):
    out = np.tile(np.eye(4), (6, 1, 1))
    out[:, :3, :3] = Rotation.random(6, rng=rng).as_matrix()
    out[:, :3, 3] = rng.normal(size=(6, 3))
    return out


@pytest.fixture
def save(tmp_path, poses):
    def make(edges):
        nodes = [{"class_name": "PoseGraphNode", "pose": column(pose)} for pose in poses]
        (tmp_path / "g.json").write_text(
            json.dumps({"class_name": "PoseGraph", "nodes": nodes, "edges": edges})
        )
        return tmp_path / "g.json"

    return make


def test_edges_fit_their_nodes(save, poses):
    graph = read_graph(save([edge(k, k + 1, poses) for k in range(5)] + [edge(5, 0, poses, True)]))
    (one,) = graph.maps
    given = lie.as_numpy(one.poses)
    np.testing.assert_allclose(lie.as_matrix(given), poses, atol=1e-12)
    predicted = lie.between(lie.take(given, one.tail), lie.take(given, one.head))
    apart = lie.log(lie.between(lie.as_numpy(one.measurement), predicted))
    np.testing.assert_allclose(apart, 0.0, atol=1e-9)
    np.testing.assert_allclose(one.information[0], np.diag([40, 50, 60, 1, 2, 3]))


def test_uncertain_edges_are_the_candidates(save, poses):
    """Where the certain ones leave two parts, these are robots."""
    certain = [edge(k, k + 1, poses) for k in (0, 1, 3, 4)]
    graph = read_graph(save([*certain, edge(0, 3, poses, True), edge(5, 2, poses, True)]))
    assert graph.names == ("g-1", "g-2")
    assert [one.ids.tolist() for one in graph.maps] == [[0, 1, 2], [3, 4, 5]]
    assert len(graph.closures) == 2
    np.testing.assert_allclose(graph.closures.weight, 0.5)


def test_clouds_that_do_not_overlap(save, poses):
    """A registration that failed leaves a candidate with information of zero: it says nothing."""
    edges = [edge(k, k + 1, poses) for k in range(5)]
    edges.insert(2, {**edge(5, 0, poses, True), "information": [0.0] * 36})
    with pytest.warns(UserWarning, match=r"skipped 1 lines \(1 edge without information\)"):
        graph = read_graph(save(edges))
    assert graph.maps[0].num_edges == 5
    edges[2]["uncertain"] = False
    with pytest.raises(FileFormatError, match="information is not positive definite"):
        read_graph(save(edges))


def test_there_and_back(tmp_path, make_robots):
    graph = make_robots(jaxlie.SE3)
    write_graph(tmp_path / "ab.json", graph)
    again = read_graph(tmp_path / "ab.json")
    assert again.names == ("ab-1", "ab-2")
    for one, other in zip(graph.maps, again.maps, strict=True):
        ours, theirs = (lie.as_matrix(lie.as_numpy(m.measurement)) for m in (one, other))
        np.testing.assert_allclose(ours, theirs, atol=1e-12)
        np.testing.assert_allclose(one.information, other.information, rtol=1e-12)
        assert one.tail.tolist() == other.tail.tolist()
    assert again.closures.pose_a.tolist() == graph.closures.pose_a.tolist()
    assert again.closures.robot_b.tolist() == graph.closures.robot_b.tolist()


def test_flat_graphs_are_not_written(tmp_path, make_robots):
    with pytest.raises(InputError, match="graph: SE2 given, expected SE3"):
        write_graph(tmp_path / "ab.json", make_robots(jaxlie.SE2))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"source_node_id": 9}, r"edges\[0\]: nodes \[1, 9\] given, expected 0 … 5"),
        ({"information": [1.0]}, r"edges\[0\].information: a list of 1 given, expected 36 numbers"),
        ({"transformation": [1.0] * 16}, "is not a rotation matrix"),
    ],
)
def test_bad_files(save, poses, change, message):
    edges = [edge(k, k + 1, poses) for k in range(5)]
    edges[0].update(change)
    with pytest.raises(FileFormatError, match=message) as caught:
        read_graph(save(edges))
    assert "\n" not in str(caught.value)
