"""Usual mistakes, made on purpose, are named; right data and clutter are not."""

import dataclasses
import functools

import numpy as np
import pytest

from pcm_jax import MultiRobotGraph, chi2_gate, lie, maximum_clique, weigh
from pcm_jax.integrity import triage
from pcm_jax.integrity._loops import Loops
from pcm_jax.integrity._mistakes import mistakes
from pcm_jax.integrity._screen import Screen, at_most
from pcm_jax.simulation import simulate_city, simulate_sessions

SIMULATED = {"SE2": simulate_city, "SE3": simulate_sessions}
SEEDS = {"SE2": 1, "SE3": 3}


@functools.cache
def world(group):
    graph = SIMULATED[group](
        seed=SEEDS[group], poses=80, inliers=20, aliased_groups=0, random=2
    ).graph
    return weigh(graph).optimized


def of(group, closures=None, **changes):
    graph = world(group)
    closures = graph.closures if closures is None else closures
    written = dataclasses.replace(closures, **changes)
    evidence = weigh(MultiRobotGraph(graph.maps, written), optimized=True)
    return triage(evidence, float(chi2_gate(0.99, graph.tangent_dim)))


def values_of(group):
    closures = world(group).closures
    return closures, np.array(lie.parameters(closures.measurement))


both_groups = pytest.mark.parametrize("group", ["SE2", "SE3"])


def explained(found, name):
    assert found is not None
    assert name in (found.mistake, *found.also)
    assert found.of == 22
    assert found.agreeing >= 17 > 2 * found.as_read
    assert found.sentence.startswith(f"{found.mistake}: {found.agreeing} of 22 closures agree if ")


@both_groups
def test_right_closures_are_left_alone(group):
    assert of(group) is None


@both_groups
def test_inverted(group):
    closures = world(group).closures
    found = of(group, measurement=lie.inverse(closures.measurement))
    explained(found, "inverted")
    assert found.mistake == "inverted"


def test_robots_swapped():
    closures = world("SE2").closures
    found = of("SE2", robot_a=closures.robot_b, robot_b=closures.robot_a)
    explained(found, "robots swapped")


@both_groups
def test_ids_swapped(group):
    closures = world(group).closures
    explained(of(group, pose_a=closures.pose_b, pose_b=closures.pose_a), "ids swapped")


@pytest.mark.parametrize(("roll", "words"), [(1, "written w x y z"), (-1, "written x y z w")])
def test_quaternion_order(roll, words):
    """What is written w x y z and read x y z w has its w where z belongs."""
    closures, values = values_of("SE3")
    values[:, :4] = np.roll(values[:, :4], roll, axis=1)
    found = of("SE3", measurement=closures.group(values))
    explained(found, "quaternion order")
    assert words in found.sentence


@pytest.mark.parametrize(
    ("side", "by", "told"),
    [("pose_a", 1, "a's ids are meant -1"), ("pose_b", -1, "b's ids are meant +1")],
)
def test_ids_off_by_one(side, by, told, group="SE2"):
    closures = world(group).closures
    last = world(group).maps[0].num_poses - 1
    poses = np.clip(np.asarray(getattr(closures, side)) + by, 0, last).astype(np.int32)
    found = of(group, **{side: poses})
    explained(found, "ids off by one")
    assert told in found.sentence


@both_groups
def test_time_stamps_shifted(group):
    closures = world(group).closures
    poses = np.maximum(np.asarray(closures.pose_b) - 4, 0).astype(np.int32)
    found = of(group, pose_b=poses)
    explained(found, "shifted")
    assert "b's ids are meant +4 (are time stamps shifted?)" in found.sentence


def test_degrees():
    closures, values = values_of("SE2")
    degrees = np.degrees(np.arctan2(values[:, 1], values[:, 0]))
    values[:, 0], values[:, 1] = np.cos(degrees), np.sin(degrees)
    explained(of("SE2", measurement=closures.group(values)), "degrees")


def test_a_lidars_place():
    closures = world("SE2").closures
    place = lie.exp(closures.group, np.array([0.4, 0.2, 1.3]))
    found = of("SE2", measurement=between_sensors(closures, place))
    explained(found, "extrinsic left out")
    assert np.asarray(lie.log(found.extrinsic))[2] == pytest.approx(1.3, abs=0.05)


def test_a_cameras_axes():
    closures = world("SE3").closures
    axes = np.eye(4)
    axes[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    found = of("SE3", measurement=between_sensors(closures, lie.as_numpy(lie.from_matrix(axes))))
    explained(found, "extrinsic left out")


def between_sensors(closures, place):
    return lie.compose(lie.compose(lie.inverse(place), closures.measurement), place)


@both_groups
def test_undoing_a_mistake_twice_is_doing_nothing(group):
    """Those that are their own inverse, by the names of their ends and by the information too."""
    graph = world(group)
    given, _ = graph.closures.between(0, 1)
    ones = {one.name: one for one in mistakes(graph.group)}
    twice = ["inverted", "robots swapped", "ids swapped", "rotation inverted"]
    for name in [*twice, "tangent order"] if group == "SE3" else twice:
        undo = ones[name].undo
        again = undo(graph.maps, undo(graph.maps, given))
        np.testing.assert_array_equal(again.pose_a, given.pose_a)
        np.testing.assert_array_equal(again.pose_b, given.pose_b)
        np.testing.assert_allclose(
            lie.parameters(again.measurement), lie.parameters(given.measurement), atol=1e-12
        )
        np.testing.assert_allclose(again.information, given.information, atol=1e-8)


@both_groups
def test_tangent_order_is_put_right(group):
    """Information with rotation first, by names of its entries."""
    graph = world(group)
    given, _ = graph.closures.between(0, 1)
    names = ["r", "x", "y"] if group == "SE2" else ["rx", "ry", "rz", "x", "y", "z"]
    meant = ["x", "y", "r"] if group == "SE2" else ["x", "y", "z", "rx", "ry", "rz"]
    entry = {name: float(k + 1) for k, name in enumerate(sorted(names))}
    written = np.diag([entry[name] for name in names])
    closures = dataclasses.replace(given, information=np.tile(written, (len(given), 1, 1)))
    (one,) = (one for one in mistakes(graph.group) if one.name == "tangent order")
    undone = one.undo(graph.maps, closures).information[0]
    np.testing.assert_array_equal(np.diagonal(undone), [entry[name] for name in meant])


@pytest.mark.parametrize("seed", range(4))
def test_clutter_is_no_mistake(seed):
    """No right closure, or few among many false ones: there is nothing to say."""
    simulate = SIMULATED[("SE2", "SE3")[seed % 2]]
    graph = simulate(
        seed=seed, poses=40, inliers=(0, 3)[seed // 2], aliased_groups=1, aliased_size=4, random=12
    ).graph
    evidence = weigh(graph)
    assert triage(evidence, float(chi2_gate(0.99, graph.tangent_dim))) is None


@both_groups
def test_a_screen_weighs_readings_of_the_same_poses_as_their_loops_do(group):
    evidence = weigh(world(group), optimized=True)
    (pair,) = evidence.pairs
    closures = dataclasses.replace(pair.measured, weight=np.arange(22.0))
    screen, gate = Screen(pair.covariances, closures), float(chi2_gate(0.99, evidence.tangent_dim))
    known = {one.name: one.undo(pair.maps, closures) for one in mistakes(evidence.graph.group)}
    readings = [closures, known["inverted"], known["rotation inverted"], known["tangent order"]]
    rows = np.arange(22)
    for reading, graph in zip(
        readings, screen.agreeing([(one, rows) for one in readings], gate), strict=True
    ):
        exact = Loops(pair.covariances, reading).squared(rows, rows) <= gate
        np.testing.assert_array_equal(graph, exact & ~np.eye(22, dtype=bool))


@both_groups
def test_a_screen_misses_nothing_where_poses_are_a_few_steps_on(group):
    evidence = weigh(world(group), optimized=True)
    (pair,) = evidence.pairs
    closures = dataclasses.replace(pair.measured, weight=np.arange(22.0))
    screen, gate = Screen(pair.covariances, closures), float(chi2_gate(0.99, evidence.tangent_dim))
    readings = [one.undo(pair.maps, closures) for one in mistakes(evidence.graph.group)]
    kept = [np.asarray(one.weight).astype(int) for one in readings]
    graphs = screen.agreeing(list(zip(readings, kept, strict=True)), gate)
    for reading, rows, graph in zip(readings, kept, graphs, strict=True):
        if len(rows) and not screen.touches_the_same(reading):
            every = np.arange(len(rows))
            exact = Loops(pair.covariances, reading).squared(every, every) <= gate
            assert not (exact & ~graph & ~np.eye(len(rows), dtype=bool)).any()


def test_no_set_is_larger_than_its_bound():
    generator = np.random.default_rng(0)
    for _ in range(100):
        size = int(generator.integers(1, 14))
        graph = np.triu(generator.random((size, size)) < generator.random(), 1)
        graph |= graph.T
        assert at_most(graph) >= maximum_clique(graph).size
    assert at_most(np.zeros((0, 0), bool)) == 0
    assert at_most(~np.eye(5, dtype=bool)) == 5


@pytest.mark.parametrize("seed", range(8))
def test_simulated_worlds_are_left_alone(seed):
    """With few right closures or none, aliased groups, and up to five false for a right one."""
    generator = np.random.default_rng(seed)
    right = int(generator.integers(0, 11))
    clutter = {
        "random": int(generator.integers(2, max(3, 5 * right) if right else 30)),
        "aliased_groups": int(generator.integers(0, 3)),
    }
    simulate = SIMULATED["SE3" if seed % 2 else "SE2"]
    graph = simulate(seed=seed, poses=40, inliers=right, aliased_size=4, **clutter).graph
    assert triage(weigh(graph), float(chi2_gate(0.99, graph.tangent_dim))) is None
