"""Errors of trajectories: evo as the oracle, cases worked by hand, and who is matched with whom."""

import dataclasses
import json

import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.evaluation import trajectory_errors
from pcm_jax.graph import MultiRobotGraph, PoseGraph, symbols

SIGMAS = {"sigma_translation": 0.1, "sigma_rotation": 0.1}
STATISTICS = ("rmse", "mean", "median", "max")


def graph(poses, name="", stamps=None, ids=None):
    made = PoseGraph.from_trajectory(poses, name=name, ids=ids, **SIGMAS)
    return dataclasses.replace(made, stamps=None if stamps is None else np.array(stamps, float))


def walk(group, count, seed):
    """A random walk of about a metre and half a radian a step."""
    generator = np.random.default_rng(seed)
    steps = 0.5 * generator.standard_normal((count, lie.tangent_dim(group)))
    poses = [lie.exp(group, np.zeros(lie.tangent_dim(group)))]
    for step in steps:
        poses.append(lie.compose(poses[-1], lie.exp(group, step)))
    return lie.stack(poses)


def noisy(poses, seed, sigma=0.05):
    tangent = np.random.default_rng(seed).standard_normal(
        (len(lie.parameters(poses)), lie.tangent_dim(poses))
    )
    return lie.compose(poses, lie.exp(lie.group_of(poses), sigma * tangent))


def moved(poses, *tangent):
    return lie.compose(lie.exp(lie.group_of(poses), np.array(tangent, float)), poses)


def corner(x=0.0, y=0.0, turn=0.0):
    """Four planar poses along an L, shifted, each turned on the spot."""
    places = np.array([[0, 0], [1, 0], [2, 0], [2, 1]], float) + np.array([x, y])
    cos, sin = np.full(4, np.cos(turn)), np.full(4, np.sin(turn))
    return lie.from_components(jaxlie.SE2, (cos, sin, *places.T))


def in_space(poses):
    """Homogeneous matrices `[n, 4, 4]`, those of SE(2) in the plane z = 0."""
    matrices = np.asarray(lie.as_matrix(poses))
    if matrices.shape[1] == 4:
        return matrices
    out = np.tile(np.eye(4), (len(matrices), 1, 1))
    out[:, :2, :2], out[:, :2, 3] = matrices[:, :2, :2], matrices[:, :2, 2]
    return out


def evo_statistics(metric, pair):
    metric.process_data(pair)
    told = metric.get_all_statistics()
    return [told[name] for name in STATISTICS]


def assert_as_evo(errors, estimate, truth, *, delta, unit):
    """Compares with evo's APE after its own alignment, and its RPE, of one trajectory."""
    metrics = pytest.importorskip("evo.core.metrics")
    from evo.core.trajectory import PosePath3D

    given, true = (PosePath3D(poses_se3=list(in_space(side))) for side in (estimate, truth))
    given.align(true)
    parts = {
        "translation": metrics.PoseRelation.translation_part,
        "rotation": metrics.PoseRelation.rotation_angle_deg,
    }
    for part, relation in parts.items():
        absolute = evo_statistics(metrics.APE(relation), (true, given))
        np.testing.assert_allclose(getattr(errors.absolute, part), absolute, rtol=1e-6)
        step = metrics.RPE(relation, delta, getattr(metrics.Unit, unit))
        relative = evo_statistics(step, (true, given))
        np.testing.assert_allclose(getattr(errors.relative, part), relative, rtol=1e-6)
        assert errors.relative.count == len(step.error)


@pytest.mark.parametrize("group", [jaxlie.SE2, jaxlie.SE3])
@pytest.mark.parametrize(
    ("options", "evo"),
    [
        ({}, {"delta": 1, "unit": "frames"}),
        ({"delta": 7}, {"delta": 7, "unit": "frames"}),
        ({"delta_metres": 5.0}, {"delta": 5.0, "unit": "meters"}),
    ],
)
def test_errors_are_those_of_evo(group, options, evo):
    truth = walk(group, 200, seed=1)
    estimate = moved(noisy(truth, seed=2), *np.linspace(1.0, 2.0, lie.tangent_dim(group)))
    errors = trajectory_errors(graph(estimate), graph(truth), **options)
    assert errors.robots[0].absolute == errors.absolute
    assert errors.absolute.translation.rmse > 0.05
    assert_as_evo(errors, estimate, truth, **evo)


def test_one_alignment_of_all_robots_is_evo_s_of_one_long_trajectory():
    """Of the poses of all, end to end; the steps are each robot's own."""
    truth = [walk(jaxlie.SE3, 40 + k, seed=k) for k in range(3)]
    estimate = [moved(noisy(p, k + 7), 1, 2, 3, 0.4, 0.5, 0.6) for k, p in enumerate(truth)]
    maps, true = (
        [graph(p, name) for p, name in zip(s, "abc", strict=True)] for s in (estimate, truth)
    )
    errors = trajectory_errors(maps, true)
    assert errors.relative.count == 40 + 41 + 42
    metrics = pytest.importorskip("evo.core.metrics")
    from evo.core.trajectory import PosePath3D

    given, one = (
        PosePath3D(poses_se3=list(in_space(lie.concatenate(side)))) for side in (estimate, truth)
    )
    given.align(one)
    told = evo_statistics(metrics.APE(metrics.PoseRelation.translation_part), (one, given))
    np.testing.assert_allclose(errors.absolute.translation, told, rtol=1e-6)


@pytest.mark.parametrize("group", [jaxlie.SE2, jaxlie.SE3])
def test_a_rigid_shift_is_no_error(group):
    truth = walk(group, 30, seed=3)
    shifted = moved(truth, *np.linspace(5.0, -1.0, lie.tangent_dim(group)))
    errors = trajectory_errors(graph(shifted), graph(truth))
    for kind in (errors.absolute, errors.relative):
        np.testing.assert_allclose([*kind.translation, *kind.rotation], 0.0, atol=1e-10)
    assert trajectory_errors(graph(shifted), graph(truth), align=None).absolute.translation.max > 1


def test_one_robot_off_by_a_metre():
    """Robot b is 1 m beside its place, each pose turned by 0.1 rad; a is where it should be."""
    truth = [graph(corner(), "a"), graph(corner(x=8.0), "b")]
    estimate = [graph(corner(), "a"), graph(corner(x=8.0, y=1.0, turn=0.1), "b")]
    given = trajectory_errors(estimate, truth, align=None)
    a, b = given.robots
    assert a.absolute.translation == a.absolute.rotation == (0.0, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(b.absolute.translation, 1.0, rtol=1e-12)
    np.testing.assert_allclose(b.absolute.rotation, np.degrees(0.1), rtol=1e-12)
    assert given.absolute.translation == pytest.approx((0.5**0.5, 0.5, 0.5, 1.0))
    assert given.absolute.count == 8
    joint = trajectory_errors(estimate, truth).absolute.translation
    assert 0.1 < joint.rmse < 0.5
    each = trajectory_errors(estimate, truth, align="each").absolute
    np.testing.assert_allclose(each.translation, 0.0, atol=1e-12)
    half = np.degrees([0.1 * 0.5**0.5, 0.05, 0.05, 0.1])  # of a none, of b all
    np.testing.assert_allclose(each.rotation, half, rtol=1e-9)
    steps = given.robots[1].relative
    assert steps.count == 3
    np.testing.assert_allclose(steps.translation, 2.0 * np.sin(0.05))  # a metre, turned by 0.1


def test_steps_follow_each_other():
    """Of ten poses: three steps of three; by metres, each ends where a metre is reached."""
    places = np.concatenate([[0.0], np.cumsum([0.5, 0.5, 0.75, 0.75, 2, 0.25, 0.25, 0.25, 0.25])])
    bent = np.where(np.arange(10) > 4, 1.0, 0.0)
    poses = lie.from_components(jaxlie.SE2, (np.ones(10), np.zeros(10), places, bent))
    assert trajectory_errors(graph(poses), graph(poses), delta=3).relative.count == 3
    by_metres = trajectory_errors(graph(poses), graph(poses), delta_metres=1.0)
    assert by_metres.relative.count == 4  # at 1, 2.5, 4.5 and, after four quarters, 5.5 m


def test_poses_are_matched_by_time():
    """Nearest stamps, each used once, in the order of time, however the files are ordered."""
    truth = graph(lie.take(walk(jaxlie.SE2, 5, seed=4), np.arange(6)), "t", [0, 1, 2, 3, 4, 5])
    rows = [4, 0, 2, 2, 5]
    stamps = [4.004, 0.0, 2.009, 2.001, 5.02]
    estimate = graph(lie.take(truth.poses, np.array(rows)), "e", stamps)
    errors = trajectory_errors(estimate, truth, align=None)
    (one,) = errors.robots
    assert (one.matched_by, one.poses, one.absolute.count) == ("time stamp", 5, 3)
    assert errors.absolute.translation.max == 0.0 and errors.relative.count == 2
    assert errors.relative.translation.max == pytest.approx(0.0, abs=1e-12)
    wide = trajectory_errors(estimate, truth, align=None, max_difference=0.05)
    assert wide.absolute.count == 4
    untimed = dataclasses.replace(estimate, stamps=np.array([4.004, np.nan, np.nan, np.nan, 0.0]))
    assert trajectory_errors(untimed, truth, align=None).absolute.count == 2


def test_poses_are_matched_by_id():
    """In the estimate's order; symbol keys of other letters match by their indices."""
    truth = walk(jaxlie.SE2, 9, seed=5)
    kept = np.array([7, 2, 3, 9])
    own = graph(lie.take(truth, kept), "a", ids=kept)
    errors = trajectory_errors(own, graph(truth, "a"), align=None)
    assert errors.robots[0].matched_by == "id"
    assert errors.absolute.count == 4 and errors.absolute.translation.max == 0.0
    row = lie.from_components(jaxlie.SE2, (np.ones(4), np.zeros(4), kept * 1.0, np.zeros(4)))
    line = graph(row, "a", ids=kept)
    along = trajectory_errors(line, line, align=None, delta_metres=5.0)
    assert along.relative.count == 2  # from 7 back to 2, and from there past 3 to 9
    keyed = dataclasses.replace(own, ids=symbols.keys("x", kept))
    errors = trajectory_errors(keyed, graph(truth, "a"), align=None)
    assert errors.absolute.count == 4 and errors.absolute.translation.max == 0.0


def test_robots_are_matched_by_name_or_order():
    poses = [corner(), corner(x=3.0), corner(y=5.0)]
    a, b, c = (graph(p, name) for p, name in zip(poses, "abc", strict=True))
    by_name = trajectory_errors([c, a], [a, b, c], align=None)
    assert by_name.robots_by == "name"
    assert [(one.robot, one.true_robot) for one in by_name.robots] == [("c", "c"), ("a", "a")]
    assert by_name.absolute.translation.max == 0.0
    renamed = [dataclasses.replace(one, name=f"truth_{one.name}") for one in (a, b)]
    by_order = trajectory_errors([a, b], renamed, align=None)
    assert by_order.robots_by == "order" and by_order.absolute.translation.max == 0.0


def test_true_poses_that_a_graph_states_are_the_truth():
    world = MultiRobotGraph((graph(corner(x=9.0), "a"),), truth=(corner(),))
    estimate = graph(corner(x=1.0), "a")
    assert trajectory_errors(estimate, world, align=None).absolute.translation.rmse == 1.0


def test_poses_in_a_plane_of_space_are_compared_with_planar_ones():
    flat = corner(turn=2.5)
    raised = in_space(flat)
    raised[:, 2, 3] = 1.5
    for sides in ((graph(flat), graph(raised)), (graph(raised), graph(flat))):
        errors = trajectory_errors(*sides, align=None)
        np.testing.assert_allclose(errors.absolute.translation, 0.0, atol=1e-12)
        np.testing.assert_allclose(errors.absolute.rotation, 0.0, atol=1e-10)
    raised[0, 2, 3] = 1.6
    with pytest.raises(InputError, match="truth: SE3 poses that leave the plane given, expected"):
        trajectory_errors(graph(flat), graph(raised))


def test_what_it_says_and_writes():
    estimate = [graph(corner(), "a"), graph(corner(x=8.0, y=1.0), "b")]
    truth = [graph(corner(), "a"), graph(corner(x=8.0), "b")]
    errors = trajectory_errors(estimate, truth, align=None, delta_metres=2.0)
    assert repr(errors).splitlines() == [
        "TrajectoryErrors(2 robots, 8 of 8 poses matched, align=None)",
        "  ATE 0.7071 m, 0 deg (RMSE)",
        "  RPE 0 m, 0 deg (RMSE) over 2 m",
    ]
    told = json.loads(json.dumps(errors.as_dict()))
    assert told["robots_matched_by"] == "name"
    assert (told["align"], told["delta"], told["delta_metres"]) == (None, None, 2.0)
    assert told["robots"][1]["absolute"]["translation"]["mean"] == 1.0
    assert told["all"]["absolute"]["count"] == 8
    assert set(told["robots"][0]) == {
        *("robot", "true_robot", "poses", "matched_by", "absolute", "relative")
    }


def test_a_robot_too_short_for_a_step_has_no_relative_error():
    short = graph(lie.take(corner(x=8.0), np.arange(2)), "b")
    errors = trajectory_errors(
        [graph(corner(), "a"), short], [graph(corner(), "a"), short], delta=2
    )
    assert [one.relative.count for one in errors.robots] == [1, 0]
    assert np.isnan(errors.robots[1].relative.translation).all()
    assert errors.relative.count == 1


ONE = graph(corner(), "a")
TIMED = dataclasses.replace(ONE, stamps=np.arange(4.0))
LATER = dataclasses.replace(ONE, stamps=np.arange(4.0) + 0.5)
OTHER_IDS = dataclasses.replace(ONE, ids=np.arange(10, 14))
LINE = graph(lie.exp(jaxlie.SE3, np.arange(4.0)[:, None] * [1, 0, 0, 0, 0, 0]))
POINT = graph(lie.take(corner(), np.zeros(3, int)))


@pytest.mark.parametrize(
    ("estimate", "truth", "options", "message"),
    [
        (ONE, OTHER_IDS, {}, "'a' matches one of 'a', ids 0 to 3 against 10 to 13; expected equal"),
        (TIMED, LATER, {}, "stamps 0.0 to 3.0 against 0.5 to 3.5; expected stamps within 0.01 s"),
        ([ONE, graph(corner(), "b")], ONE, {}, r"1 robot \(a\) given, expected 2 robots \(a, b\)"),
        ([ONE, graph(corner(), "b")], [ONE, graph(corner(), "c")], {}, r"\(a, c\) given"),
        (graph(noisy(LINE.poses, 0)), ONE, {}, "estimate: SE3 poses that leave the plane given"),
        (LINE, LINE, {}, "positions of a lie on one line, which leaves the rotation open"),
        (POINT, POINT, {"align": "each"}, "positions of a lie on one point"),
        (corner(), ONE, {}, "estimate: SE2 given, expected pose graphs"),
        (ONE, ONE, {"align": "first"}, "align: 'first' given, expected one of joint, each, None"),
        (ONE, ONE, {"delta": 0}, "delta: 0 given, expected an integer of at least 1"),
        (ONE, ONE, {"delta": 1.5}, "delta: 1.5 given, expected an integer"),
        (ONE, None, {}, "truth: NoneType given, expected pose graphs"),
        (ONE, ONE, {"delta": 4}, "delta: 4 given, expected a step that some robot is longer than"),
        (ONE, ONE, {"delta_metres": 9.0}, "delta_metres: 9 given, expected a step"),
        (
            ONE,
            ONE,
            {"delta_metres": 0.0},
            "delta_metres: 0.0 given, expected a number of at least 1e-09",
        ),
        (
            ONE,
            ONE,
            {"max_difference": -1},
            "max_difference: -1 given, expected a number of at least 0",
        ),
    ],
)
def test_bad_input(estimate, truth, options, message):
    with pytest.raises(InputError, match=message):
        trajectory_errors(estimate, truth, **options)
