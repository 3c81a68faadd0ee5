import itertools

import jax
import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures, MultiRobotGraph, split
from pcm_jax.graph.multi_robot import letter_names, unique_names


def closures_of(group, robot_b=1, pose_b=11):
    d = lie.tangent_dim(group)
    return LoopClosures.from_arrays(
        robot_a=[0],
        pose_a=[0],
        robot_b=[robot_b],
        pose_b=[pose_b],
        measurement=lie.identity(group, (1,)),
        information=np.eye(d)[None],
    )


def test_unnamed_robots_are_lettered(make_graph, group):
    graph = MultiRobotGraph((make_graph(group), make_graph(group, name="a"), make_graph(group)))
    assert graph.names == ("b", "a", "c")
    assert len(graph.closures) == 0
    assert graph.tangent_dim == graph.maps[0].tangent_dim
    assert graph.group is group


def test_names_are_unique():
    assert unique_names(["car", "car", "", "car-2", "car"]) == [
        "car",
        "car-3",
        "a",
        "car-2",
        "car-4",
    ]
    assert list(itertools.islice(letter_names(), 25, 28)) == ["z", "aa", "ab"]


def test_pytree_of_maps_and_closures(make_graph, group):
    graph = MultiRobotGraph((make_graph(group), make_graph(group)), closures_of(group))
    again = jax.jit(lambda graph: graph)(graph)
    assert isinstance(again, MultiRobotGraph)
    for a, b in zip(jax.tree.leaves(graph), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    first = jax.tree_util.tree_leaves_with_path(graph)[0][0]
    assert jax.tree_util.keystr(first).startswith(".maps[0].poses")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robot_b": 2}, r"closures.robot_b\[0\]: robot 2 of 2 does not exist"),
        ({"pose_b": 12}, r"closures.pose_b\[0\]: pose 12 does not exist: robot 'b' has 12 poses"),
    ],
)
def test_closures_to_nowhere(make_graph, group, changes, message):
    maps = (make_graph(group), make_graph(group))
    with pytest.raises(InputError, match=message):
        MultiRobotGraph(maps, closures_of(group, **changes))


def test_groups_must_agree(make_graph):
    flat, solid = make_graph(jaxlie.SE2), make_graph(jaxlie.SE3)
    with pytest.raises(InputError, match="maps: groups SE2, SE3 given, expected one for all"):
        MultiRobotGraph((flat, solid))
    with pytest.raises(InputError, match="closures: SE3 given, expected SE2 like the maps"):
        MultiRobotGraph((flat, flat), closures_of(jaxlie.SE3))
    with pytest.raises(InputError, match="maps: none given"):
        MultiRobotGraph(())


def test_split_accounts_for_every_edge(make_graph, group):
    whole = make_graph(
        group, n=30, loops=60, ids=np.arange(30) + 100, source=[f"f:{k}" for k in range(89)]
    )
    graph = split(whole, [10, 17])
    assert graph.names == ("a", "b", "c")
    assert [one.num_poses for one in graph.maps] == [10, 7, 13]
    tail, head = np.asarray(whole.tail), np.asarray(whole.head)
    robot = np.searchsorted([10, 17], np.arange(30), side="right")
    across = [
        k for k in range(89) if robot[tail[k]] != robot[head[k]] and abs(tail[k] - head[k]) > 1
    ]
    assert graph.closures.source.tolist() == [f"f:{k}" for k in across]
    kept = [name for one in graph.maps for name in one.source]
    dropped = {f"f:{k}" for k in range(89)} - set(kept) - set(graph.closures.source)
    assert dropped == {"f:9", "f:16"}


def test_split_keeps_ids_poses_and_measurements(make_graph, group):
    whole = make_graph(group, n=30, loops=60, ids=np.arange(30) + 100)
    graph = split(whole, 12)
    np.testing.assert_array_equal(np.concatenate([one.ids for one in graph.maps]), whole.ids)
    poses = [lie.as_numpy(one.poses) for one in graph.maps]
    np.testing.assert_array_equal(
        lie.parameters(lie.concatenate(poses)), lie.parameters(lie.as_numpy(whole.poses))
    )
    closures = graph.closures
    for robot, measured in ((0, graph.maps[0]), (1, graph.maps[1])):
        tail, head = (lie.take(poses[robot], np.asarray(e)) for e in (measured.tail, measured.head))
        error = lie.between(lie.as_numpy(measured.measurement), lie.between(tail, head))
        np.testing.assert_allclose(lie.log(error), 0.0, atol=1e-9)
    joined, start = lie.concatenate(poses), np.array([0, 12])
    a = lie.take(joined, start[closures.robot_a] + np.asarray(closures.pose_a))
    b = lie.take(joined, start[closures.robot_b] + np.asarray(closures.pose_b))
    error = lie.between(lie.as_numpy(closures.measurement), lie.between(a, b))
    np.testing.assert_allclose(lie.log(error), 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("at", "message"),
    [
        ([], "at: no pose given"),
        (0, "at: pose 0 given, expected 1 … 11"),
        ([3, 12], r"at: pose 12 given, expected 1 … 11 \(there are 12 poses\)"),
        ([5, 5], r"at: \[5, 5\] given, expected ascending"),
        ([1.5], r"at: \[1.5\] given, expected a pose index or a list"),
    ],
)
def test_bad_cuts(make_graph, group, at, message):
    with pytest.raises(InputError, match=message):
        split(make_graph(group), at)


def test_a_piece_that_falls_apart(make_graph, group):
    """Backward from pose 4: 0-1-2-3 hang on pose 4 only by an edge that the cut removes."""
    graph = make_graph(group, n=4, loops=0)
    star = type(graph).from_arrays(
        poses=graph.poses,
        tail=[3, 3, 3],
        head=[0, 1, 2],
        measurement=graph.measurement,
        information=graph.information,
    )
    with pytest.raises(InputError, match=r"at: piece 1 \(poses 0 to 2\) cannot be a map: .* 3 par"):
        split(star, [3])


def test_traced_closures_are_not_checked(make_graph):
    """They have no values yet; the constructor works inside jit."""
    maps = (make_graph(jaxlie.SE2), make_graph(jaxlie.SE2))
    seen = jax.jit(lambda closures: MultiRobotGraph(maps, closures).closures.pose_b)
    assert seen(closures_of(jaxlie.SE2, pose_b=3)) == 3
