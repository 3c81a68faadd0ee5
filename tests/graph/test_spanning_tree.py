import networkx
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph import spanning_tree_poses
from pcm_jax.graph.spanning_tree import spanning_tree


def ends(graph):
    return np.asarray(graph.tail, np.int64), np.asarray(graph.head, np.int64)


@pytest.mark.parametrize("prefer", ["shortest", "odometry"])
@pytest.mark.parametrize("root", [0, 5])
def test_consistent_measurements_give_the_poses_back(make_graph, group, prefer, root):
    graph = make_graph(group, n=60, loops=40)
    poses = lie.as_numpy(graph.poses)
    start = lie.take(poses, root)
    found = spanning_tree_poses(
        *ends(graph), graph.measurement, 60, root=root, root_pose=start, prefer=prefer
    )
    np.testing.assert_allclose(lie.log(lie.between(poses, found)), 0.0, atol=1e-9)


def test_backward_edges_are_inverted(make_graph, group):
    graph = make_graph(group, n=30, loops=0)
    tail, head = ends(graph)
    backward = lie.inverse(lie.as_numpy(graph.measurement))
    forward = spanning_tree_poses(tail, head, graph.measurement, 30)
    turned = spanning_tree_poses(head, tail, backward, 30)
    np.testing.assert_allclose(lie.log(lie.between(forward, turned)), 0.0, atol=1e-9)


def test_shortest_tree_has_the_depths_of_breadth_first_search(make_graph, group):
    graph = make_graph(group, n=80, loops=60)
    tail, head = ends(graph)
    parent, edge, forward = spanning_tree(tail, head, 80, root=3)
    network = networkx.Graph(zip(tail.tolist(), head.tolist(), strict=True))
    expected = networkx.single_source_shortest_path_length(network, 3)
    for pose in range(80):
        depth, at = 0, pose
        while parent[at] >= 0:
            joined = (tail[edge[at]], head[edge[at]])
            assert joined == ((parent[at], at) if forward[at] else (at, parent[at]))
            depth, at = depth + 1, parent[at]
        assert depth == expected[pose]


def test_odometry_tree_ignores_loops_where_there_is_a_chain(make_graph, group, rng):
    """Wrong loops do not move a single pose."""
    graph = make_graph(group, n=50, loops=30)
    chain = spanning_tree_poses(
        *(end[:49] for end in ends(graph)),
        lie.take(lie.as_numpy(graph.measurement), slice(49)),
        50,
    )
    rows = np.array(lie.parameters(lie.as_numpy(graph.measurement)))
    rows[49:] = lie.parameters(lie.exp(group, rng.normal(size=(30, graph.tangent_dim))))
    order = rng.permutation(len(rows))
    tail, head = ends(graph)
    found = spanning_tree_poses(tail[order], head[order], group(rows[order]), 50, prefer="odometry")
    np.testing.assert_allclose(lie.log(lie.between(chain, found)), 0.0, atol=1e-9)


def test_of_repeated_edges_the_first_counts(make_graph, group, rng):
    graph = make_graph(group, n=10, loops=0)
    tail, head = ends(graph)
    clean = lie.as_numpy(graph.measurement)
    other = lie.exp(group, rng.normal(size=(9, graph.tangent_dim)))
    both = lie.concatenate([clean, other])
    found = spanning_tree_poses(np.tile(tail, 2), np.tile(head, 2), both, 10)
    expected = spanning_tree_poses(tail, head, clean, 10)
    np.testing.assert_allclose(lie.log(lie.between(expected, found)), 0.0, atol=1e-12)


def test_a_single_pose_is_a_tree(group):
    none = np.zeros(0, np.int64)
    poses = spanning_tree_poses(none, none, lie.identity(group, (0,)), 1)
    np.testing.assert_array_equal(lie.log(poses), np.zeros((1, lie.tangent_dim(group))))


def test_disconnected_graphs_name_a_pose_out_of_reach(group):
    steps = lie.identity(group, (2,))
    with pytest.raises(InputError, match=r"into 4 parts: .* from pose 10 to pose 14, exp"):
        spanning_tree_poses([0, 4], [1, 3], steps, 6, ids=np.array([10, 11, 14, 13, 12, 15]))


def test_unknown_preference(group):
    with pytest.raises(InputError, match="prefer: 'longest' given"):
        spanning_tree_poses([0], [1], lie.identity(group, (1,)), 2, prefer="longest")
