"""Sets that imply another alignment."""

import numpy as np
import pytest
from integrity_worlds import evidence_of

from pcm_jax import chi2_gate, merge, select
from pcm_jax.integrity import Places, places_of, strongest_rival
from pcm_jax.integrity.rivals import _nearly_as_large, _reaches_further

GATE = float(chi2_gate(0.99, 3))


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


def test_a_set_at_one_place_must_be_better_than_one_that_reaches_far():
    way = np.concatenate([np.linspace(0, 10, 20), [0.0, 100, 200, 300, 310, 320, 330]])
    one_place, places = np.arange(27) < 20, Places(way, way, 0.0)
    assert places.count(~one_place) * 2 < places.count(one_place)
    assert _reaches_further(places, one_place, ~one_place)
    few = ~one_place & (np.arange(27) < 26)
    assert not _reaches_further(places, one_place, few)  # six of them, against twenty
    spread = np.arange(27.0)
    assert not _reaches_further(Places(spread, spread, 0.0), one_place, ~one_place)


def test_nothing_else_agrees():
    pair, _ = evidence_of("SE2", 1, 3, 0)
    assert strongest_rival(pair, GATE, places_of(pair, 0.0), np.ones(3, bool)) is None


def test_another_way_to_settle_it_is_refused():
    _, world = evidence_of("SE2", 1, 3, 0)
    with pytest.raises(ValueError, match="on_ambiguous: 'both', expected one of split, largest"):
        select(world.graph, on_ambiguous="both")
