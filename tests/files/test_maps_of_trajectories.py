"""TUM, KITTI, EuRoC and CSV trajectories as maps, with their times."""

import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcm_jax import lie
from pcm_jax.errors import FileFormatError
from pcm_jax.files import read_graph, read_tum, write_trajectory
from pcm_jax.files.pose_file import Reading
from pcm_jax.files.read import read_with_account

SIGMAS = (0.1, 0.01)


@pytest.fixture
def poses(rng):
    """Positions and quaternions (x, y, z, w) of four poses."""
    return rng.normal(size=(4, 3)), Rotation.random(4, rng=rng).as_quat()


def text(rows, mark=" "):
    return "\n".join(mark.join(map(repr, row)) for row in np.asarray(rows).tolist())


def tum(places, turns):
    return text(np.column_stack([np.arange(4) * 0.5, places, turns]))


def tum_with_commas(places, turns):
    return text(np.column_stack([np.arange(4) * 0.5, places, turns]), ",")


def kitti(places, turns):
    matrices = np.concatenate([Rotation.from_quat(turns).as_matrix(), places[:, :, None]], axis=2)
    return text(matrices.reshape(4, 12))


def euroc(places, turns):
    rows = np.column_stack([places, turns[:, [3, 0, 1, 2]], np.zeros((4, 9))]).tolist()
    stamps = [1403636579763555584 + k * 500_000_000 for k in range(4)]
    lines = [",".join([str(s), *map(repr, row)]) for s, row in zip(stamps, rows, strict=True)]
    return "\n".join(
        ["#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z []", *lines]
    )


def kimera(places, turns):
    rows = np.column_stack([turns, places]).tolist()
    lines = [f"3,{10 + k}," + ",".join(map(repr, row)) for k, row in enumerate(rows)]
    return "\n".join(["robot_index,pose_index,qx,qy,qz,qw,tx,ty,tz", *lines])


def keyframes(places, turns):
    rows = np.column_stack([turns, places]).tolist()
    lines = [f"{k * 500_000_000},{k},0," + ",".join(map(repr, r)) for k, r in enumerate(rows)]
    return "\n".join(["keyframe_stamp_ns,keyframe_id,submap_id,qx,qy,qz,qw,tx,ty,tz", *lines])


FORMS = [tum, tum_with_commas, kitti, euroc, kimera, keyframes]


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.__name__)
def test_every_form(tmp_path, poses, form):
    path = tmp_path / "run.txt"
    path.write_text(form(*poses) + "\n")
    (one,) = read_graph(path, default_sigmas=SIGMAS).maps
    matrices = np.tile(np.eye(4), (4, 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = Rotation.from_quat(poses[1]).as_matrix(), poses[0]
    np.testing.assert_allclose(lie.as_matrix(lie.as_numpy(one.poses)), matrices, atol=1e-12)
    np.testing.assert_allclose(one.information[0], np.diag([100.0] * 3 + [1e4] * 3))
    assert (one.name, one.ids[0]) == (("3", 10) if form is kimera else ("run", 0))
    if form in (kitti, kimera):
        assert one.stamps is None
    else:
        np.testing.assert_allclose(np.diff(one.stamps), 0.5, atol=1e-6)


def test_two_robots_in_one_table(tmp_path, poses):
    rows = [line.split(",") for line in kimera(*poses).splitlines()]
    second = [["4", *row[1:]] for row in rows[1:]]
    path = tmp_path / "odometry_poses.csv"
    path.write_text("\n".join(",".join(row) for row in [*rows, *second]))
    graph = read_graph(path, default_sigmas=SIGMAS)
    assert graph.names == ("3", "4")
    assert [one.num_edges for one in graph.maps] == [3, 3]


def test_candidates_of_another_program(tmp_path, poses):
    """Kimera-Multi's closures: robots by number, rotation first, inliers as weights."""
    for robot in ("0", "1"):
        lines = kimera(*poses).replace("\n3,", f"\n{robot},")
        (tmp_path / f"poses{robot}.csv").write_text(lines)
    closures = tmp_path / "loop_closures.csv"
    closures.write_text(
        "robot1,pose1,robot2,pose2,qx,qy,qz,qw,tx,ty,tz,inlier_num,inlier_percent\n"
        "0,10,1,12,0,0,0,1,4,3,0,57,0.5\n"
    )
    with pytest.warns(UserWarning, match="columns left out: inlier_percent"):
        graph = read_graph(
            tmp_path / "poses0.csv",
            tmp_path / "poses1.csv",
            closures=closures,
            default_sigmas=SIGMAS,
        )
    np.testing.assert_allclose(lie.translation(graph.closures.measurement), [[4, 3, 0]])
    assert graph.closures.weight.tolist() == [57.0]
    assert (graph.closures.robot_b.tolist(), graph.closures.pose_b.tolist()) == ([1], [2])
    assert graph.closures.group is jaxlie.SE3


def test_sigmas_are_required(tmp_path, poses):
    (tmp_path / "run.txt").write_text(tum(*poses))
    with pytest.raises(FileFormatError, match=r"run.txt:1: .*default_sigmas.*--sigmas M RAD"):
        read_graph(tmp_path / "run.txt")


def test_times_come_out_again(tmp_path, poses):
    (tmp_path / "run.txt").write_text(tum(*poses))
    (one,) = read_graph(tmp_path / "run.txt", default_sigmas=SIGMAS).maps
    write_trajectory(tmp_path / "again.txt", one)
    np.testing.assert_allclose(read_tum(tmp_path / "again.txt")[0], [0, 0.5, 1, 1.5])


def test_poses_without_measurements_are_joined_where_asked(tmp_path):
    """In the order of ids; a file that has measurements stays as it is."""
    rows = ["VERTEX_SE2 5 2 0 0", "VERTEX_SE2 3 0 0 0", "VERTEX_SE2 4 1 0 0"]
    bare, linked = tmp_path / "bare.g2o", tmp_path / "linked.g2o"
    bare.write_text("\n".join(rows))
    linked.write_text("\n".join([*rows, "EDGE_SE2 3 5 2 0 0 1 0 0 1 0 1"]))
    reading = Reading(default_sigmas=SIGMAS)
    graph, _ = read_with_account([str(bare)], None, reading, join=True)
    (one,) = graph.maps
    np.testing.assert_array_equal(one.ids, [3, 4, 5])
    np.testing.assert_array_equal(np.stack([one.tail, one.head], axis=1), [[0, 1], [1, 2]])
    np.testing.assert_array_equal(lie.translation(one.measurement), [[1.0, 0.0]] * 2)
    for path, join in ((bare, False), (linked, True)):
        with pytest.raises(FileFormatError, match="falls into"):
            read_with_account([str(path)], None, reading, join=join)
