import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import FileFormatError, InputWarning
from pcm_jax.files import read_graph, write_candidates, write_g2o
from pcm_jax.graph import MultiRobotGraph

UNIT_2D = "1 0 0 1 0 1"
UNIT_3D = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
KEY = ord("r") << 56


@pytest.fixture
def flat(write):
    """Two files of one robot each, ids 0, 10, 20."""
    lines = [f"VERTEX_SE2 {k} {k} 0 0" for k in (0, 10, 20)]
    lines += [f"EDGE_SE2 0 10 10 0 0 {UNIT_2D}", "EDGE_SE2 10 20 10 0 0 4 0 0 4 0 4"]
    lines += ["EDGE_SE2 0 20 20 0 0 16 0 0 16 0 16"]
    return [write(*lines, name=name) for name in ("a.g2o", "b.g2o")]


@pytest.fixture
def solid(write):
    """One file of two robots, r0, r1 and s0, s1."""
    lines = []
    for key in (KEY, ord("s") << 56):
        lines += [f"VERTEX_SE3:QUAT {key + k} 0 0 {k} 0 0 0 1" for k in (0, 1)]
        lines += [f"EDGE_SE3:QUAT {key} {key + 1} 0 0 1 0 0 0 1 {UNIT_3D}"]
    lines.append(f"EDGE_SE3:QUAT {KEY} {(ord('s') << 56) + 1} 0 0 1 0 0 0 1 {UNIT_3D}")
    return [write(*lines)]


def test_information_columns(flat, write):
    path = write(
        "robot_a,id_a,robot_b,id_b,x,y,theta,i11,i12,i13,i22,i23,i33",
        "a, 0, b, 10, 1.5, -2, 0.5, 4, 0.5, 0.25, 5, 0.125, 6",
        "",
        "# a comment",
        "b,20,a,10,1,2,3,1,0,0,1,0,1",
        name="candidates.csv",
    )
    closures = read_graph(*flat, closures=path).closures
    assert closures.robot_a.tolist() == [0, 1]
    assert closures.pose_a.tolist() == [0, 2]
    assert closures.robot_b.tolist() == [1, 0]
    assert closures.pose_b.tolist() == [1, 1]
    assert closures.source.tolist() == [f"{path}:2", f"{path}:5"]
    np.testing.assert_array_equal(
        closures.information[0], [[4, 0.5, 0.25], [0.5, 5, 0.125], [0.25, 0.125, 6]]
    )
    np.testing.assert_allclose(
        np.asarray(closures.measurement.unit_complex_xy)[0], [np.cos(0.5), np.sin(0.5), 1.5, -2]
    )


def test_sigma_columns(flat, write):
    path = write("a,0,b,10,1,2,0.5,0.1,0.2,0.05", name="candidates.csv")
    information = read_graph(*flat, closures=path).closures.information
    np.testing.assert_allclose(information[0], np.diag([100.0, 25.0, 400.0]))


def test_without_uncertainty_the_maps_edges_tell(flat, write):
    """Their standard deviations are 1, 1/2 and 1/4 in equal numbers."""
    path = write("a,0,b,10,1,2,0.5", name="candidates.csv")
    with pytest.warns(InputWarning, match=r"no columns for the uncertainty; .*\(0.5, 0.5, 0.5\)"):
        information = read_graph(*flat, closures=path).closures.information
    np.testing.assert_allclose(information[0], 4.0 * np.eye(3))


def test_three_dimensions_after_the_files_closures(solid, write):
    """Ids of symbol robots may be keys or indices, robots names or letters by order."""
    path = write(
        f"r,{KEY + 1},s,0,1,2,3,0.6,0,0,0.8,{UNIT_3D.replace(' ', ',')}",
        f"b,1,a,0,1,2,3,0,0,0,1,{UNIT_3D.replace(' ', ',')}",
        name="candidates.csv",
    )
    graph = read_graph(*solid, closures=path)
    assert graph.closures.robot_a.tolist() == [0, 0, 1]
    assert graph.closures.pose_a.tolist() == [0, 1, 1]
    assert graph.closures.source[1:].tolist() == [f"{path}:1", f"{path}:2"]
    rows = lie.parameters(lie.as_numpy(graph.closures.measurement))
    np.testing.assert_allclose(rows[1], [0.8, 0.6, 0, 0, 1, 2, 3], atol=1e-15)


def test_an_empty_file_has_no_closures(flat, write):
    path = write("robot_a,id_a,robot_b,id_b,x,y,theta,s1,s2,s3", name="candidates.csv")
    assert len(read_graph(*flat, closures=path).closures) == 0


def test_indefinite_candidates_are_clipped_on_request(flat, write):
    path = write("a,0,b,10,1,2,0.5,1,2,0,1,0,1", name="candidates.csv")
    with pytest.raises(FileFormatError, match=r"csv:1: information is not pos.*repair=\"clip\""):
        read_graph(*flat, closures=path)
    with pytest.warns(InputWarning, match="1 information matrices clipped"):
        read_graph(*flat, closures=path, repair="clip")


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["a,0,c,10,1,2,3,1,1,1"], "csv:1: there is no robot 'c', expected one of a, b$"),
        (["a,0,b,11,1,2,3,1,1,1"], "csv:1: robot 'b' has no pose with id 11$"),
        (["a,0,a,10,1,2,3,1,1,1"], "csv:1: closure from robot 'a' to itself, expected two"),
        (["a,0,b,10,1,2"], "csv:1: 6 columns, expected robot_a,id_a,robot_b,id_b,x,y,theta and 0"),
        (["a,0,b,10,1,2,3,4"], "csv:1: 8 columns, expected"),
        (["a,0,b,10,1,2,3,1,1,1", "a,0,b,10,1,2,3"], "csv:2: 7 columns, expected 10:"),
        (["a,zero,b,10,1,2,3,1,1,1"], "csv:1: 'zero' given, expected an integer id"),
        (["a,0,b,1e1,1,2,3,1,1,1"], "csv:1: '1e1' given, expected an integer id"),
        (["a,0,b,10,1,two,3,1,1,1"], "csv:1: 'two' given, expected a number"),
        (["a,0,b,10,1,nan,3,1,1,1"], "csv:1: nan given, expected a finite number"),
        (["a,0,b,10,1,2,3,1,0,1"], "csv:1: 0 given, expected a standard deviation above 0"),
        (["a,0,b,10,1,2,3,1,-1,1"], "csv:1: -1 given, expected a standard deviation above 0"),
        (
            ["robot_a,robot_b,id_a,id_b,x,y"],
            "csv:1: columns robot_a,robot_b,id_a.* given, exp",
        ),
        (["robot_a,id_a,robot_b,id_b,x,y,z,qx,qy,qz,qw"], "csv:1: columns .*, expected .*theta"),
    ],
)
def test_bad_candidates(flat, write, lines, message):
    path = write(*lines, name="candidates.csv")
    with pytest.raises(FileFormatError, match=message) as caught:
        read_graph(*flat, closures=path)
    assert "\n" not in str(caught.value)


def test_a_missing_file_of_candidates(flat, tmp_path):
    with pytest.raises(FileFormatError, match=r"none.csv: there is no such file"):
        read_graph(*flat, closures=tmp_path / "none.csv")


def test_quaternions_of_candidates(solid, write):
    path = write("r,0,s,0,1,2,3,0,0,0,0,1,1,1,1,1,1", name="candidates.csv")
    with pytest.raises(FileFormatError, match="csv:1: quaternion of norm 0, expected norm 1"):
        read_graph(*solid, closures=path)


def test_written_candidates_are_read_back(tmp_path, make_robots, assert_same, group):
    graph = make_robots(group, ("ann", "bob, the second", "c"))
    write_g2o(tmp_path / "maps.g2o", MultiRobotGraph(graph.maps))
    write_candidates(tmp_path / "candidates.csv", graph)
    again = read_graph(tmp_path / "maps.g2o", closures=tmp_path / "candidates.csv")
    assert len(graph.closures) > 0
    assert_same(graph, again)
