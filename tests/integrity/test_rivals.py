"""Sets that imply another alignment."""

import numpy as np
import pytest
from integrity_worlds import evidence_of

from pcm_jax import LoopClosures, chi2_gate, lie, merge, select
from pcm_jax.integrity import Places, places_of, strongest_rival
from pcm_jax.integrity.rivals import _countings, _nearly_as_large
from pcm_jax.simulation import simulate_city

GATE = float(chi2_gate(0.99, 3))


def with_runs(world, *, right, wrong):
    """The world's graph with a run of right closures, and one of wrong ones that agree."""
    a, b = (lie.as_numpy(poses) for poses in world.truth)
    near, far = np.arange(20, 20 + right), np.arange(80, 80 + wrong)
    moved = a.__class__(np.array([np.cos(0.5), np.sin(0.5), 30.0, 20.0]))
    runs = [
        lie.between(lie.take(a, near), lie.take(b, near)),
        lie.between(lie.take(a, far), lie.compose(moved, lie.take(b, far - 40))),
    ]
    count = right + wrong
    added = LoopClosures.from_arrays(
        robot_a=np.zeros(count, int),
        pose_a=np.concatenate([near, far]),
        robot_b=np.ones(count, int),
        pose_b=np.concatenate([near, far - 40]),
        measurement=lie.concatenate(runs),
        information=np.repeat(np.asarray(world.graph.closures.information)[:1], count, axis=0),
    )
    closures = LoopClosures.concatenate([world.graph.closures, added])
    is_true = np.concatenate([world.is_true, np.arange(count) < right])
    return type(world.graph)(world.graph.maps, closures), is_true


def test_two_equal_aliased_groups_are_never_merged():
    _, world = evidence_of("SE2", 4, 0, 30, 2, 8)
    (pair,) = select(world.graph).pairs
    assert pair.verdict.ambiguous
    assert not pair.accepted.any()
    rival = pair.verdict.rival
    assert rival.size >= 7
    assert len(np.unique(world.labels[rival.members])) == 1  # one of the two groups
    assert rival.shared == 0
    assert "AMBIGUOUS" in pair.verdict.why


def test_a_set_is_beaten_by_nearly_as_many_whatever_chance_says():
    members, rival = np.arange(20) < 8, np.arange(20) >= 13
    assert _nearly_as_large(members, rival)  # 7 of 8
    assert not _nearly_as_large(members, np.arange(20) >= 14)  # 6 of 8


def test_unless_the_larger_is_asked_for():
    _, world = evidence_of("SE2", 4, 0, 30, 2, 8)
    result = merge(world.graph, on_ambiguous="largest")
    assert result.accepted.sum() >= 8
    assert result.ambiguous
    (row,) = result.report()["robot_pairs"]
    assert row["ambiguous"] and row["rival"]["size"] >= 7
    assert list(row["rival"]["alignment"]) == ["x", "y", "theta"]


def test_a_smaller_group_is_told_but_no_reason_to_doubt():
    pair, world = evidence_of("SE2", 0, 15, 40, 2, 5)
    places = places_of(pair, 0.0)
    rival = strongest_rival(pair, GATE, places, world.is_true)
    assert rival.size in (5, 6)
    assert not rival.ambiguous
    assert select(world.graph).accepted.sum() == 15


def test_closures_left_out_of_the_same_alignment_are_no_rival():
    """Half of the right ones against the other half: near misses, whatever the members."""
    pair, world = evidence_of("SE2", 0, 15, 40)
    half = world.is_true & (np.cumsum(world.is_true) <= 8)
    rival = strongest_rival(pair, GATE, places_of(pair, 0.0), half)
    assert rival is None or not (rival.members & world.is_true).any()


def counted_by(way, members, rival, longer=800.0):
    """The separations at which a rival's witnesses are worth a test."""
    return [one.separation for one in _countings(Places(way, way, 0.0), members, rival, longer)]


def test_a_set_in_one_stretch_is_worth_no_more_than_a_rival_in_another():
    """Twenty closures within 17 m against eight within 10 m: a corridor taken for another?"""
    way = np.concatenate([np.linspace(0, 17, 20), np.linspace(500, 510, 8)])
    members = np.arange(28) < 20
    assert counted_by(way, members, ~members) == [0.0]
    assert counted_by(way, members, np.arange(28) >= 22) == []  # six of them, against twenty
    assert counted_by(way, members, ~members, longer=150.0) == []  # a good part of the way
    far = np.concatenate([np.linspace(0, 17, 20), [500, 501, 600, 700, 710, 720, 730]])
    members = np.arange(27) < 20
    assert counted_by(far, members, ~members) == [0.0]  # all the more so
    long = np.concatenate([np.linspace(0, 50, 20), np.linspace(500, 510, 8)])
    members = np.arange(28) < 20
    assert counted_by(long, members, ~members) == []  # five stretches as long as the rival
    spread = np.arange(0.0, 54.0, 2.0)
    assert counted_by(spread, np.arange(27) < 12, np.arange(27) >= 20, 0.0) == [0.0]  # 7 of 12


def test_a_corridor_taken_for_another():
    """A run of wrong closures outvotes right ones in a shorter stretch: neither is merged."""
    world = simulate_city(seed=3, poses=300, inliers=0, aliased_groups=0, random=40)
    graph, is_true = with_runs(world, right=12, wrong=20)
    (pair,) = select(graph, minimum_inliers=2).pairs
    assert pair.accepted.sum() >= 20 and not is_true[pair.accepted].any()
    (pair,) = select(graph).pairs
    assert pair.verdict.ambiguous and not pair.accepted.any()
    assert is_true[pair.verdict.rival.members].sum() >= 11
    (pair,) = select(type(graph)(graph.maps, graph.closures[~is_true])).pairs
    assert not pair.verdict.ambiguous  # nothing beyond chance speaks against it


def test_the_larger_of_two_is_that_at_more_places_unless_closures_are_preferred():
    """Twenty wrong closures in one corridor; twelve right ones, half of them elsewhere."""
    world = simulate_city(seed=3, poses=300, inliers=6, aliased_groups=0, random=40)
    graph, is_true = with_runs(world, right=6, wrong=20)
    asked = {"on_ambiguous": "largest", "separation": 5.0}
    (by_closures,) = select(graph, prefer="closures", **asked).pairs
    assert by_closures.accepted.sum() >= 20 and by_closures.optimal
    assert not is_true[by_closures.accepted].any()
    assert by_closures.verdict.ambiguous
    (pair,) = select(graph, **asked).pairs
    assert pair.accepted.sum() >= 11 and is_true[pair.accepted].all()
    assert pair.verdict.places > by_closures.verdict.places
    assert pair.verdict.ambiguous and pair.verdict.rival.size >= 20  # which is said
    assert pair.optimal is False and pair.upper_bound >= 20
    paper = select(graph, minimum_inliers=2, prefer="closures")
    np.testing.assert_array_equal(paper.accepted, by_closures.accepted)
    assert not select(graph, prefer="places").accepted.any()  # neither, by default


def test_nothing_else_agrees():
    pair, _ = evidence_of("SE2", 1, 3, 0)
    assert strongest_rival(pair, GATE, places_of(pair, 0.0), np.ones(3, bool)) is None


def test_another_way_to_settle_it_is_refused():
    _, world = evidence_of("SE2", 1, 3, 0)
    with pytest.raises(ValueError, match="on_ambiguous: 'both', expected one of split, largest"):
        select(world.graph, on_ambiguous="both")
