"""To GTSAM and back, GTSAM's error against our cost, and what is refused."""

import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import InputError, InputWarning
from pcm_jax.files import from_gtsam, to_gtsam
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.mapping import optimize

gtsam = pytest.importorskip("gtsam")


def assert_same_edges(ours, theirs):
    for field in ("tail", "head", "robot_a", "pose_a", "robot_b", "pose_b"):
        if hasattr(ours, field):
            np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field))
    apart = lie.log(lie.between(*(lie.as_numpy(x.measurement) for x in (ours, theirs))))
    np.testing.assert_allclose(apart, 0.0, atol=1e-12)
    np.testing.assert_allclose(ours.information, theirs.information, rtol=1e-9, atol=1e-9)


@pytest.fixture(params=[jaxlie.SE2, jaxlie.SE3], ids=["SE2", "SE3"])
def robots(request, make_robots):
    return make_robots(request.param)


def test_there_and_back(robots):
    again = from_gtsam(*to_gtsam(robots))
    assert again.names == robots.names == ("a", "b")
    for ours, theirs in zip(robots.maps, again.maps, strict=True):
        apart = lie.log(lie.between(*(lie.as_numpy(x.poses) for x in (ours, theirs))))
        np.testing.assert_allclose(apart, 0.0, atol=1e-12)
        assert_same_edges(ours, theirs)
        assert [theirs.pose_name(k) for k in range(3)] == [f"{theirs.name}{k}" for k in range(3)]
    assert_same_edges(robots.closures, again.closures)
    edges = sum(one.num_edges for one in robots.maps)
    assert again.closures.source[0] == f"factors:{edges}"


def test_one_robot_keeps_its_ids(make_robots):
    ids = np.arange(8) * 3 + 100
    (one,) = make_robots(jaxlie.SE2, names=("a",), ids=[ids]).maps
    factors, values = to_gtsam(one)
    assert list(values.keys()) == ids.tolist()
    again = from_gtsam(factors, values)
    np.testing.assert_array_equal(again.maps[0].ids, ids)
    assert again.maps[0].name == "a"


def test_errors_are_the_same(make_robots):
    """GTSAM's error of the factors is our cost: the same residual, weights and tangent order."""
    for group in (jaxlie.SE2, jaxlie.SE3):
        (one,) = make_robots(group, names=("a",)).maps
        factors, values = to_gtsam(one)
        cost = optimize(one, initial="given").initial_cost
        np.testing.assert_allclose(factors.error(values), cost, rtol=1e-9)


def test_diagonal_noise_and_one_prior_need_no_word():
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for key in (gtsam.symbol("x", k) for k in range(3)):
        values.insert(key, gtsam.Pose3())
    sigmas = np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])  # rotation first
    for k in range(2):
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        ends = gtsam.symbol("x", k), gtsam.symbol("x", k + 1)
        factors.add(gtsam.BetweenFactorPose3(*ends, gtsam.Pose3(), noise))
    factors.add(gtsam.PriorFactorPose3(gtsam.symbol("x", 0), gtsam.Pose3(), noise))
    (one,) = from_gtsam(factors, values).maps
    assert one.name == "x"
    expected = np.diag(1.0 / np.roll(sigmas, 3) ** 2)
    np.testing.assert_allclose(one.information[0], expected, rtol=1e-12)


@pytest.fixture
def chain(make_robots):
    return to_gtsam(make_robots(jaxlie.SE2, names=("a",)).maps[0])


def test_what_is_left_out_is_counted(chain):
    factors, values = chain
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 1.0)
    for key in (0, 1):
        factors.add(gtsam.RangeFactorPose2(key, key + 1, 1.0, gtsam.noiseModel.Unit.Create(1)))
        factors.add(gtsam.PriorFactorPose2(key, gtsam.Pose2(key, 0, 0), noise))
    with pytest.warns(InputWarning, match=r"factors: skipped 2 lines \(2 RangeFactorPose2\)"):
        (one,) = from_gtsam(factors, values).maps
    assert one.priors.pose.tolist() == [0, 1]
    np.testing.assert_allclose(lie.translation(one.priors.measurement), [[0, 0], [1, 0]])
    np.testing.assert_allclose(one.priors.information, np.tile(np.eye(3), (2, 1, 1)))


def test_hard_constraints_on_request(chain):
    factors, values = chain
    noise = gtsam.noiseModel.Constrained.All(3)
    factors.add(gtsam.BetweenFactorPose2(0, 1, gtsam.Pose2(), noise))
    (one,) = from_gtsam(factors, values, constrained_sigma=1e-6).maps
    np.testing.assert_allclose(one.information[-1], 1e12 * np.eye(3))


def test_closures_that_say_nothing_of_some_directions(make_robots):
    """Planar ones between maps in space are kept, and so are such priors; odometry is complete."""
    whole = make_robots(jaxlie.SE3, ("a", "b"))
    factors, values = to_gtsam(MultiRobotGraph(whole.maps))
    planar = gtsam.noiseModel.Diagonal.Precisions(np.array([0.0, 0, 400, 100, 100, 0]))
    a, b = (
        gtsam.symbol("a", int(whole.maps[0].ids[0])),
        gtsam.symbol("b", int(whole.maps[1].ids[0])),
    )
    factors.add(gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(), planar))
    factors.add(gtsam.PriorFactorPose3(a, gtsam.Pose3(), planar))
    with pytest.warns(InputWarning, match=r"1 of 1 closures say 3 of 6 degrees of freedom"):
        graph = from_gtsam(factors, values)
    expected = np.diag([100.0, 100, 0, 0, 0, 400])
    np.testing.assert_allclose(graph.closures.information[0], expected)
    np.testing.assert_allclose(graph.maps[0].priors.information[-1], expected)
    next_one = gtsam.symbol("a", int(whole.maps[0].ids[1]))
    factors.add(gtsam.BetweenFactorPose3(a, next_one, gtsam.Pose3(), planar))
    with pytest.raises(InputError, match=rf"factors\[{factors.size() - 1}\]: information is not"):
        from_gtsam(factors, values)


def test_bad_factors_are_named(chain):
    factors, values = chain
    count = factors.size()
    unit = gtsam.noiseModel.Unit.Create(3)
    huber = gtsam.noiseModel.mEstimator.Huber.Create(1.0)
    for noise, keys, message in (
        (gtsam.noiseModel.Robust.Create(huber, unit), (0, 1), "noise model Robust, expected"),
        (gtsam.noiseModel.Constrained.All(3), (0, 1), "a hard constraint .sigma 0."),
        (unit, (0, 99), "99"),
    ):
        bad = gtsam.NonlinearFactorGraph(factors)
        bad.add(gtsam.BetweenFactorPose2(*keys, gtsam.Pose2(), noise))
        with pytest.raises(InputError, match=rf"factors[\[:]{count}.*{message}"):
            from_gtsam(bad, values)


def test_no_poses_no_graph():
    with pytest.raises(InputError, match="factors: no BetweenFactorPose2 or BetweenFactorPose3"):
        from_gtsam(gtsam.NonlinearFactorGraph(), gtsam.Values())
