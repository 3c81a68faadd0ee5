"""Clutter added to maps whose truth is known, City10000 among them."""

import jaxlie
import numpy as np
import pytest
from scipy import stats

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.files import read_graph
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph, split
from pcm_jax.simulation import add_clutter, simulate_city
from pcm_jax.simulation.measurements import diagonal_covariance

POSES, CUT = 2_000, 1_000
# What City10000's measurements scatter by; its information says 0.14 m and 0.1 rad.
NOISE = diagonal_covariance(jaxlie.SE2, 0.02, 0.01)


@pytest.fixture(scope="module")
def clean():
    """Maps with 60 true closures, every one with an information of its own, and the truth."""
    world = simulate_city(seed=0, poses=500, inliers=60, aliased_groups=0, random=0)
    closures = world.graph.closures
    scale = np.linspace(1.0, 2.0, len(closures))[:, None, None]
    closures = LoopClosures.from_arrays(
        robot_a=closures.robot_a,
        pose_a=closures.pose_a,
        robot_b=closures.robot_b,
        pose_b=closures.pose_b,
        measurement=closures.measurement,
        information=scale * np.asarray(closures.information),
        source=[f"line {k}" for k in range(60)],
    )
    return MultiRobotGraph(world.graph.maps, closures), world.truth


@pytest.fixture(scope="module")
def city10000(shared_data):
    """The first 2,000 poses cut in two robots, and their true poses."""
    folder = shared_data / "city10000"
    graph = read_graph(folder / "city10000.isam.txt.xz").maps[0]
    rows = np.flatnonzero((np.asarray(graph.tail) < POSES) & (np.asarray(graph.head) < POSES))
    portion = PoseGraph.from_arrays(
        tail=np.asarray(graph.tail)[rows],
        head=np.asarray(graph.head)[rows],
        measurement=lie.take(lie.as_numpy(graph.measurement), rows),
        information=np.asarray(graph.information)[rows],
    )
    truth = read_graph(folder / "city10000_groundtruth.isam.txt.xz").maps[0].poses
    truth = lie.as_numpy(truth)
    return split(portion, CUT), (
        lie.take(truth, np.s_[:CUT]),
        lie.take(truth, np.s_[CUT:POSES]),
    )


def errors(graph, truth):
    """Logarithms of `true⁻¹ measured` of every closure `[m, d]`."""
    closures = graph.closures
    at_a = lie.take(truth[0], np.asarray(closures.pose_a))
    at_b = lie.take(truth[1], np.asarray(closures.pose_b))
    return lie.log(lie.between(lie.between(at_a, at_b), lie.as_numpy(closures.measurement)))


def rows_of(graph):
    closures = graph.closures
    values = [closures.pose_a, closures.pose_b, *lie.components(lie.as_numpy(closures.measurement))]
    return {tuple(np.asarray(row).round(12)) for row in np.stack(values, axis=-1)}


def test_kept_closures_are_true_ones_as_they_were(clean):
    graph, truth = clean
    world = add_clutter(graph, truth, seed=1, inliers=15)
    kept = MultiRobotGraph(graph.maps, world.graph.closures[world.is_true])
    assert rows_of(kept) < rows_of(graph)
    original = dict(zip(graph.closures.source, np.asarray(graph.closures.information), strict=True))
    for source, information in zip(
        kept.closures.source, np.asarray(kept.closures.information), strict=True
    ):
        assert np.array_equal(original[source], information)
    assert (world.graph.closures[~world.is_true].source == "").all()


def test_the_counts_are_those_of_the_paper_by_default(clean):
    world = add_clutter(*clean, seed=1)
    labels, counts = np.unique(world.labels, return_counts=True)
    assert labels.tolist() == [-1, 0, 1, 2]
    assert counts.tolist() == [90, 15, 5, 5]
    assert add_clutter(*clean, seed=1, inliers=None).is_true.sum() == 60


def test_maps_and_truth_are_left_alone(clean):
    graph, truth = clean
    world = add_clutter(graph, truth, seed=1)
    assert all(a is b for a, b in zip(world.graph.maps, graph.maps, strict=True))
    for given, kept in zip(truth, world.truth, strict=True):
        assert np.array_equal(lie.parameters(given), lie.parameters(kept))


def test_false_closures_carry_the_information_of_true_ones(clean):
    graph, truth = clean
    known = {information.tobytes() for information in np.asarray(graph.closures.information)}
    world = add_clutter(graph, truth, seed=2)
    false = np.asarray(world.graph.closures[~world.is_true].information)
    assert {information.tobytes() for information in false} <= known
    assert len(np.unique(false, axis=0)) > 30


def test_closures_stored_backwards_are_turned_round(clean):
    graph, truth = clean
    closures = graph.closures
    backwards = LoopClosures.from_arrays(
        robot_a=closures.robot_b,
        pose_a=closures.pose_b,
        robot_b=closures.robot_a,
        pose_b=closures.pose_a,
        measurement=lie.inverse(lie.as_numpy(closures.measurement)),
        information=closures.information,
    )
    world = add_clutter(MultiRobotGraph(graph.maps, backwards), truth, seed=1, inliers=None)
    assert np.abs(errors(world.graph, truth)[world.is_true]).max() < 0.1
    assert (np.asarray(world.graph.closures.robot_a) == 0).all()


def test_pairs_without_closures_get_no_clutter_unless_information_is_given(clean):
    graph, truth = clean
    third = simulate_city(seed=9, poses=50, robots=1)
    maps, poses = (*graph.maps, third.graph.maps[0]), (*truth, third.truth[0])
    larger = MultiRobotGraph(maps, graph.closures)
    assert add_clutter(larger, poses).graph.closures.pairs() == [(0, 1)]
    given = add_clutter(larger, poses, inliers=None, information=np.eye(3))
    assert given.graph.closures.pairs() == [(0, 1), (0, 2), (1, 2)]
    false = given.graph.closures[~given.is_true]
    assert np.array_equal(false.information, np.broadcast_to(np.eye(3), (300, 3, 3)))


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"inliers": 61}, "inliers.*60"),
        ({"inliers": -1}, "inliers"),
        ({"random": -1}, "random"),
        ({"aliased_groups": -1}, "aliased_groups"),
    ],
)
def test_impossible_numbers_are_refused_by_name(clean, wrong, name):
    with pytest.raises(InputError, match=name):
        add_clutter(*clean, **wrong)


def test_a_truth_of_another_length_is_refused(clean):
    graph, truth = clean
    with pytest.raises(InputError, match=r"truth: \[500\] .* \[500, 500\]"):
        add_clutter(graph, truth[:1])


def test_city10000_cut_in_two_has_true_closures_only(city10000):
    graph, truth = city10000
    white = errors(graph, truth) / np.sqrt(np.diag(NOISE))
    squared = np.sum(white**2, axis=1)
    assert len(squared) > 300
    assert stats.kstest(squared, "chi2", (3,)).pvalue > 0.01


def test_aliased_closures_in_city10000_are_as_good_as_its_measurements_are(city10000):
    graph, truth = city10000
    settings = {"inliers": 0, "aliased_groups": 1, "aliased_size": 200, "random": 0}
    spreads = {}
    for name, covariance in {"measured": NOISE, "as written": None}.items():
        world = add_clutter(graph, truth, seed=3, covariance=covariance, **settings)
        closures = world.graph.closures
        at_a = lie.take(truth[0], np.asarray(closures.pose_a))
        at_b = lie.take(truth[1], np.asarray(closures.pose_b))
        placed = lie.compose(at_a, lie.as_numpy(closures.measurement))
        # All members claim one displacement W of map b; its heading is that of the noise alone.
        heading = lie.log(lie.compose(placed, lie.inverse(at_b)))[:, 2]
        spreads[name] = np.std(np.unwrap(np.sort(heading)))
    assert spreads["measured"] == pytest.approx(0.01, rel=0.15)
    assert spreads["as written"] == pytest.approx(0.1, rel=0.15)
