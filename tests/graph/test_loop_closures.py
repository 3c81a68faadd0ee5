import jax
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph

KEY_B = ord("b") << 56


@pytest.fixture
def closures(group, rng):
    """Ten closures between three robots of twelve poses, in both directions."""
    d = lie.tangent_dim(group)
    robot_a = np.array([0, 1, 2, 1, 0, 0, 2, 1, 1, 0])
    robot_b = np.array([1, 0, 0, 2, 1, 2, 1, 0, 0, 1])
    root = rng.normal(size=(10, d, d))
    return LoopClosures.from_arrays(
        robot_a=robot_a,
        pose_a=rng.integers(0, 12, 10),
        robot_b=robot_b,
        pose_b=rng.integers(0, 12, 10),
        measurement=lie.exp(group, rng.normal(size=(10, d))),
        information=root @ np.swapaxes(root, 1, 2) + np.eye(d),
        source=[f"f.g2o:{line}" for line in range(10)],
    )


def test_between_orients_and_finds(closures):
    found, indices = closures.between(0, 1)
    assert indices.tolist() == [0, 1, 4, 7, 8, 9]
    assert set(np.asarray(found.robot_a)) == {0}
    assert set(np.asarray(found.robot_b)) == {1}
    assert found.source.tolist() == [f"f.g2o:{k}" for k in indices]
    flipped = np.asarray(closures.robot_a)[indices] == 1
    expected = np.where(flipped, closures.pose_b[indices], closures.pose_a[indices])
    np.testing.assert_array_equal(found.pose_a, expected)


def test_the_other_orientation_is_the_inverse(closures):
    forward, same = closures.between(0, 2)
    backward, indices = closures.between(2, 0)
    np.testing.assert_array_equal(same, indices)
    np.testing.assert_array_equal(forward.pose_a, backward.pose_b)
    product = lie.compose(lie.as_numpy(forward.measurement), lie.as_numpy(backward.measurement))
    np.testing.assert_allclose(lie.log(product), 0.0, atol=1e-12)
    again, _ = LoopClosures.between(backward, 0, 2)
    np.testing.assert_allclose(again.information, forward.information, rtol=1e-9, atol=1e-9)


def test_turning_a_closure_round_keeps_every_squared_error(closures, group, rng):
    """Errors of any size: δ' = −Ad(z) δ is exact, not first order."""
    forward, _ = closures.between(0, 1)
    backward, _ = closures.between(1, 0)
    z, back = lie.as_numpy(forward.measurement), lie.as_numpy(backward.measurement)
    delta = rng.normal(size=(len(forward), lie.tangent_dim(group)))
    seen_back = lie.inverse(lie.compose(z, lie.exp(group, delta)))
    delta_back = lie.log(lie.between(back, seen_back))
    np.testing.assert_allclose(
        np.einsum("ki,kij,kj->k", delta, forward.information, delta),
        np.einsum("ki,kij,kj->k", delta_back, backward.information, delta_back),
        rtol=1e-8,
    )


def test_pairs(closures):
    assert closures.pairs() == [(0, 1), (0, 2), (1, 2)]
    assert LoopClosures.empty(closures.group).pairs() == []


def test_no_closures_between_a_pair(closures):
    found, indices = closures.between(0, 7)
    assert len(found) == len(indices) == 0
    assert found.information.shape == (0, closures.tangent_dim, closures.tangent_dim)


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ([3, 1], [3, 1]),
        (np.array([-1, 3]), [9, 3]),
        (np.arange(10) > 6, [7, 8, 9]),
        (slice(2, 8, 3), [2, 5]),
        (4, [4]),
        (np.int64(2), [2]),
        ([], []),
    ],
)
def test_indexing_takes_the_same_rows_of_everything(closures, rows, expected):
    picked = closures[rows]
    assert len(picked) == len(expected)
    assert picked.source.tolist() == [f"f.g2o:{k}" for k in expected]
    for whole, part in zip(jax.tree.leaves(closures), jax.tree.leaves(picked), strict=True):
        np.testing.assert_array_equal(np.asarray(whole)[np.array(expected, int)], part)
        assert part.dtype == whole.dtype


def test_masks_must_have_the_closures_length(closures):
    with pytest.raises(InputError, match=r"mask of shape \(9,\), expected \(10,\)"):
        closures[np.ones(9, bool)]


def test_pytree_forgets_the_source(closures):
    again = jax.tree.map(lambda leaf: leaf, closures)
    assert len(again) == 10
    assert again.source.tolist() == [""] * 10
    _, treedef = jax.tree.flatten(closures)
    assert isinstance(jax.tree.unflatten(treedef, [object()] * 7), LoopClosures)


def pair(make_graph, group):
    a = make_graph(group, name="ann", ids=np.arange(12) * 10)
    b = make_graph(group, name="bob", ids=KEY_B + np.arange(12)[::-1])
    return [a, b]


def measured(group, count=2):
    d = lie.tangent_dim(group)
    return {
        "measurement": lie.identity(group, (count,)),
        "information": np.broadcast_to(np.eye(d), (count, d, d)),
    }


@pytest.mark.parametrize("robots", [["ann", "bob"], [0, 1]])
def test_from_ids(make_graph, group, robots):
    maps = pair(make_graph, group)
    closures = LoopClosures.from_ids(
        maps,
        robot_a=[robots[0], robots[1]],
        id_a=[110, KEY_B + 3],
        robot_b=[robots[1], robots[0]],
        id_b=[4, 0],
        **measured(group),
    )
    assert closures.robot_a.tolist() == [0, 1]
    assert closures.pose_a.tolist() == [11, 8]
    assert closures.robot_b.tolist() == [1, 0]
    assert closures.pose_b.tolist() == [7, 0]
    assert MultiRobotGraph(tuple(maps), closures).closures is closures


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robot_a": ["ann", "eve"]}, r"robot_a\[1\]: there is no robot 'eve', .* ann, bob"),
        ({"robot_a": [0, 2]}, r"robot_a\[1\]: index 2 is not in 0 … 1 \(there are 2 robots\)"),
        ({"id_a": [110, 7]}, r"id_a\[1\]: robot 'ann' has no pose with id 7"),
        ({"id_b": [1, KEY_B - 1]}, r"id_b\[1\]: robot 'bob' has no pose with id \d+"),
        ({"id_b": [1.0, 2.0]}, r"id_b\[0\]: float64 \(2,\) given, expected integers"),
        ({"robot_b": [1, 0], "id_b": [4, 0]}, r"robot_b\[1\]: closure from robot 0 to itself"),
    ],
)
def test_bad_ids_are_named(make_graph, group, changes, message):
    fields = {"robot_a": [0, 0], "id_a": [110, 10], "robot_b": [1, 1], "id_b": [4, 5]}
    with pytest.raises(InputError, match=message):
        LoopClosures.from_ids(pair(make_graph, group), **(fields | changes), **measured(group))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pose_a": [0]}, "pose_a: 1 entries given, expected 2, one per measurement"),
        ({"pose_b": [0, -1]}, r"pose_b\[1\]: index -1 is not in 0 …"),
        ({"robot_b": [1, 0]}, r"robot_b\[1\]: closure from robot 0 to itself"),
        ({"source": ["x"]}, "source: 1 entries given, expected 2"),
    ],
)
def test_bad_arrays_of_closures_are_named(group, changes, message):
    fields = {"robot_a": [0, 0], "pose_a": [0, 1], "robot_b": [1, 1], "pose_b": [0, 1]}
    with pytest.raises(InputError, match=message):
        LoopClosures.from_arrays(**(measured(group) | fields | changes))


def test_closures_are_float64_also_without_x64(group):
    with jax.enable_x64(False):
        closures = LoopClosures.from_arrays(
            robot_a=[0, 0], pose_a=[0, 1], robot_b=[1, 1], pose_b=[0, 1], **measured(group)
        )
        flipped, _ = closures.between(1, 0)
    for some in (closures, flipped):
        assert some.information.dtype == some.measurement.parameters().dtype == np.float64


def test_from_ids_needs_no_sorted_ids():
    matrices = np.broadcast_to(np.eye(3), (3, 3, 3))
    graph = PoseGraph.from_arrays(
        poses=matrices,
        tail=[0, 1],
        head=[1, 2],
        measurement=matrices[:2],
        information=matrices[:2],
        ids=[30, 10, 20],
    )
    closures = LoopClosures.from_ids(
        [graph, graph],
        robot_a=[0, 0, 0],
        id_a=[10, 20, 30],
        robot_b=[1, 1, 1],
        id_b=[30, 30, 20],
        measurement=matrices,
        information=matrices,
    )
    assert closures.pose_a.tolist() == [1, 2, 0]
    assert closures.pose_b.tolist() == [0, 0, 2]


def test_weights_follow_their_closures(group):
    given = {"robot_a": [0, 1], "pose_a": [1, 2], "robot_b": [1, 0], "pose_b": [3, 4]}
    both = LoopClosures.from_arrays(**given, **measured(group), weight=[0.25, 2.0])
    assert both[[1]].weight.tolist() == [2.0]
    assert both.between(0, 1)[0].weight.tolist() == [0.25, 2.0]
    assert LoopClosures.from_arrays(**given, **measured(group)).weight.tolist() == [1.0, 1.0]


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf])
def test_a_weight_must_be_a_number_of_at_least_zero(group, bad):
    given = {"robot_a": [0, 1], "pose_a": [1, 2], "robot_b": [1, 0], "pose_b": [3, 4]}
    with pytest.raises(InputError, match=r"weight\[1\]: "):
        LoopClosures.from_arrays(**given, **measured(group), weight=[1.0, bad])


def test_concatenating_puts_closures_end_to_end(closures):
    again = LoopClosures.concatenate([closures[:4], closures[4:]])
    for one, other in zip(jax.tree.leaves(again), jax.tree.leaves(closures), strict=True):
        np.testing.assert_array_equal(one, other)
    assert again.source.tolist() == closures.source.tolist()
    with pytest.raises(InputError, match="parts: groups none given"):
        LoopClosures.concatenate([])


def test_arrays_stay_on_the_host(closures):
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(closures))
