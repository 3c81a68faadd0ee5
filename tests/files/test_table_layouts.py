"""Tables as other programs write them: separators, names in comments, lines without information."""

import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import FileFormatError, InputWarning
from pcm_jax.files import read_graph
from pcm_jax.files.formats.tum import read_tum

FLAT = "2500 0 0 2500 0 10000"
SOLID = "2500 0 0 0 0 0 2500 0 0 0 0 2500 0 0 0 10000 0 0 10000 0 10000"
SIGMAS = (0.1, 0.05)


@pytest.fixture
def maps(write):
    lines = [f"EDGE_SE2 {k} {k + 1} 1 0 0 {FLAT}" for k in range(2)]
    return [write(*lines, name=f"{name}.g2o") for name in "ab"]


@pytest.mark.filterwarnings("ignore:.*no columns for the uncertainty")
@pytest.mark.parametrize(
    "lines",
    [
        ["robot_a id_a robot_b id_b x y theta", "a 1 b 2 1 2 0.5"],
        ["a  1 b 2   1 2 0.5"],
        ["# robot_a id_a robot_b id_b theta x y", "a 1 b 2 0.5 1 2"],
        ["# made by hand", "#robot1,pose1,robot2,pose2,theta,x,y", "a,1,b,2,0.5,1,2"],
        ["x;y;theta;robot_a;id_a;robot_b;id_b", "1;2;0.5;a;1;b;2"],
        ["robot_a,id_a,robot_b,id_b,x,y,theta,", "a,1,b,2,1,2,0.5,"],
        ["a,1,b,2,1,2,0.5,"],
        ["# some words, of no column", "a,1,b,2,1,2,0.5"],
    ],
)
def test_candidates(maps, write, lines):
    closures = read_graph(*maps, closures=write(*lines, name="c.csv")).closures
    assert (closures.pose_a.tolist(), closures.pose_b.tolist()) == ([1], [2])
    np.testing.assert_allclose(
        np.asarray(closures.measurement.unit_complex_xy)[0], [np.cos(0.5), np.sin(0.5), 1, 2]
    )


def test_blanks_are_no_sign_of_candidates(write):
    """Lines of numbers alone, or with a tag, are told as what they come close to."""
    with pytest.raises(FileFormatError, match="7 numbers a line, where TUM's have 8"):
        read_graph(write("0 1 1 0 0 1 0", name="t.txt"))
    with pytest.raises(FileFormatError, match=r"'EDGE_FOO .* g2o's lines begin with VERTEX_SE2"):
        read_graph(write("EDGE_FOO 0 1 1 0 0 1", name="t.txt"))


def places(graph):
    return lie.translation(lie.as_numpy(graph.poses))[:, 0].tolist()


def test_nanoseconds_and_commas(write):
    tum = [f"14036365797635555{k}6 {k} 0 0 0 0 0 1" for k in range(3)]
    graph = read_graph(write(*tum, name="t.txt"), default_sigmas=SIGMAS).maps[0]
    assert places(graph) == [0, 1, 2]
    np.testing.assert_allclose(graph.stamps, 1403636579.7635556, rtol=1e-12)
    kitti = [f"1,0,0,{k},0,1,0,0,0,0,1,0" for k in range(3)]
    assert places(read_graph(write(*kitti, name="k.txt"), default_sigmas=SIGMAS).maps[0]) == [
        0,
        1,
        2,
    ]
    named = ["timestamp tx ty tz qx qy qz qw", *(f"{k}.5 {k} 0 0 0 0 0 1" for k in range(3))]
    assert places(read_graph(write(*named, name="n.txt"), default_sigmas=SIGMAS).maps[0]) == [
        0,
        1,
        2,
    ]


@pytest.mark.parametrize(
    "comment",
    ["#timestamp,x,y,z,qw,qx,qy,qz", "# t [s] p_x p_y p_z q_w [] q_x [] q_y [] q_z []"],
)
def test_a_comment_names_w_first(write, comment):
    path = write(comment, "0.5,1,2,3,0.8,0,0,0.6", "1.5,2,2,3,0.8,0,0,0.6", name="t.txt")
    _, poses = read_tum(path)
    np.testing.assert_allclose(np.asarray(poses.wxyz_xyz)[0], [0.8, 0, 0, 0.6, 1, 2, 3])
    graph = read_graph(path, default_sigmas=SIGMAS).maps[0]
    np.testing.assert_allclose(np.asarray(graph.poses.wxyz_xyz)[0], [0.8, 0, 0, 0.6, 1, 2, 3])


def test_times_that_run_backwards(write):
    lines = [f"{time} {k} 0 0 0 0 0 1" for k, time in enumerate((1.0, 3.0, 2.0))]
    with pytest.warns(InputWarning, match=r"t.txt: line 3: time 2 after 3; a step goes"):
        read_graph(write(*lines, name="t.txt"), default_sigmas=SIGMAS)


def test_some_edges_without_information(write):
    """Odometry states its own, closures get that of the sigmas; a last line may be cut short."""
    lines = [f"EDGE_SE3:QUAT {k} {k + 1} 1 0 0 0 0 0 1 {SOLID}" for k in range(3)]
    lines.insert(2, "EDGE_SE3:QUAT 0 2 2 0 0 0 0 0 1")
    graph = read_graph(write(*lines, name="m.g2o"), default_sigmas=SIGMAS).maps[0]
    assert (graph.tail.tolist(), graph.head.tolist()) == ([0, 1, 0, 2], [1, 2, 2, 3])
    np.testing.assert_allclose(np.asarray(graph.information)[2], np.diag([100.0] * 3 + [400.0] * 3))
    np.testing.assert_allclose(np.asarray(graph.information)[3, 0, 0], 2500.0)
    with pytest.raises(FileFormatError, match=r":3: 10 columns, .*--default-sigmas M RAD"):
        read_graph(write(*lines, name="m.g2o"))
