"""Bags of pose graphs, written in the test."""

from types import SimpleNamespace

import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import FileFormatError
from pcm_jax.files import read_graph
from pcm_jax.files.formats.ros_bag import check_fields, definitions

rosbags = pytest.importorskip("rosbags")


@pytest.fixture(params=["sqlite3", "mcap", "ros1"])
def kind(request):
    """How bags are stored: ROS 2's two ways, and ROS 1's."""
    return request.param


@pytest.fixture
def save(kind, tmp_path):
    """Writes messages of one topic to a bag; gives its folder, or its file."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    package = "pose_graph_tools_msgs"
    for name, text in definitions(package).items():
        store.register(get_types_from_msg(text, name))
    types = store.types

    def pose(x):
        point = types["geometry_msgs/msg/Point"](float(x), 0.0, 0.0)
        turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        return types["geometry_msgs/msg/Pose"](point, turn)

    def header(seconds=0):
        time = types["builtin_interfaces/msg/Time"](seconds, 500_000_000)
        number = [0] if kind == "ros1" else []
        return types["std_msgs/msg/Header"](*number, time, "world")

    def node(robot, key, x):
        return types[f"{package}/msg/PoseGraphNode"](header(key), robot, key, pose(x))

    def edge(ends, x, kind=0, sigmas=(0.1, 0.1, 0.1, 1, 1, 1)):
        (a, i), (b, k) = ends
        covariance = np.diag(np.square(sigmas)).ravel().astype(np.float64)
        kinds = types[f"{package}/msg/PoseGraphEdge"]
        return kinds(header(), i, k, a, b, kind, pose(x), covariance)

    def make(messages):
        path, writer, serialize = opened(kind, tmp_path, store)
        with writer as bag:
            graph = f"{package}/msg/PoseGraph"
            connection = bag.add_connection("/graph", graph, typestore=store)
            for k, (nodes, edges) in enumerate(messages):
                message = types[graph](
                    header(), [node(*one) for one in nodes], [edge(*one) for one in edges]
                )
                bag.write(connection, k, serialize(message, graph))
        return path

    return make


def opened(kind, folder, store):
    """A bag's path, its writer, and how messages become bytes."""
    if kind == "ros1":
        from rosbags.rosbag1 import Writer

        return folder / "a.bag", Writer(folder / "a.bag"), store.serialize_ros1
    from rosbags.rosbag2 import StoragePlugin, Writer

    plugin = StoragePlugin[kind.upper()]
    writer = Writer(folder / "bag", version=9, storage_plugin=plugin)
    return folder / "bag", writer, store.serialize_cdr


NODES = [(robot, key, float(key)) for robot in (0, 2) for key in range(3)]
STEPS = [(((robot, key), (robot, key + 1)), 1.0) for robot in (0, 2) for key in range(2)]


def test_graphs_of_several_messages(save):
    closure = (((0, 1), (2, 2)), 7.0, 1)
    rejected = (((0, 0), (2, 2)), 9.0, 3)
    path = save([(NODES[:3], STEPS[:2]), (NODES, [*STEPS, closure, rejected]), (NODES, [closure])])
    with pytest.warns(UserWarning, match=r"skipped 1 lines \(1 rejected closure\)"):
        graph = read_graph(path)
    assert graph.names == ("robot0", "robot2")
    assert [one.num_edges for one in graph.maps] == [2, 2]
    np.testing.assert_allclose(graph.maps[0].information[0], np.diag([1, 1, 1, 100, 100, 100]))
    np.testing.assert_allclose(graph.maps[1].stamps, [0.5, 1.5, 2.5])
    np.testing.assert_allclose(lie.translation(graph.closures.measurement)[:, 0], [7])
    assert (graph.closures.pose_a.tolist(), graph.closures.pose_b.tolist()) == ([1], [2])


def test_edges_without_a_covariance(save):
    path = save([(NODES, [(*one, 0, (0,) * 6) for one in STEPS])])
    with pytest.raises(FileFormatError, match=r"an edge without a covariance; .*--default-sigmas"):
        read_graph(path)
    graph = read_graph(path, default_sigmas=(0.1, 0.01))
    np.testing.assert_allclose(graph.maps[0].information[0], np.diag([100] * 3 + [1e4] * 3))


@pytest.mark.parametrize(
    ("robot", "key", "message"),
    [
        (0, 1 << 40, "key 1099511627776 given, expected a symbol, or 0 … 1099511627775"),
        (1 << 23, 0, "robot 8388608 given, expected 0 … 4194303"),
        (-1, 0, "robot -1 given, expected 0 … 4194303"),
    ],
)
def test_numbers_that_would_be_another_robots(save, robot, key, message):
    """Or of none: robots' poses are told apart by one number."""
    with pytest.raises(FileFormatError, match=message):
        read_graph(save([(NODES, [*STEPS, (((0, 1), (robot, key)), 7.0, 1)])]))


def test_a_bag_without_graphs(save):
    with pytest.raises(FileFormatError, match="no messages of pose_graph_tools_msgs/PoseGraph"):
        read_graph(save([]))


def test_messages_of_another_package():
    """Of the same name, but without the robots' numbers."""
    node = SimpleNamespace(robot_id=0, key=1, pose=None)
    edge = SimpleNamespace(key_from=0, key_to=1, type=0, pose=None, covariance=None)
    check_fields("a.bag", "p/msg/PoseGraph", SimpleNamespace(nodes=[node], edges=[]))
    for message, lost in (
        (SimpleNamespace(nodes=[node], edges=[edge]), "robot_from"),
        (SimpleNamespace(nodes=[]), "edges"),
    ):
        with pytest.raises(FileFormatError, match=f"a.bag: p/msg/PoseGraph without {lost}, exp"):
            check_fields("a.bag", "p/msg/PoseGraph", message)


def test_an_mcap_file_by_itself(save, kind):
    """Recorders write one beside the folder's metadata, and people pass it on alone."""
    if kind != "mcap":
        pytest.skip("of mcap alone")
    (file,) = save([(NODES, STEPS)]).glob("*.mcap")
    assert read_graph(file).names == ("robot0", "robot2")


def test_a_damaged_bag(save):
    path = save([(NODES, STEPS)])
    if path.is_dir():
        (path / "metadata.yaml").write_text("nothing: [")
    else:
        path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(FileFormatError, match="cannot be read as a bag: ") as caught:
        read_graph(path)
    assert "\n" not in str(caught.value)
