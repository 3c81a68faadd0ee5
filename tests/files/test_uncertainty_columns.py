"""Columns of a CSV that state the uncertainty of candidates: their names decide."""

import numpy as np
import pytest

from pcm_jax.errors import FileFormatError, InputWarning
from pcm_jax.files import read_graph

FLAT = "2500 0 0 2500 0 10000"
SOLID = "2500 0 0 0 0 0 2500 0 0 0 0 2500 0 0 0 10000 0 0 10000 0 10000"
ASSUMED = pytest.mark.filterwarnings("ignore:.*no columns for the uncertainty")
ENDS = "robot_a,id_a,robot_b,id_b"


@pytest.fixture
def flat(write):
    """Two robots of three poses."""
    lines = [f"EDGE_SE2 {k} {k + 1} 1 0 0 {FLAT}" for k in range(2)]
    return [write(*lines, name=f"{name}.g2o") for name in "ab"]


@pytest.fixture
def solid(write):
    lines = [f"EDGE_SE3:QUAT {k} {k + 1} 1 0 0 0 0 0 1 {SOLID}" for k in range(2)]
    return [write(*lines, name=f"{name}.g2o") for name in "ab"]


def information(maps, write, names, values):
    path = write(f"{ENDS},x,y,theta,{names}", f"a,1,b,2,1,2,0.5,{values}", name="c.csv")
    return np.asarray(read_graph(*maps, closures=path).closures.information)[0]


EXPECTED = np.array([[100.0, 10.0, 0.0], [10.0, 25.0, 0.0], [0.0, 0.0, 400.0]])
DIAGONAL = np.diag([100.0, 25.0, 400.0])


@pytest.mark.parametrize(
    ("names", "values", "expected"),
    [
        ("sigma_theta,sigma_x,sigma_y", "0.05,0.1,0.2", DIAGONAL),
        ("std_y,std_yaw,std_x", "0.2,0.05,0.1", DIAGONAL),
        ("var_x,var_y,var_theta", "0.01,0.04,0.0025", DIAGONAL),
        ("cov_xx,cov_yy,cov_tt", "0.01,0.04,0.0025", DIAGONAL),
        ("cov_11,cov_12,cov_13,cov_22,cov_23,cov_33", "0.01,0,0,0.04,0,0.0025", DIAGONAL),
        ("I11,I12,I22,I33,I13,I23", "100,10,25,400,0,0", EXPECTED),
        (
            "information_33,information_11,information_21,information_31,information_22,"
            "information_32",
            "400,100,10,0,25,0",
            EXPECTED,
        ),
        (
            ",".join(f"info_{i}{j}" for i in "xyt" for j in "xyt"),
            "100,10,0,10,25,0,0,0,400",
            EXPECTED,
        ),
    ],
)
def test_names_decide(flat, write, names, values, expected):
    np.testing.assert_allclose(information(flat, write, names, values), expected, rtol=1e-12)


def test_covariances_with_all_entries(flat, write):
    names = ",".join(f"covariance_{i}{j}" for i, j in ((1, 1), (2, 1), (2, 2), (3, 3), (3, 1)))
    covariance = np.linalg.inv(EXPECTED)
    values = ",".join(repr(float(covariance[i, j])) for i, j in ((0, 0), (1, 0), (1, 1), (2, 2)))
    found = information(flat, write, names, f"{values},0")
    np.testing.assert_allclose(found, EXPECTED, rtol=1e-9)


def test_six_directions_rotation_first(solid, write):
    axes = ["roll", "pitch", "yaw", "x", "y", "z"]
    header = f"{ENDS},x,y,z,qx,qy,qz,qw,{','.join(f'sigma_{axis}' for axis in axes)}"
    path = write(header, "a,1,b,2,1,2,3,0,0,0,1,0.1,0.2,0.5,1,2,4", name="c.csv")
    found = np.asarray(read_graph(*solid, closures=path).closures.information)[0]
    np.testing.assert_allclose(found, np.diag([1, 0.25, 0.0625, 100, 25, 4]), rtol=1e-12)


def test_precisions_of_dpgo(solid, write):
    """SE-Sync: a rotation's precision is that of its matrix, half that of its angle."""
    header = "robot_src,pose_src,robot_dst,pose_dst,qx,qy,qz,qw,tx,ty,tz,kappa,tau,weight"
    path = write(header, "0,1,1,2,0,0,0.6,0.8,1,2,3,5000,100,0.25", name="measurements.csv")
    closures = read_graph(*solid, closures=path).closures
    expected = np.diag([100.0] * 3 + [10000.0] * 3)
    np.testing.assert_allclose(np.asarray(closures.information)[0], expected, rtol=1e-12)
    np.testing.assert_allclose(
        np.asarray(closures.measurement.wxyz_xyz)[0], [0.8, 0, 0, 0.6, 1, 2, 3]
    )
    assert np.asarray(closures.weight).tolist() == [0.25]


@pytest.mark.parametrize(
    ("names", "values", "message"),
    [
        ("sigma_x,sigma_y", "1,1", "csv:2: no column states the sigma of theta, expected one$"),
        ("sigma_x,cov_xy", "1,1", "csv:2: columns of covariance and of sigma given, expected one"),
        ("var_x,var_y,var_theta", "1,-1,1", "csv:2: -1 given, expected a variance above 0$"),
        ("cov_0,cov_1,cov_2,cov_3,cov_4,cov_5", "1,0,0,1,0,1", "csv:1: column 'cov_0' given, exp"),
        ("cov_11,cov_22,cov_33,cov_12,cov_21", "1,1,1,0.1,0.2", "csv:2: the covariance .* not sym"),
        ("cov_11,cov_22,cov_33,cov_12", "1,1,1,2", "csv:2: covariance is not positive definite"),
    ],
)
def test_bad_columns(flat, write, names, values, message):
    with pytest.raises(FileFormatError, match=message):
        information(flat, write, names, values)


@ASSUMED
def test_euler_angles(solid, write):
    header = f"{ENDS},x,y,z,roll,pitch,yaw"
    path = write(header, f"a,1,b,2,1,2,3,0,0,{np.pi / 2!r}", name="c.csv")
    closures = read_graph(*solid, closures=path).closures
    half = np.sqrt(0.5)
    np.testing.assert_allclose(
        np.asarray(closures.measurement.wxyz_xyz)[0], [half, 0, 0, half, 1, 2, 3], atol=1e-15
    )
    with pytest.warns(InputWarning, match=r"line 2: roll, pitch or yaw 90 is more than a turn"):
        read_graph(*solid, closures=write(header, "a,1,b,2,1,2,3,0,0,90", name="c.csv"))


def test_euler_angles_of_a_trajectory(write):
    path = write("time,x,y,z,roll,pitch,yaw", "0,0,0,1,0,0,0", "1,1,0,2,0,0,0.5", name="t.csv")
    graph = read_graph(path, default_sigmas=(0.1, 0.1)).maps[0]
    np.testing.assert_allclose(
        np.asarray(graph.poses.wxyz_xyz)[1], [np.cos(0.25), 0, 0, np.sin(0.25), 1, 0, 2]
    )


def test_degrees_in_a_graph_file(write):
    lines = [f"EDGE_SE2 0 1 1 0 30 {FLAT}", f"EDGE_SE2 1 2 1 0 0 {FLAT}"]
    with pytest.warns(InputWarning, match=r"line 1: theta 30 is more than a turn"):
        read_graph(write(*lines, name="a.g2o"))


def test_poses_by_keys_without_uncertainty(write):
    """Information is then the maps' median, as where robots are named: not nothing."""
    ids = (range(3), range(100, 103))
    maps = [
        write(*[f"EDGE_SE2 {a} {a + 1} 1 0 0 {FLAT}" for a in own[:-1]], name=f"{name}.g2o")
        for name, own in zip("pq", ids, strict=True)
    ]
    path = write("from,to,x,y,theta", "1,102,1,2,0.5", name="c.csv")
    with pytest.warns(InputWarning, match=r"c.csv: no columns for the uncertainty; the median"):
        closures = read_graph(*maps, closures=path).closures
    np.testing.assert_allclose(np.asarray(closures.information)[0], np.diag([2500, 2500, 1e4]))
    np.testing.assert_array_equal(closures.rank, [3])


@ASSUMED
def test_a_closure_restated_without_uncertainty(flat, write):
    """It counts once, with the information that was stated, whichever comes first."""
    bare = write("a,1,b,2,1.2345678,2,0.5", name="bare.csv")
    full = write("b,2,a,1,-2.0423,-1.1632,-0.5,0.1,0.1,0.05", name="full.csv")
    for paths in ([bare, full], [full, bare]):
        with pytest.warns(InputWarning, match=r"bare.csv:1 says what .*full.csv:1 says the other"):
            closures = read_graph(*flat, closures=paths).closures
        assert len(closures) == 1
        np.testing.assert_allclose(np.asarray(closures.information)[0], np.diag([100, 100, 400]))
