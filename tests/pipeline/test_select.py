"""`select` on simulated and real multi-robot graphs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pcm_jax.clique import maximum_clique
from pcm_jax.consistency import chi2_gate
from pcm_jax.errors import InputError
from pcm_jax.files import read_graph
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.pipeline import select, weigh
from pcm_jax.selection import Selection, select_from
from pcm_jax.selection.choose import choose
from pcm_jax.simulation import simulate_city


@pytest.fixture(scope="module")
def world():
    return simulate_city(seed=2, poses=120, robots=3, inliers=8, aliased_size=3, random=12)


@pytest.fixture(scope="module")
def selection(world) -> Selection:
    return select(world.graph)


def test_true_closures_are_found_and_false_ones_are_not(world, selection):
    assert selection.accepted.shape == world.is_true.shape
    assert np.mean(selection.accepted[world.is_true]) > 0.9
    assert not selection.accepted[~world.is_true].any()


def test_pairs_report_what_was_decided(world, selection):
    assert [(p.robot_a, p.robot_b) for p in selection.pairs] == [(0, 1), (0, 2), (1, 2)]
    assert selection.gate == float(chi2_gate(0.99, 3))
    assert (selection.method, selection.confidence) == ("pcm-exact", 0.99)
    covered = np.concatenate([p.closures for p in selection.pairs])
    assert sorted(covered.tolist()) == list(range(len(world.is_true)))
    for pair in selection.pairs:
        robots = np.asarray(world.graph.closures.robot_a), np.asarray(world.graph.closures.robot_b)
        ends = {pair.robot_a, pair.robot_b}
        assert all({int(a[k]), int(b[k])} == ends for a, b in [robots] for k in pair.closures)
        np.testing.assert_array_equal(selection.accepted[pair.closures], pair.accepted)
        np.testing.assert_array_equal(select_from(pair.squared, pair.gate), pair.accepted)
        assert pair.optimal
        assert pair.upper_bound == pair.accepted.sum()


def test_every_stage_is_timed(selection):
    assert list(selection.seconds) == ["optimize", "marginals", "consistency", "clique", "chance"]
    assert all(seconds > 0 for seconds in selection.seconds.values())


def test_optimised_maps_are_not_optimised_again(world, selection):
    optimised = MultiRobotGraph(selection.maps, world.graph.closures)
    again = select(optimised, optimized=True)
    assert all(a is b for a, b in zip(again.maps, optimised.maps, strict=True))
    np.testing.assert_array_equal(again.accepted, selection.accepted)


def test_direction_and_order_of_closures_do_not_matter(world, selection):
    order = np.random.default_rng(0).permutation(len(world.is_true))
    closures = world.graph.closures[order]._flipped(np.arange(len(order)) % 2 == 0)
    turned = select(MultiRobotGraph(selection.maps, closures), optimized=True)
    np.testing.assert_array_equal(turned.accepted, selection.accepted[order])


@pytest.mark.parametrize("method", ["pcm-heuristic", "ransac", "scgp"])
def test_other_methods_by_name(world, selection, method):
    optimised = MultiRobotGraph(selection.maps, world.graph.closures)
    other = select(optimised, method=method, optimized=True)
    for mine, exact in zip(other.pairs, selection.pairs, strict=True):
        expected = select_from(exact.squared, exact.gate, method=method)
        np.testing.assert_array_equal(mine.accepted, expected)


def test_options_reach_the_method(world, selection):
    optimised = MultiRobotGraph(selection.maps, world.graph.closures)
    binary = select(optimised, method="scgp", optimized=True, affinity="binary")
    for pair in binary.pairs:
        expected = select_from(pair.squared, pair.gate, method="scgp", affinity="binary")
        np.testing.assert_array_equal(pair.accepted, expected)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["pcm-exact", "pcm-heuristic"])
def test_beyond_the_memory_limit_the_graph_is_streamed(world, selection, method):
    optimised = MultiRobotGraph(selection.maps, world.graph.closures)
    told = []
    options = {"method": method, "optimized": True, "time_limit": 60.0}
    tell = lambda *now: told.append(now)  # noqa: E731
    streamed = select(optimised, memory_limit=0, progress=tell, **options)
    dense = select(optimised, **options)
    np.testing.assert_array_equal(streamed.accepted, dense.accepted)
    for one, other in zip(streamed.pairs, dense.pairs, strict=True):
        with pytest.raises(InputError, match=r"squared: not kept .* between robots"):
            _ = one.squared
        np.testing.assert_array_equal(one.consistent(), other.consistent())
        assert (one.optimal, one.upper_bound) == (other.optimal, other.upper_bound)
    counts = [len(pair.closures) for pair in streamed.pairs]
    assert {stage for stage, _, _ in told} == {"consistency", "clique", "chance"}
    ends = [("consistency", m * (m - 1) // 2, m * (m - 1) // 2) for m in counts]
    assert [now for now in told if now in ends] == ends


@pytest.mark.parametrize("options", [{"tie_break": "distance"}, {"method": "ransac"}])
def test_what_needs_distances_gets_them_whatever_they_take(world, selection, options):
    optimised = MultiRobotGraph(selection.maps, world.graph.closures)
    limited = select(optimised, optimized=True, memory_limit=0, **options)
    usual = select(optimised, optimized=True, **options)
    np.testing.assert_array_equal(limited.accepted, usual.accepted)
    for one, other in zip(limited.pairs, usual.pairs, strict=True):
        np.testing.assert_array_equal(one.squared, other.squared)


@pytest.mark.parametrize("options", [{"tie_break": "distance"}, {"method": "ransac"}])
def test_of_evidence_without_distances_they_are_refused(world, selection, options):
    optimised = MultiRobotGraph(selection.maps, world.graph.closures)
    evidence = weigh(optimised, optimized=True, memory_limit=0).pairs[0]
    assert evidence.is_streamed
    with pytest.raises(InputError, match="squared: not kept for the"):
        choose(evidence, 11.3, **options)
    graph = evidence.consistent(11.3) & ~np.eye(len(evidence), dtype=bool)
    np.testing.assert_array_equal(choose(evidence, 11.3).members, maximum_clique(graph).members)


def test_too_few_inliers_are_none(world, selection):
    optimised = MultiRobotGraph(selection.maps, world.graph.closures)
    sizes = [pair.accepted.sum() for pair in selection.pairs]
    strict = select(optimised, optimized=True, minimum_inliers=max(sizes) + 1)
    assert not strict.accepted.any()
    assert [pair.upper_bound for pair in strict.pairs] == sizes
    one = MultiRobotGraph(selection.maps, world.graph.closures[np.array([0])])
    assert not select(one, optimized=True).accepted.any()
    assert select(one, optimized=True, minimum_inliers=1).accepted.all()


def test_a_graph_without_closures(selection):
    nothing = select(MultiRobotGraph(selection.maps), optimized=True)
    assert nothing.accepted.shape == (0,)
    assert nothing.pairs == ()


def test_bad_arguments_are_named_before_any_work(world):
    for options, message in (
        ({"method": "guess"}, "method: 'guess'"),
        ({"confidence": 1.5}, "confidence: 1.5"),
        ({"minimum_inliers": -1}, "minimum_inliers: -1"),
        ({"memory_limit": -1.0}, "memory_limit: -1"),
        ({"method": "ransac", "time_limit": 1.0}, "time_limit: not an option"),
    ):
        with pytest.raises(InputError, match=message):
            select(world.graph, **options)


@pytest.mark.parametrize(
    "folder", ["simulation/example_4robots", "simulation_not_in_order/example_2robots"]
)
def test_half_of_each_pair_of_the_spoiled_sets(shared_data, folder):
    spoiled = shared_data / "multirobot_rdm" / "pairwise_consistency_maximization" / "spoiled"
    graph = read_graph(*sorted((spoiled / folder).glob("*.g2o*")))
    for pair in select(graph, confidence=0.99).pairs:
        assert pair.accepted.sum() * 2 == len(pair.closures)
        assert pair.optimal


def test_selections_are_plain_frozen_data(selection):
    with pytest.raises(dataclasses.FrozenInstanceError):
        selection.gate = 0.0
