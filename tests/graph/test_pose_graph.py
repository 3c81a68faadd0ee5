import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import InputError, InputWarning
from pcm_jax.graph import PoseGraph

TWO = np.stack([np.eye(3), [[0.0, -1.0, 2.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])


def two_poses(**changes):
    """The smallest graph, as keyword arguments."""
    fields = {
        "poses": TWO,
        "tail": [0],
        "head": [1],
        "measurement": TWO[1:],
        "information": np.eye(3)[None],
    }
    return fields | changes


def test_leaves_are_float64_also_without_x64(make_graph, group):
    with jax.enable_x64(False):
        graph = make_graph(group)
        assert lie.parameters(graph.poses).dtype == np.float64
        assert lie.parameters(graph.measurement).dtype == np.float64
        assert graph.information.dtype == np.float64
        assert graph.tail.dtype == graph.head.dtype == np.int32


def test_sizes(make_graph, group):
    graph = make_graph(group, n=12, loops=8)
    d = lie.tangent_dim(group)
    assert (graph.num_poses, graph.num_edges, graph.tangent_dim) == (12, 19, d)
    assert graph.group is group
    assert graph.information.shape == (19, d, d)


def test_matrices_and_lie_objects_mean_the_same(make_graph, group):
    graph = make_graph(group)
    again = PoseGraph.from_arrays(
        poses=lie.as_matrix(lie.as_numpy(graph.poses)),
        tail=graph.tail,
        head=graph.head,
        measurement=lie.as_matrix(lie.as_numpy(graph.measurement)),
        information=graph.information,
    )
    for a, b in ((graph.poses, again.poses), (graph.measurement, again.measurement)):
        error = lie.log(lie.between(lie.as_numpy(a), lie.as_numpy(b)))
        np.testing.assert_allclose(error, 0.0, atol=1e-12)


def test_covariance_is_the_inverse_information(make_graph, group):
    graph = make_graph(group)
    fields = {name: getattr(graph, name) for name in ("poses", "tail", "head", "measurement")}
    again = PoseGraph.from_arrays(**fields, covariance=np.linalg.inv(graph.information))
    np.testing.assert_allclose(again.information, graph.information, rtol=1e-9, atol=1e-9)


def test_rotation_first_information_weights_the_same_errors(make_graph, group, rng):
    """rᵀ Ω r is the same number in either order of rows and columns."""
    graph = make_graph(group)
    d, space = graph.tangent_dim, 2 if group is jaxlie.SE2 else 3
    error = rng.normal(size=(graph.num_edges, d))
    swapped = np.concatenate([error[:, space:], error[:, :space]], axis=1)
    given = np.asarray(graph.information)
    fields = {name: getattr(graph, name) for name in ("poses", "tail", "head", "measurement")}
    again = PoseGraph.from_arrays(**fields, information=given, tangent_order="rotation-translation")
    np.testing.assert_allclose(
        np.einsum("ki,kij,kj->k", error, again.information, error),
        np.einsum("ki,kij,kj->k", swapped, given, swapped),
        rtol=1e-12,
    )
    with pytest.raises(InputError, match="tangent_order: 'sideways' given"):
        PoseGraph.from_arrays(**fields, information=given, tangent_order="sideways")


def test_pytree_keeps_the_traced_part_and_forgets_the_rest(make_graph, group):
    graph = make_graph(group, ids=np.arange(12) + 100, name="rover")
    leaves, treedef = jax.tree.flatten(graph)
    again = jax.tree.unflatten(treedef, leaves)
    assert all(a is b for a, b in zip(leaves, jax.tree.leaves(again), strict=True))
    np.testing.assert_array_equal(again.ids, np.arange(12))
    assert again.name == ""
    assert again.source.tolist() == [""] * 19
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(graph)]
    assert [path.split(".")[1].split("[")[0] for path in paths] == [
        "poses",
        "tail",
        "head",
        "measurement",
        "information",
    ]


def test_unflatten_accepts_anything(make_graph, group):
    _, treedef = jax.tree.flatten(make_graph(group))
    for leaf in (object(), None, 3, True):
        assert isinstance(jax.tree.unflatten(treedef, [leaf] * 5), PoseGraph)
    mapped = jax.tree.map(lambda _: object(), make_graph(group))
    assert len(mapped.ids) == 0


def test_ids_and_names_cost_no_recompilation(make_graph, group):
    graph = make_graph(group)
    traces = []

    @jax.jit
    def total(graph: PoseGraph) -> jax.Array:
        traces.append(graph.num_poses)
        return graph.information.sum() + graph.ids.sum()

    renamed = dataclasses.replace(graph, ids=graph.ids + 5, name="other")
    total(graph)
    total(renamed)
    assert traces == [12]


def test_vmap_gives_batches_of_graphs(make_graph, group):
    graph = make_graph(group)
    stacked = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf, leaf]), graph)
    assert (stacked.num_poses, stacked.num_edges) == (12, 19)
    sums = jax.vmap(lambda one: one.information.sum() * one.num_poses)(stacked)
    np.testing.assert_allclose(sums, np.full(3, 12 * graph.information.sum()))


def test_with_poses_keeps_ids_name_and_source(make_graph, group):
    source = [f"f:{line}" for line in range(19)]
    graph = make_graph(group, ids=np.arange(12) * 2, name="rover", source=source)
    moved = graph.with_poses(lie.inverse(lie.as_numpy(graph.poses)))
    assert moved.name == "rover"
    assert moved.source.tolist() == source
    np.testing.assert_array_equal(moved.ids, graph.ids)


def test_pose_names_use_the_index_of_symbol_keys():
    plain = PoseGraph.from_arrays(**two_poses(ids=[4, 9], name="a"))
    key = ord("b") << 56
    symbols = PoseGraph.from_arrays(**two_poses(ids=[key + 7, key + 12], name="b"))
    assert [plain.pose_name(1), symbols.pose_name(1)] == ["a9", "b12"]
    assert symbols.ids.tolist() == [key + 7, key + 12]


def test_from_trajectory_is_an_exact_chain(group, rng):
    poses = lie.exp(group, rng.normal(size=(9, lie.tangent_dim(group))))
    graph = PoseGraph.from_trajectory(poses, sigma_translation=0.1, sigma_rotation=0.02)
    assert graph.num_edges == 8
    tail, head = (lie.take(poses, np.asarray(end)) for end in (graph.tail, graph.head))
    predicted = lie.compose(tail, lie.as_numpy(graph.measurement))
    np.testing.assert_allclose(lie.log(lie.between(predicted, head)), 0.0, atol=1e-12)
    space = 2 if group is jaxlie.SE2 else 3
    expected = np.diag([100.0] * space + [2500.0] * (graph.tangent_dim - space))
    np.testing.assert_allclose(graph.information, np.broadcast_to(expected, (8, *expected.shape)))


def test_a_trajectory_of_one_pose_has_no_edges(group, rng):
    poses = lie.exp(group, rng.normal(size=(1, lie.tangent_dim(group))))
    graph = PoseGraph.from_trajectory(poses, sigma_translation=0.1, sigma_rotation=0.02)
    assert (graph.num_poses, graph.num_edges) == (1, 0)


@pytest.mark.parametrize("sigma", [0.0, -1.0, np.nan, np.inf])
def test_sigmas_must_be_positive(sigma):
    with pytest.raises(InputError, match=r"^sigma_rotation: .* expected a positive number$"):
        PoseGraph.from_trajectory(TWO, sigma_translation=1.0, sigma_rotation=sigma)


def test_poses_are_composed_where_none_are_given(make_graph, group):
    graph = make_graph(group)
    composed = PoseGraph.from_arrays(
        tail=graph.tail,
        head=graph.head,
        measurement=graph.measurement,
        information=graph.information,
    )
    first = lie.take(lie.as_numpy(graph.poses), slice(0, 1))
    moved = lie.compose(first, lie.as_numpy(composed.poses))
    error = lie.log(lie.between(lie.as_numpy(graph.poses), moved))
    np.testing.assert_allclose(error, 0.0, atol=1e-9)


BAD = np.array([[[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"poses": np.eye(3)}, r"poses: shape \(3, 3\) given, expected homogeneous"),
        ({"poses": np.zeros((2, 3, 4))}, r"poses: shape \(2, 3, 4\) given"),
        ({"poses": "here"}, "poses: str given, expected jaxlie.SE2"),
        ({"poses": TWO * np.nan}, r"poses\[0\]: nan given, expected a finite number"),
        ({"poses": np.zeros((0, 3, 3))}, "poses: none given"),
        ({"poses": jaxlie.SE3(np.eye(7)[[0, 0]])}, "measurement: SE2 given, expected SE3"),
        ({"poses": jaxlie.SE2(np.eye(4)[0])}, r"poses: batch shape \(\) given"),
        ({"measurement": BAD}, r"measurement\[0\]: the upper left 2x2 block is not a rotation"),
        ({"measurement": 2 * TWO[1:]}, r"measurement\[0\]: the upper left 2x2 block"),
        (
            {"measurement": TWO[1:] + np.eye(3)[[2]].T @ np.eye(3)[[0]]},
            r"measurement\[0\]: last row \[1.0, 0.0, 1.0\] given",
        ),
        ({"tail": [2]}, r"tail\[0\]: index 2 is not in 0 … 1 \(there are 2 poses\)"),
        ({"head": [-1]}, r"head\[0\]: index -1 is not in 0 … 1"),
        ({"head": [0.5]}, "head: float64 given, expected integers"),
        ({"head": [[1]]}, r"head: shape \(1, 1\) given"),
        ({"head": [1, 1]}, "head: 2 entries given, expected 1, one per measurement"),
        ({"head": [0]}, r"head\[0\]: edge from pose 0 to itself"),
        ({"information": np.eye(3)}, r"information: shape \(3, 3\) given, expected \(1, 3, 3\)"),
        ({"information": "strong"}, "information: str given, expected an array"),
        (
            {"information": np.triu(np.ones((1, 3, 3)))},
            r"information\[0\]: information is not symmetric: entries differ by 1",
        ),
        (
            {"information": np.diag([1.0, 1.0, -2.0])[None]},
            r"information\[0\]: information is not positive definite \(smallest eigenvalue -2\)",
        ),
        ({"information": np.full((1, 3, 3), np.inf)}, r"information\[0\]: inf given"),
        ({"information": np.full((1, 3, 3), 1e101)}, r"information\[0\]: 1e\+101 given"),
        ({"covariance": np.eye(3)[None]}, "give exactly one of the two"),
        ({"information": None}, "give exactly one of the two"),
        ({"ids": [1]}, r"ids: shape \(1,\) given, expected \(2,\)"),
        ({"ids": [1, 1]}, "ids: 1 occurs more than once"),
        ({"ids": [0.0, 1.0]}, "ids: float64 given, expected integers"),
        ({"source": ["x", "y"]}, "source: 2 entries given, expected 1"),
        ({"poses": np.concatenate([TWO, TWO[1:]])}, "the map falls into 2 parts: .* pose 2"),
    ],
)
def test_bad_arrays_are_named(changes, message):
    with pytest.raises(InputError, match=message) as caught:
        PoseGraph.from_arrays(**two_poses(**changes))
    assert "\n" not in str(caught.value)


def test_quaternions_are_scaled_and_warned_about():
    rows = np.array([[2.0, 0, 0, 0, 0, 0, 0], [1.0005, 0, 0, 0, 1, 0, 0]])
    fields = {"tail": [0], "head": [1], "information": np.eye(6)[None]}
    identity = jaxlie.SE3(np.eye(7)[[0]])
    with pytest.warns(InputWarning, match=r"poses\[0\]: quaternion of norm 2 scaled .*\(1 such"):
        graph = PoseGraph.from_arrays(poses=jaxlie.SE3(rows), measurement=identity, **fields)
    norms = np.linalg.norm(np.asarray(graph.poses.wxyz_xyz)[:, :4], axis=1)
    np.testing.assert_allclose(norms, 1.0, rtol=1e-15)
    with pytest.raises(InputError, match=r"poses\[1\]: quaternion of norm 0, expected norm 1"):
        bad = jaxlie.SE3(np.stack([rows[1], np.zeros(7)]))
        PoseGraph.from_arrays(poses=bad, measurement=identity, **fields)


def test_nearly_symmetric_information_becomes_symmetric():
    skewed = np.eye(3)[None] + 1e-8 * np.triu(np.ones((3, 3)), 1)
    graph = PoseGraph.from_arrays(**two_poses(information=skewed))
    np.testing.assert_array_equal(graph.information, np.swapaxes(graph.information, 1, 2))
