"""Public files beside the checkout: all are read, and those that should agree do."""

import time
import warnings
from collections import defaultdict

import gtsam
import numpy as np
import public_files
import pytest

from pcm_jax import lie
from pcm_jax.errors import FileFormatError, InputWarning
from pcm_jax.files import read_graph, read_tum, write_g2o


@pytest.fixture(scope="module")
def manifest(shared_data):
    """Rows of the manifest that are pose graphs which are there."""
    return [row for row in public_files.rows() if row["E"] and (shared_data / row["file"]).exists()]


def read_quietly(*paths, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        return read_graph(*paths, **options)


def poses_error(first, second):
    return np.abs(lie.log(lie.between(lie.as_numpy(first), lie.as_numpy(second)))).max()


@pytest.mark.slow
def test_every_single_robot_file_has_the_manifests_counts(shared_data, manifest):
    rows = [row for row in manifest if "multirobot" not in row["file"]]
    assert len(rows) > 20
    for row in rows:
        (graph,) = read_quietly(shared_data / row["file"], repair="clip").maps
        assert graph.num_edges == int(row["E"]), row["file"]
        assert graph.tangent_dim == (3 if row["dim"] == "2" else 6), row["file"]
        if int(row["V"]):
            assert graph.num_poses == int(row["V"]), row["file"]
        if float(row["min_eig_info"]) > 0:
            smallest = np.linalg.eigvalsh(np.asarray(graph.information)).min()
            if "isam" not in row["file"] and "toro" not in row["file"]:
                assert smallest == pytest.approx(float(row["min_eig_info"]), rel=1e-6)


def test_every_multi_robot_set_has_the_manifests_counts(shared_data, manifest):
    sets = defaultdict(list)
    for row in manifest:
        if "multirobot" in row["file"]:
            sets[row["file"].rsplit("/", 1)[0]].append(row)
    assert len(sets) == 6
    for folder, rows in sets.items():
        graph = read_graph(*(shared_data / row["file"] for row in rows))
        assert graph.names == tuple("abcd"[: len(rows)]), folder
        for row, one in zip(rows, graph.maps, strict=True):
            assert one.num_poses == int(row["V"]), folder
            assert one.num_edges == int(row["odom(i,i+1)"]) + int(row["intra_loops"]), folder
        # Every inter-robot edge stands in the files of both its robots.
        assert 2 * len(graph.closures) == sum(int(row["inter"]) for row in rows), folder


def test_one_pair_measured_twice(shared_data):
    folder = shared_data / "multirobot_rdm/distributed_mapper/example_2robots"
    graph = read_graph(folder / "0.g2o.xz", folder / "1.g2o.xz")
    pairs = list(zip(graph.closures.pose_a.tolist(), graph.closures.pose_b.tolist(), strict=True))
    assert pairs.count((14, 17)) == 2
    assert len(pairs) == 10
    assert graph.maps[1].ids[3] == 7061644215716937731


def test_one_robots_file_alone_is_not_enough(shared_data):
    folder = shared_data / "multirobot_rdm/distributed_mapper/example_2robots"
    with pytest.raises(FileFormatError, match=r"0.g2o.xz:\d+: edge to pose b\d+, but no file"):
        read_graph(folder / "0.g2o.xz")


def test_toro_and_g2o_are_the_same_graph(shared_data):
    toro = read_graph(shared_data / "classic2d/risam_csail.toro.xz").maps[0]
    g2o = read_graph(shared_data / "classic2d/CSAIL.g2o.xz").maps[0]
    np.testing.assert_array_equal(toro.tail, g2o.tail)
    np.testing.assert_array_equal(toro.head, g2o.head)
    assert poses_error(toro.measurement, g2o.measurement) < 1e-12
    scale = np.abs(g2o.information).max(axis=(1, 2), keepdims=True)
    assert np.abs((toro.information - g2o.information) / scale).max() < 1e-8


def test_isam_and_g2o_are_the_same_graph(shared_data):
    for name in ("classic3d/sphere2500", "city10000/city10000"):
        g2o = read_graph(shared_data / f"{name}.g2o.xz").maps[0]
        suffix = ".isam.txt.xz"
        isam = read_graph(shared_data / f"{name}{suffix}").maps[0]
        order, other = (
            np.lexsort((np.asarray(one.head), np.asarray(one.tail))) for one in (g2o, isam)
        )
        np.testing.assert_array_equal(g2o.tail[order], isam.tail[other])
        np.testing.assert_array_equal(g2o.head[order], isam.head[other])
        a, b = (
            lie.take(lie.as_numpy(one.measurement), rows)
            for one, rows in ((g2o, order), (isam, other))
        )
        assert poses_error(a, b) < 3e-5  # six digits in the files
    assert np.abs(isam.information - g2o.information).max() < 1e-9


def test_square_root_reading_of_city10000(shared_data):
    for name in ("city10000.g2o.xz", "city10000.isam.txt.xz"):
        path = shared_data / "city10000" / name
        literal = read_graph(path).maps[0].information
        squared = read_graph(path, information="sqrt").maps[0].information
        expected = np.broadcast_to(np.diag([2500.0, 2500.0, 1e4]), (20687, 3, 3))
        np.testing.assert_allclose(squared, expected, atol=1e-8)
        np.testing.assert_allclose(literal, np.sqrt(expected), atol=1e-9)


def test_poses_of_a_file_of_edges_are_those_of_the_file_with_vertices(shared_data):
    """City10000's vertices are its odometry, chained."""
    given = read_graph(shared_data / "city10000/city10000.g2o.xz").maps[0]
    composed = read_graph(shared_data / "city10000/city10000.isam.txt.xz").maps[0]
    assert composed.num_poses == given.num_poses
    near = slice(0, 200)  # six digits in the file, added up
    error = poses_error(*(lie.take(lie.as_numpy(one.poses), near) for one in (given, composed)))
    assert error < 1e-3


def test_indefinite_information_of_cubicle(shared_data):
    path = shared_data / "classic3d/cubicle.g2o.xz"
    with pytest.raises(FileFormatError, match=r"g2o.xz:\d+: information is not positive definite"):
        read_graph(path)
    with pytest.warns(InputWarning, match=": 5021 information matrices clipped"):
        graph = read_graph(path, repair="clip")
    smallest = np.linalg.eigvalsh(np.asarray(graph.maps[0].information))[:, 0]
    assert smallest.min() > 0


def test_gtsam_reads_the_same(shared_data, tmp_path):
    """Through a file of ours, since GTSAM reads no compressed ones."""
    graph = read_graph(shared_data / "classic3d/sphere2500.g2o.xz")
    write_g2o(tmp_path / "sphere.g2o", graph)
    factors, values = gtsam.readG2o(str(tmp_path / "sphere.g2o"), True)
    poses = np.stack([values.atPose3(k).matrix() for k in range(2500)])
    found = lie.as_matrix(lie.as_numpy(graph.maps[0].poses))
    np.testing.assert_allclose(found, poses, atol=1e-12)
    assert factors.size() == 4949


def test_round_trips_of_real_files(shared_data, tmp_path, assert_same):
    for name in ("classic2d/intel", "umich/duderstadt", "classic3d/parking-garage"):
        graph = read_graph(shared_data / f"{name}.g2o.xz")
        for ids in ("original", "sequential"):
            write_g2o(tmp_path / "again.g2o", graph, ids=ids)
            assert_same(graph, read_graph(tmp_path / "again.g2o"))


def test_trajectories(shared_data):
    seconds, poses = read_tum(shared_data / "nclt/2012-08-04_odom_trajectory.txt.xz")
    assert len(seconds) == len(lie.parameters(poses)) == 12008
    assert (np.diff(seconds) > 0).all()


def test_city10000_is_read_quickly(shared_data):
    """A tenth of a second on an idle core; bounded generously, since cores are shared."""
    path = shared_data / "city10000/city10000.g2o.xz"
    times = []
    for _ in range(5):
        start = time.perf_counter()
        read_graph(path)
        times.append(time.perf_counter() - start)
    assert min(times) < 0.5
