"""What each format's lines mean, by independent readings of them."""

import gzip
import lzma

import gtsam
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcm_jax import lie
from pcm_jax.errors import InputError, InputWarning
from pcm_jax.files import read_graph

SQUARE = (
    "VERTEX_SE2 0 0 0 0",
    "VERTEX_SE2 1 1 0 1.5",
    "VERTEX_SE2 2 1 1 -8.0",
    "EDGE_SE2 0 1 1 0.1 1.5 4 0.5 0.25 5 0.125 6",
    "EDGE_SE2 1 2 1 0.2 1.6 4 0.5 0.25 5 0.125 6",
)
TRIANGLE_2D = "4 0.5 0.25 5 0.125 6"
FULL_2D = np.array([[4, 0.5, 0.25], [0.5, 5, 0.125], [0.25, 0.125, 6]])


def random_triangle(rng, d):
    root = rng.normal(size=(d, d))
    matrix = root @ root.T + np.eye(d)
    return matrix, matrix[np.triu_indices(d)]


def line(tag, *numbers):
    return f"{tag} " + " ".join(repr(float(x)) if isinstance(x, float) else str(x) for x in numbers)


@pytest.mark.parametrize("group", [jaxlie.SE2, jaxlie.SE3])
def test_gtsam_reads_the_same_from_g2o(group, rng, write):
    solid = group is jaxlie.SE3
    d, tag = (6, "SE3:QUAT") if solid else (3, "SE2")
    lines, triangles = [], []
    for k in range(6):
        quaternion = Rotation.random(rng=rng).as_quat().tolist()
        pose = [
            *rng.normal(size=d // 2 if solid else 2).tolist(),
            *(quaternion if solid else [2.5 * k]),
        ]
        lines.append(line(f"VERTEX_{tag}", k, *pose))
    for k in range(5):
        quaternion = Rotation.random(rng=rng).as_quat().tolist()
        pose = [*rng.normal(size=3 if solid else 2).tolist(), *(quaternion if solid else [0.5 * k])]
        matrix, triangle = random_triangle(rng, d)
        triangles.append(matrix)
        lines.append(line(f"EDGE_{tag}", k + 1, k, *pose, *triangle.tolist()))
    path = write(*lines)
    graph = read_graph(path).maps[0]
    factors, values = gtsam.readG2o(str(path), solid)
    at = values.atPose3 if solid else values.atPose2
    expected = np.stack([at(k).matrix() for k in range(6)])
    np.testing.assert_allclose(lie.as_matrix(lie.as_numpy(graph.poses)), expected, atol=1e-12)
    edges = [factors.at(k) for k in range(5)]
    measured = np.stack([edge.measured().matrix() for edge in edges])
    np.testing.assert_allclose(lie.as_matrix(lie.as_numpy(graph.measurement)), measured, atol=1e-12)
    information = np.stack([edge.noiseModel().information() for edge in edges])
    order = [3, 4, 5, 0, 1, 2] if solid else [0, 1, 2]
    np.testing.assert_allclose(
        graph.information, information[:, order][:, :, order], rtol=1e-9, atol=1e-9
    )
    np.testing.assert_allclose(graph.information, triangles, rtol=1e-14)
    assert (graph.tail.tolist(), graph.head.tolist()) == ([1, 2, 3, 4, 5], [0, 1, 2, 3, 4])


def test_angles_of_any_size(write):
    graph = read_graph(write(*SQUARE)).maps[0]
    np.testing.assert_allclose(
        np.asarray(graph.poses.unit_complex_xy)[2], [np.cos(8.0), -np.sin(8.0), 1, 1]
    )


@pytest.mark.parametrize("suffix", ["", ".gz", ".xz", ".txt"])
@pytest.mark.parametrize("compress", [bytes, gzip.compress, lzma.compress])
def test_compression_is_told_by_content(tmp_path, suffix, compress):
    path = tmp_path / f"graph.g2o{suffix}"
    path.write_bytes(compress("\n".join(SQUARE).encode()))
    assert read_graph(path).maps[0].num_edges == 2


def test_sources_comments_blank_lines_and_line_ends(tmp_path):
    path = tmp_path / "graph.g2o"
    text = "\ufeff# a comment\r\n\r\n" + "\r\n".join(SQUARE) + "\r\n  \r\nFIX 0\r\n"
    path.write_bytes(text.encode())
    graph = read_graph(str(path)).maps[0]
    assert graph.num_poses == 3
    assert graph.source.tolist() == [f"{path}:6", f"{path}:7"]


def test_poses_are_in_the_order_of_their_ids(write):
    graph = read_graph(
        write(
            "VERTEX_SE2 30 3 0 0",
            "EDGE_SE2 -10 30 4 0 0 1 0 0 1 0 1",
            "VERTEX_SE2 -10 -1 0 0",
            "VERTEX_SE2 20 2 0 0",
            "EDGE_SE2 30 20 -1 0 0 1 0 0 1 0 1",
            "VERTEX_SE2 30 3 0 0",
        )
    ).maps[0]
    assert graph.ids.tolist() == [-10, 20, 30]
    np.testing.assert_array_equal(np.asarray(graph.poses.unit_complex_xy)[:, 2], [-1, 2, 3])
    assert (graph.tail.tolist(), graph.head.tolist()) == ([0, 2], [2, 1])


def test_skipped_lines_are_counted_in_one_warning(write):
    path = write(
        "PARAMS_SE2OFFSET 0 0 0 0",
        *SQUARE,
        "VERTEX_XY 9 1 1",
        "EDGE_SE2_XY 0 9 1 1 1 0 1",
        "EDGE_SE2_XY 1 9 1 1 1 0 1",
        "EDGE_PRIOR_SE2 0 0 0 0 1 0 0 1 0 1",
        "FIX 0",
    )
    with pytest.warns(InputWarning) as caught:
        graph = read_graph(path)
    assert len(graph.maps[0].priors) == 1
    assert len(caught) == 1
    assert str(caught[0].message) == (
        f"{path}: skipped 4 lines (1 PARAMS_SE2OFFSET, 1 VERTEX_XY, 2 EDGE_SE2_XY)"
    )


@pytest.mark.parametrize("tag", ["EDGE_SE2", "EDGE2", "ODOMETRY"])
def test_square_root_information_is_squared(tag, write):
    """Rᵀ R of the upper triangle; iSAM's numbers as they are written are the information."""
    edge = f"{tag} 0 1 1 0 0 {TRIANGLE_2D}"
    upper = np.triu(FULL_2D)
    squared = read_graph(write(edge), information="sqrt").maps[0].information[0]
    np.testing.assert_allclose(squared, upper.T @ upper, rtol=1e-15)
    written = read_graph(write(edge)).maps[0].information[0]
    np.testing.assert_array_equal(written, FULL_2D)


def test_toro_order(write):
    toro = "EDGE2 0 1 1 0 0 4 0.5 5 6 0.25 0.125"
    vertices = ("VERTEX2 0 0 0 0", "VERTEX2 1 1 0 0")
    for path, options in ((write(*vertices, toro), {}), (write(toro), {"format": "toro"})):
        np.testing.assert_array_equal(read_graph(path, **options).maps[0].information[0], FULL_2D)


def test_the_order_that_is_definite_wins(write):
    """With zeros off the diagonal only one reading is definite, whatever else the file has."""
    expected = np.diag([4.0, 5.0, 6.0])
    vertices = ("VERTEX2 0 0 0 0", "VERTEX2 1 1 0 0")
    for lines in (("EDGE2 0 1 1 0 0 4 0 5 6 0 0",), (*vertices, "EDGE2 0 1 1 0 0 4 0 0 5 0 6")):
        information = read_graph(write(*lines)).maps[0].information[0]
        np.testing.assert_array_equal(information, expected)


@pytest.mark.parametrize("tag", ["EDGE2", "EDGE3"])
def test_start_frame_information_weights_the_same_errors(tag, write, rng):
    """iSAM weights differences of coordinates as the edge's start sees them.

    Perturbing the end pose by a small δ must cost the same by that definition (translations and
    the 2D angle) as by δᵀ Ω δ.
    """
    solid = tag == "EDGE3"
    d, space = (6, 3) if solid else (3, 2)
    matrix, triangle = random_triangle(rng, d)
    pose = rng.normal(size=d)
    path = write(line(tag, 0, 1, *pose.tolist(), *triangle.tolist()))
    graph = read_graph(path, format="isam").maps[0]
    z = lie.as_numpy(graph.measurement)
    delta = 1e-6 * rng.normal(size=(1, d))
    moved = lie.compose(z, lie.exp(graph.group, delta))
    error = (lie.as_matrix(moved) - lie.as_matrix(z))[0, :space, space]
    error = np.concatenate([error, delta[0, space:]])
    expected = error @ matrix @ error
    found = delta[0] @ np.asarray(graph.information[0]) @ delta[0]
    assert found == pytest.approx(expected, rel=1e-5, abs=0)


def test_lines_of_several_tags_keep_their_order(write):
    unit = "1 0 0 1 0 1"
    path = write(
        f"ODOMETRY 0 1 1 0 0 {unit}", f"EDGE2 0 2 2 0 0 {unit}", f"ODOMETRY 1 2 1 0 0 {unit}"
    )
    graph = read_graph(path).maps[0]
    assert graph.head.tolist() == [1, 2, 2]
    assert graph.source.tolist() == [f"{path}:{number}" for number in (1, 2, 3)]


def test_euler_angles_are_roll_pitch_yaw(write, rng):
    pose = rng.normal(size=6)
    triangle = np.eye(6)[np.triu_indices(6)]
    path = write(
        line("VERTEX3", 0, *[0.0] * 6),
        line("VERTEX3", 1, *pose.tolist()),
        line("EDGE3", 0, 1, *pose.tolist(), *triangle.tolist()),
    )
    graph = read_graph(path).maps[0]
    roll, pitch, yaw = pose[3:]
    expected = np.eye(4)
    expected[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    expected[:3, 3] = pose[:3]
    for some in (
        lie.take(lie.as_numpy(graph.poses), 1),
        lie.take(lie.as_numpy(graph.measurement), 0),
    ):
        np.testing.assert_allclose(lie.as_matrix(some), expected, atol=1e-12)


def test_quaternion_information_weights_the_same_errors(write, rng):
    """g2o's error is the quaternion's vector part; its cost must come out for small errors."""
    matrix, triangle = random_triangle(rng, 6)
    quaternion = Rotation.random(rng=rng).as_quat().tolist()
    path = write(line("EDGE_SE3:QUAT", 0, 1, 1, 2, 3, *quaternion, *triangle.tolist()))
    strict = read_graph(path, rotation_information="quaternion").maps[0]
    delta = 1e-7 * rng.normal(size=(1, 6))
    error = np.asarray(lie.parameters(lie.exp(jaxlie.SE3, delta)))[0, [4, 5, 6, 1, 2, 3]]
    found = delta[0] @ np.asarray(strict.information[0]) @ delta[0]
    assert found == pytest.approx(error @ matrix @ error, rel=1e-6, abs=0)
    plain = read_graph(path).maps[0].information[0]
    np.testing.assert_allclose(plain, matrix, rtol=1e-14)


def test_edges_alone_give_poses_by_the_odometry(write):
    path = write(
        "EDGE_SE2 0 5 100 0 0 1 0 0 1 0 1",
        "EDGE_SE2 7 5 -1 0 0 1 0 0 1 0 1",
        "EDGE_SE2 0 3 1 0 1.5707963267948966 1 0 0 1 0 1",
        "EDGE_SE2 3 5 1 0 0 1 0 0 1 0 1",
    )
    graph = read_graph(path).maps[0]
    assert graph.ids.tolist() == [0, 3, 5, 7]
    np.testing.assert_allclose(
        np.asarray(graph.poses.unit_complex_xy)[:, 2:], [[0, 0], [1, 0], [1, 1], [1, 2]], atol=1e-12
    )


def test_indefinite_information_is_clipped_on_request(write):
    path = write(
        "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1",
        "EDGE_SE2 1 2 1 0 0 2 0 0 -3 0 1",
        "EDGE_SE2 2 3 1 0 0 1 2 0 1 0 1",
    )
    with pytest.warns(InputWarning, match=": 2 information matrices clipped") as caught:
        graph = read_graph(path, repair="clip").maps[0]
    assert len(caught) == 1
    np.testing.assert_allclose(graph.information[1], np.diag([2.0, 2e-9, 1.0]), atol=1e-15)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"information": "root"}, "information: 'root' given, expected one of"),
        ({"rotation_information": "angle"}, "rotation_information: 'angle' given"),
        ({"repair": "all"}, "repair: 'all' given"),
        ({"format": "g3o"}, "format: 'g3o' given"),
        ({"format": "isam"}, "VERTEX_SE2 is no tag of the format 'isam' asked for"),
    ],
)
def test_bad_options(write, options, message):
    with pytest.raises(InputError, match=message):
        read_graph(write(*SQUARE), **options)


def test_no_paths():
    with pytest.raises(InputError, match="paths: none given"):
        read_graph()
