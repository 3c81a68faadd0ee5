"""JRL: there and back, and against numbers written by hand."""

import dataclasses
import json

import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files import read_graph, write_graph
from pcm_jax.graph import LoopClosures, MultiRobotGraph, Priors

A, B = (ord(letter) << 56 for letter in "ab")


def pose3(key=None, x=0.0, w=1.0, z=0.0):
    value = {"type": "Pose3", "translation": [x, 0, 0], "rotation": [w, 0, 0, z]}
    return value if key is None else {**value, "key": key}


def between(first, second, x, sigmas=(0.1, 0.1, 0.1, 1, 1, 1)):
    return {
        "type": "BetweenFactorPose3",
        "key1": first,
        "key2": second,
        "measurement": pose3(x=x),
        "covariance": np.diag(np.square(sigmas)).ravel().tolist(),
    }


def dataset():
    """Two robots of two poses, a true and a false closure, entered by robot a."""
    return {
        "name": "two",
        "robots": ["a", "b"],
        "measurements": {
            "a": [
                {
                    "stamp": 10**18,
                    "measurements": [
                        {
                            "type": "PriorFactorPose3",
                            "key": A,
                            "prior": pose3(),
                            "covariance": np.eye(6).ravel().tolist(),
                        }
                    ],
                },
                {
                    "stamp": 10**18 + 5 * 10**8,
                    "measurements": [
                        between(A, A + 1, 1.0),
                        between(A + 1, B, 5.0),
                        between(A, B + 1, 9.0),
                    ],
                },
            ],
            "b": [
                {"stamp": 10**18, "measurements": [between(B, B + 1, 2.0)]},
                {
                    "stamp": 10**18 + 1,
                    "measurements": [
                        {"type": "RangeFactorPose3", "key1": A, "key2": B, "measurement": 1.0}
                    ],
                },
            ],
        },
        "groundtruth": {
            "a": [pose3(A), pose3(A + 1, 1.0)],
            "b": [pose3(B, 6.0), pose3(B + 1, 8.0)],
        },
        "initialization": {
            "a": [pose3(A), pose3(A + 1, 1.1)],
            "b": [
                pose3(B),
                pose3(B + 1, 2.1),
                {"type": "Point3", "key": B + 10**9, "x": 0, "y": 0, "z": 0},
            ],
        },
        "potential_outlier_factors": {"a": [[1, 1], [1, 2]], "b": []},
        "outlier_factors": {"a": [[1, 2]], "b": []},
    }


@pytest.fixture
def save(tmp_path):
    def make(value, name="two.jrl"):
        (tmp_path / name).write_text(json.dumps(value))
        return tmp_path / name

    return make


def test_by_hand(save):
    with pytest.warns(UserWarning, match=r"skipped 1 lines \(1 RangeFactorPose3\)"):
        graph = read_graph(save(dataset()))
    assert graph.names == ("a", "b")
    a, b = graph.maps
    assert a.ids.tolist() == [A, A + 1]
    np.testing.assert_allclose(lie.translation(lie.as_numpy(b.poses))[:, 0], [0.0, 2.1])
    # GTSAM puts rotation first: sigmas of 0.1 rad and 1 m.
    np.testing.assert_allclose(a.information[0], np.diag([1, 1, 1, 100, 100, 100]), rtol=1e-9)
    assert graph.closures.is_true.tolist() == [True, False]
    np.testing.assert_allclose(lie.translation(graph.closures.measurement)[:, 0], [5.0, 9.0])
    np.testing.assert_allclose(lie.translation(graph.truth[1])[:, 0], [6.0, 8.0])
    np.testing.assert_allclose(a.stamps, [1e9, 1e9 + 0.5])
    assert len(a.priors) == 1 and b.priors is None


@pytest.mark.filterwarnings("ignore:.*skipped 1 lines")
def test_other_writers(save):
    """Values by their keys, as the format's description has them; covariances row by row."""
    data = dataset()
    for name, other in (("initialization", "initialization"), ("groundtruth", "ground_truth")):
        values = data.pop(name)
        data[other] = {
            robot: {str(one["key"]): {k: v for k, v in one.items() if k != "key"} for one in own}
            for robot, own in values.items()
        }
    factor = data["measurements"]["a"][1]["measurements"][1]
    factor["covariance"] = np.reshape(factor["covariance"], (6, 6)).tolist()
    given, expected = read_graph(save(data)), read_graph(save(dataset(), "plain.jrl"))
    for one, two in zip(given.maps, expected.maps, strict=True):
        np.testing.assert_array_equal(one.poses.wxyz_xyz, two.poses.wxyz_xyz)
    for one, two in zip(given.truth, expected.truth, strict=True):
        np.testing.assert_array_equal(one.wxyz_xyz, two.wxyz_xyz)
    np.testing.assert_array_equal(given.closures.information, expected.closures.information)
    data["initialization"]["a"]["one"] = {"type": "Pose3"}
    with pytest.raises(FileFormatError, match=r"initialization.a.one: .*expected an integer"):
        read_graph(save(data))


def test_one_robot_keeps_its_name_and_ids(tmp_path, make_robots, group):
    (one, *_) = make_robots(group, ("rover", "other")).maps
    one = dataclasses.replace(one, ids=np.arange(one.num_poses) * 3 + 7)
    write_graph(tmp_path / "some.jrl", one)
    (again,) = read_graph(tmp_path / "some.jrl").maps
    assert (again.name, again.ids.tolist()) == ("rover", one.ids.tolist())
    with pytest.raises(InputError, match="robot 'rover' has the id -1, which fits no symbol key"):
        write_graph(tmp_path / "b.jrl", dataclasses.replace(one, ids=one.ids - 8))


@pytest.mark.parametrize("names", [("a", "b"), ("left", "right")])
def test_there_and_back(tmp_path, make_robots, assert_same, group, names):
    graph = make_robots(group, names)
    closures = graph.closures
    labels = np.arange(len(closures)) % 2 == 0
    closures = LoopClosures.from_checked(
        tuple(np.asarray(getattr(closures, n)) for n in ("robot_a", "pose_a", "robot_b", "pose_b")),
        closures.measurement,
        closures.information,
        closures.source,
        closures.weight,
        labels,
    )
    truth = tuple(one.poses for one in graph.maps)
    graph = MultiRobotGraph(graph.maps, closures, truth)
    write_graph(tmp_path / "some.jrl", graph)
    again = read_graph(tmp_path / "some.jrl")
    assert again.names == graph.names
    for one, other in zip(graph.maps, again.maps, strict=True):
        rows = [np.stack([m.tail, m.head, m.information[:, 0, 0]], axis=1) for m in (one, other)]
        first, second = (some[np.lexsort(some.T)] for some in rows)
        np.testing.assert_allclose(first, second, rtol=1e-9)
    assert sorted(again.closures.is_true.tolist()) == sorted(labels.tolist())
    for one, other in zip(graph.truth, again.truth, strict=True):
        apart = lie.log(lie.between(lie.as_numpy(one), lie.as_numpy(other)))
        np.testing.assert_allclose(apart, 0.0, atol=1e-9)


def test_plain_poses_2d(save):
    value = dataset()
    value["robots"] = [97, 98]  # JRL's own writer
    del value["groundtruth"], value["outlier_factors"], value["initialization"]
    value["measurements"] = {
        "a": [
            {
                "stamp": 3,
                "measurements": [
                    {
                        "type": "BetweenFactorPose2",
                        "key1": A,
                        "key2": A + 1,
                        "measurement": {"type": "Pose2", "x": 1, "y": 2, "theta": 0.5},
                        "covariance": [1, 0, 0, 0, 4, 0, 0, 0, 0.25],
                    }
                ],
            }
        ]
    }
    value["potential_outlier_factors"] = {"a": []}
    graph = read_graph(save(value))
    assert graph.group is jaxlie.SE2 and graph.closures.is_true is None
    np.testing.assert_allclose(graph.maps[0].information[0], np.diag([1, 0.25, 4]), rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: v.pop("measurements"), "no JSON Robot Log|begins no format"),
        (
            lambda v: v["measurements"]["a"][1]["measurements"][0].pop("key2"),
            r"measurements.a\[1\].measurements\[0\]: no 'key2'",
        ),
        (
            lambda v: v["measurements"]["a"][1]["measurements"][0].update(covariance=[1, 2]),
            r"measurements\[0\].covariance: a list of 2 given, expected 36 numbers",
        ),
        (
            lambda v: v["measurements"]["a"][1]["measurements"][0].update(
                covariance=(-np.eye(6)).ravel().tolist()
            ),
            "jrl:2: covariance is not positive definite",
        ),
        (
            lambda v: v["measurements"]["a"][1]["measurements"][0]["measurement"].update(
                rotation=[3, 0, 0, 0]
            ),
            "quaternion of norm 3 is no rounding",
        ),
        (
            lambda v: v["measurements"]["a"][1]["measurements"][0]["measurement"].update(
                rotation=[10**400, 0, 0, 0]
            ),
            "rotation: a number that is not finite given",
        ),
        (lambda v: v["measurements"]["a"][1].update(stamp="now"), r"a\[1\].stamp: .* given"),
    ],
)
def test_bad_files(save, change, message):
    value = dataset()
    change(value)
    with pytest.raises(FileFormatError, match=message) as caught:
        read_graph(save(value))
    assert "\n" not in str(caught.value)


def test_text_that_is_no_json(tmp_path):
    (tmp_path / "a.jrl").write_text('{"robots": [],\n "measurements": {,}}')
    with pytest.raises(FileFormatError, match=r"a.jrl:2: no JSON: "):
        read_graph(tmp_path / "a.jrl")


def test_priors_are_kept(make_robots, tmp_path):
    graph = make_robots(jaxlie.SE3, ("a",))
    one = graph.maps[0]
    priors = Priors(
        np.array([2]),
        lie.take(lie.as_numpy(one.poses), np.array([2])),
        np.eye(6)[None],
        np.array([""], object),
    )
    write_graph(tmp_path / "a.jrl", dataclasses.replace(one, priors=priors))
    again = read_graph(tmp_path / "a.jrl").maps[0].priors
    assert again.pose.tolist() == [2]
    np.testing.assert_allclose(again.information, np.eye(6)[None], rtol=1e-9)
