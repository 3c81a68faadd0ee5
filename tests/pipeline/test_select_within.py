"""`select_within` and `clean_maps`, on simulated and real maps of one robot."""

import dataclasses
import lzma
import math

import jax
import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.consistency import chi2_gate, odometry_edges
from pcm_jax.errors import InputError
from pcm_jax.files import read_graph
from pcm_jax.graph import MultiRobotGraph, PoseGraph
from pcm_jax.pipeline import clean_maps, select_within
from pcm_jax.selection import select_from
from pcm_jax.simulation import simulate_city

POSES, RANDOM, ALIASED = 200, 30, 200


def with_false_closures(graph, seed=0):
    """The map with random closures, and a larger group of false ones that agree: one wrong motion.

    Returns it with which of its edges are right. Edges lie in random order.
    """
    rng = np.random.default_rng(seed)
    poses = lie.as_numpy(graph.poses)
    ends = np.sort(rng.choice(np.argwhere(np.triu(np.ones((POSES, POSES)), 20)), RANDOM + ALIASED))
    tail, head = ends.T
    true = lie.between(lie.take(poses, tail), lie.take(poses, head))
    random = lie.exp(jaxlie.SE2, rng.uniform(-3.0, 3.0, (RANDOM, 3)))
    wrong = lie.exp(jaxlie.SE2, np.array([2.0, -3.0, 0.5]))
    start, end = (lie.take(poses, index[RANDOM:]) for index in (tail, head))
    aliased = lie.between(start, lie.compose(wrong, end))
    false = lie.concatenate([random, aliased])
    assert np.abs(lie.log(lie.between(true, false))).max(axis=1).min() > 0.1
    count = graph.num_edges
    order = rng.permutation(count + RANDOM + ALIASED)
    information = np.asarray(graph.information)
    dirty = PoseGraph.from_arrays(
        poses=graph.poses,
        tail=np.append(graph.tail, tail)[order],
        head=np.append(graph.head, head)[order],
        measurement=lie.take(lie.concatenate([lie.as_numpy(graph.measurement), false]), order),
        information=np.concatenate([information, information[: len(tail)]])[order],
        ids=graph.ids,
        name="carol",
        source=[f"edge {index}" for index in order],
    )
    return dirty, order < count


@pytest.fixture(scope="module")
def clean():
    return simulate_city(seed=3, poses=POSES).graph.maps[0]


@pytest.fixture(scope="module")
def odometry_alone(clean):
    return select_within(clean, minimum_inliers=clean.num_edges).graph


@pytest.fixture(scope="module")
def dirty(clean):
    return with_false_closures(clean)


@pytest.fixture(scope="module")
def selection(dirty):
    return select_within(dirty[0])


def test_false_closures_are_rejected_however_many_agree(clean, dirty, selection):
    _, right = dirty
    loops = clean.num_edges - (POSES - 1)
    assert 100 < loops < ALIASED
    assert not selection.kept[~right].any()
    assert selection.kept[right].mean() > 0.95
    assert selection.optimal
    assert selection.upper_bound == (selection.accepted & ~selection.recalled).sum()


def test_what_the_largest_set_leaves_out_comes_back(dirty, selection):
    graph, right = dirty
    largest = select_within(graph, recall=False)
    assert not largest.recalled.any()
    np.testing.assert_array_equal(selection.accepted, largest.accepted | selection.recalled)
    assert selection.recalled.any()
    assert right[selection.closures[selection.recalled]].all()
    assert "recall" in repr(selection)
    with pytest.raises(InputError, match="recall: 1, expected True, False or None"):
        select_within(graph, recall=1)  # type: ignore[arg-type]


def test_without_odometrys_word_the_largest_group_wins(dirty):
    graph, right = dirty
    fooled = select_within(graph, own_loop=False)
    assert not right[fooled.closures[fooled.accepted]].any()
    assert fooled.accepted.sum() > 0.9 * ALIASED


def test_odometry_is_one_edge_a_step_and_stays(dirty, selection):
    graph, _ = dirty
    tail, head = np.asarray(graph.tail), np.asarray(graph.head)
    steps = np.minimum(tail, head)[selection.odometry]
    assert sorted(steps) == list(range(POSES - 1))
    assert (np.abs(tail - head)[selection.odometry] == 1).all()
    assert selection.kept[selection.odometry].all()


def test_the_parts_fit_together(selection):
    np.testing.assert_array_equal(np.flatnonzero(~selection.odometry), selection.closures)
    np.testing.assert_array_equal(selection.kept[selection.closures], selection.accepted)
    assert selection.gate == float(chi2_gate(0.99, 3))
    own = np.flatnonzero(selection.own_squared <= selection.gate)
    chosen = select_from(selection.squared[np.ix_(own, own)], selection.gate)
    largest = selection.accepted & ~selection.recalled
    np.testing.assert_array_equal(np.flatnonzero(largest), own[chosen])
    assert list(selection.seconds) == ["consistency", "clique", "chance", "recall"]
    assert all(seconds > 0 for seconds in selection.seconds.values())


def test_the_cleaned_map(dirty, selection):
    graph, _ = dirty
    kept = selection.graph
    assert (kept.name, kept.num_poses) == ("carol", POSES)
    np.testing.assert_array_equal(kept.ids, graph.ids)
    assert kept.source.tolist() == graph.source[selection.kept].tolist()
    assert kept.source[0].startswith("edge ")
    for field in ("tail", "head", "information"):
        expected = np.asarray(getattr(graph, field))[selection.kept]
        np.testing.assert_array_equal(getattr(kept, field), expected)
    again = select_within(kept)
    assert again.kept.all()


def test_too_few_inliers_are_none(dirty, selection):
    size = selection.upper_bound
    assert select_within(dirty[0], minimum_inliers=size).accepted.sum() == size
    strict = select_within(dirty[0], minimum_inliers=size + 1)
    assert not strict.accepted.any()
    assert strict.upper_bound == size
    np.testing.assert_array_equal(strict.kept, strict.odometry)


def test_other_methods_by_name(dirty, selection):
    graph, right = dirty
    for method in ("pcm-heuristic", "ransac", "scgp"):
        other = select_within(graph, method=method)
        assert not other.kept[~right].any()
        assert (other.optimal is None) == (method != "pcm-heuristic")


def test_a_time_limit_is_reported(dirty):
    assert select_within(dirty[0], time_limit=math.inf).optimal
    hurried = select_within(dirty[0], confidence=0.5, time_limit=0.0)
    assert hurried.accepted.sum() <= hurried.upper_bound
    assert not hurried.optimal


def test_no_closures(odometry_alone):
    nothing = select_within(odometry_alone)
    assert nothing.kept.all()
    assert nothing.squared.shape == (0, 0)
    assert (nothing.optimal, nothing.upper_bound) == (True, 0)


def test_bad_arguments_are_named(dirty):
    for options, message in (
        ({"method": "guess"}, "method: 'guess'"),
        ({"confidence": 1.5}, "confidence: 1.5"),
        ({"minimum_inliers": -1}, "minimum_inliers: -1"),
        ({"method": "ransac", "time_limit": 1.0}, "time_limit: not an option"),
    ):
        with pytest.raises(InputError, match=message):
            select_within(dirty[0], **options)


def test_cleaning_all_maps(dirty, odometry_alone, selection):
    graph = MultiRobotGraph((dirty[0], odometry_alone))
    graph, selections = clean_maps(graph, minimum_inliers=3)
    assert graph.maps[1] is odometry_alone
    assert selections[1] is None
    largest = selection.kept.copy()
    largest[selection.closures[selection.recalled]] = False
    np.testing.assert_array_equal(selections[0].kept, largest)
    assert [one.num_edges for one in graph.maps] == [largest.sum(), POSES - 1]


def test_a_broken_chain_is_named_before_any_work(dirty, monkeypatch):
    looped = PoseGraph.from_arrays(
        tail=[0, 0, 1, 2],
        head=[1, 2, 3, 3],
        measurement=lie.identity(jaxlie.SE2, (4,)),
        information=np.tile(np.eye(3), (4, 1, 1)),
        name="dave",
    )
    monkeypatch.setattr("pcm_jax.pipeline.within.select_within", pytest.fail)
    with pytest.raises(InputError, match="map 'dave': no edge joins poses dave:1 and dave:2"):
        clean_maps(MultiRobotGraph((dirty[0], looped)))


def test_without_64_bit_types(dirty, selection):
    with jax.enable_x64(False):
        narrow = select_within(dirty[0])
    assert narrow.squared.dtype == np.float64
    np.testing.assert_array_equal(narrow.squared, selection.squared)


def test_kitti_00(shared_data):
    """Visual odometry and real candidates of place recognition, 217 of 337 false."""
    folder = shared_data / "kitti_robust" / "00"
    graph = read_graph(folder / "kitti_00_alpha_0.50.g2o.xz").maps[0]
    with lzma.open(folder / "kitti_00_alpha_0.50_GT_LC.txt.xz", "rt") as lines:
        true = {tuple(sorted(map(int, line.split()))) for line in lines if line.strip()}
    selection = select_within(graph)
    ends = np.sort(graph.ids[np.stack([graph.tail, graph.head])], axis=0)[:, selection.closures]
    right = np.array([pair in true for pair in zip(*ends.tolist(), strict=True)])
    assert (right.sum(), len(right)) == (120, 337)
    np.testing.assert_array_equal(selection.accepted, right)
    assert selection.optimal


@pytest.fixture(scope="module", params=[5.0, 15.0])
def too_sure(request, dirty):
    """The same map, odometry's standard deviations stated too small, without the aliased group."""
    graph, right = dirty
    edges = np.array([int(text.split()[1]) for text in graph.source])
    graph = graph.with_edges(edges < right.sum() + RANDOM)
    right = right[edges < right.sum() + RANDOM]
    information = np.array(graph.information)
    information[odometry_edges(graph)] *= request.param**2
    return dataclasses.replace(graph, information=information), right, request.param


def test_odometry_that_is_too_sure_is_found_out(too_sure):
    graph, right, factor = too_sure
    found = select_within(graph)
    assert 0.6 < found.odometry_scale / factor < 1.6
    assert not found.kept[~right].any()
    assert found.kept[right].mean() > 0.85
    assert found.graph.num_edges == found.kept.sum()
    np.testing.assert_array_equal(found.graph.information, graph.information[found.kept])
    assert f"were its errors {found.odometry_scale:.3g} times those stated" in found.verdict.why


def test_the_scale_can_be_given(too_sure):
    graph, right, factor = too_sure
    given = select_within(graph, odometry_scale=factor)
    assert given.odometry_scale == factor
    assert given.kept[right].mean() > 0.85
    stated = select_within(graph, odometry_scale=1.0, minimum_inliers=20)
    assert not stated.accepted.any()
    assert ("everything contradicts odometry" in stated.verdict.why) == (factor == 15.0)


def test_a_group_of_false_closures_is_no_scale(dirty, selection):
    """200 that say the same wrong motion would agree with odometry five times as bad."""
    assert selection.odometry_scale == 1.0
    assert "as stated" in selection.verdict.why


def test_numbers_that_cannot_be_meant(dirty):
    for options, message in (
        ({"odometry_scale": 0.0}, "odometry_scale: 0.0, expected a factor above 0"),
        ({"significance": 1.0}, "significance: 1.0, expected"),
        ({"separation": -1.0}, "separation: -1.0, expected metres"),
        ({"minimum_inliers": "luck"}, "minimum_inliers: 'luck'"),
        ({"minimum_inliers": 2, "significance": 0.1}, "significance: 0.1 given with"),
    ):
        with pytest.raises(InputError, match=message):
            select_within(dirty[0], **options)
