import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files import read_trajectory, read_tum, write_trajectory


def test_columns(write):
    path = write("# timestamp x y z qx qy qz qw", "1.5 1 2 3 0.6 0 0 0.8", "", "2 4 5 6 0 0 0 -1")
    seconds, poses = read_tum(path)
    assert seconds.tolist() == [1.5, 2.0]
    rows = np.asarray(lie.parameters(poses))
    np.testing.assert_allclose(
        rows, [[0.8, 0.6, 0, 0, 1, 2, 3], [-1, 0, 0, 0, 4, 5, 6]], atol=1e-15
    )


def test_a_trajectory_is_an_odometry_chain(write):
    path = write("0 0 0 0 0 0 0 1", "1 1 0 0 0 0 1 0", "2 1 2 0 0 0 1 0")
    graph = read_trajectory(path, sigma_translation=0.1, sigma_rotation=0.01)
    assert (graph.num_poses, graph.num_edges) == (3, 2)
    assert graph.ids.tolist() == [0, 1, 2]
    steps = np.asarray(lie.parameters(lie.as_numpy(graph.measurement)))[:, 4:]
    np.testing.assert_allclose(steps, [[1, 0, 0], [0, -2, 0]], atol=1e-12)
    np.testing.assert_allclose(graph.information[0], np.diag([100.0] * 3 + [1e4] * 3))


@pytest.mark.parametrize("name", ["t.txt", "t.txt.gz", "t.txt.xz"])
def test_round_trip(tmp_path, rng, name):
    poses = lie.exp(jaxlie.SE3, rng.normal(size=(20, 6)))
    seconds = 1.3e9 + np.cumsum(rng.uniform(size=20))
    write_trajectory(tmp_path / name, poses, timestamps=seconds)
    again, found = read_tum(tmp_path / name)
    np.testing.assert_array_equal(again, seconds)
    np.testing.assert_allclose(lie.parameters(found), lie.parameters(poses), atol=1e-15)


def test_graphs_and_the_plane(tmp_path, rng):
    poses = lie.exp(jaxlie.SE2, 2.0 * rng.normal(size=(9, 3)))
    write_trajectory(tmp_path / "flat.txt", poses)
    seconds, found = read_tum(tmp_path / "flat.txt")
    assert seconds.tolist() == list(range(9))
    flat, solid = lie.as_matrix(poses), lie.as_matrix(found)
    np.testing.assert_allclose(solid[:, :2, :2], flat[:, :2, :2], atol=1e-12)
    np.testing.assert_allclose(solid[:, :2, 3], flat[:, :2, 2], atol=1e-12)
    graph = read_trajectory(tmp_path / "flat.txt", sigma_translation=1.0, sigma_rotation=1.0)
    write_trajectory(tmp_path / "again.txt", graph)
    again = read_tum(tmp_path / "again.txt")[1]
    np.testing.assert_allclose(lie.parameters(again), lie.parameters(found), atol=1e-15)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["# nothing"], "no poses, expected lines of timestamp x y z qx qy qz qw"),
        (["0 0 0 0 0 0 0 1", "1 0 0 0"], ":2: 4 columns, expected 8: timestamp x y z qx"),
        (["0 0 0 0 0 0 0 0"], ":1: quaternion of norm 0"),
        (["VERTEX_SE2 0 0 0 0 0 0 0"], ":1: 'VERTEX_SE2' given, expected a number"),
        (["0 0 0 nan 0 0 0 1"], ":1: nan given, expected a finite number"),
    ],
)
def test_bad_trajectories(write, lines, message):
    with pytest.raises(FileFormatError, match=message):
        read_tum(write(*lines))


def test_timestamps_must_fit(tmp_path, rng):
    poses = lie.exp(jaxlie.SE3, rng.normal(size=(3, 6)))
    with pytest.raises(InputError, match=r"timestamps: shape \(2,\) given, expected \(3,\)"):
        write_trajectory(tmp_path / "t.txt", poses, timestamps=[0, 1])
