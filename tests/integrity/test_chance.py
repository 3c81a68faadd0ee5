"""The chance level, against enumeration, against the level itself, and where it must give up."""

import dataclasses
from itertools import permutations

import numpy as np
import pytest
from integrity_worlds import evidence_of

from pcm_jax import InputError, PairEvidence, chi2_gate, lie, maximum_clique
from pcm_jax.integrity import chance_level, places_of
from pcm_jax.integrity.chance import ABOUT, SHOWN

GATES = {"SE2": float(chi2_gate(0.99, 3)), "SE3": float(chi2_gate(0.99, 6))}


def level_of(pair, gate, accepted=None, separation=0.0, **options):
    return chance_level(pair, gate, places_of(pair, separation), accepted, **options)


def best(squared):
    """Size and least total of a largest set, by the slow way round."""
    clique = maximum_clique(squared > 0, tie_break=squared)
    return clique.size, squared[np.ix_(clique.members, clique.members)].sum() / 2


@pytest.mark.slow
def test_it_is_the_share_of_all_orders():
    """Seven closures: all 5040 orders are weighed, and p is the share that reaches the mark."""
    pair, _ = evidence_of("SE2", 2, 3, 4, loose=True)
    gate, count = GATES["SE2"], 7
    shuffles = pair.shuffles(gate)
    every = np.array(list(permutations(range(count))))
    found = shuffles.weigh(every)
    reached = []
    for number in range(len(every)):
        own, squared = found.of(number), np.zeros((count, count))
        squared[own.u, own.v] = squared[own.v, own.u] = own.squared
        reached.append(best(squared))
    size, total = reached[0]  # of the order as given
    exact = np.mean([n > size or (n == size and t <= ABOUT * total) for n, t in reached])
    level = level_of(pair, gate, significance=0.0125)
    assert level.places == size == 3
    assert level.least_p_value == pytest.approx(0.0125, rel=0.02)
    deviation = np.sqrt(exact / level.shuffles)
    assert abs(level.p_value - exact) < 4 * deviation + 1 / level.shuffles


@pytest.mark.parametrize("group", ["SE2", "SE3"])
def test_right_closures_stand_out(group):
    pair, _ = evidence_of(group, 0, 5, 45)
    level = level_of(pair, GATES[group])
    assert level.places >= 5
    assert level.p_value <= 0.01
    assert len(level.null) == SHOWN
    assert level.null.max() < 5


@pytest.mark.slow
@pytest.mark.parametrize("group", ["SE2", "SE3"])
def test_the_level_holds_where_no_closure_is_right(group):
    """Orders of one world are exchangeable: each as the one given. Level 0.1, so that it shows."""
    pair, _ = evidence_of(group, 5, 0, 40, loose=True)
    gate = GATES[group]
    generator = np.random.default_rng(0)
    count = 150
    rejected = 0
    for seed in range(count):
        order = generator.permutation(len(pair))
        measured = dataclasses.replace(
            pair.measured,
            measurement=lie.take(lie.as_numpy(pair.measured.measurement), order),
            information=np.asarray(pair.measured.information)[order],
        )
        world = dataclasses.replace(pair, measured=measured)
        rejected += level_of(world, gate, significance=0.1, seed=seed).p_value <= 0.1
    # Binomial of 150 at 0.1: more than 25 has a probability of 1 in 500; below half of it is room.
    assert 1 <= rejected <= 25


def test_the_same_seed_gives_the_same_p():
    pair, _ = evidence_of("SE2", 5, 0, 40, loose=True)
    first, again, other = (level_of(pair, GATES["SE2"], seed=seed) for seed in (0, 0, 1))
    assert (first.p_value, first.shuffles) == (again.p_value, again.shuffles)
    np.testing.assert_array_equal(first.null, again.null)
    assert not np.array_equal(first.null, other.null)


def test_measurements_that_are_all_the_same_do_not_stand_out():
    pair, _ = evidence_of("SE2", 0, 5, 45)
    same = lie.take(lie.as_numpy(pair.measured.measurement), np.zeros(50, int))
    measured = dataclasses.replace(pair.measured, measurement=same)
    level = level_of(dataclasses.replace(pair, measured=measured), 1e3)
    assert level.places >= 2
    assert level.p_value == 1.0


def test_too_few_closures_cannot_be_told_from_chance():
    """Of 3! orders one is the one given: p cannot be under 1/6."""
    pair, _ = evidence_of("SE2", 1, 3, 0)
    level = level_of(pair, GATES["SE2"])
    assert level.places == 3
    assert level.least_p_value >= 1 / 6
    assert level.p_value >= 1 / 6


def test_one_place_is_no_evidence():
    pair, _ = evidence_of("SE2", 0, 5, 45)
    level = level_of(pair, GATES["SE2"], separation=1e6)
    assert (level.places, level.p_value, level.shuffles) == (1, 1.0, 0)


def test_a_set_of_ones_own_is_tested_by_its_consistent_part():
    pair, world = evidence_of("SE2", 0, 5, 45)
    three = np.zeros(50, bool)
    three[np.flatnonzero(world.is_true)[:3]] = True
    three[np.flatnonzero(~world.is_true)[:4]] = True
    assert level_of(pair, GATES["SE2"], three).places in (3, 4)
    none = np.zeros(50, bool)
    assert level_of(pair, GATES["SE2"], none).p_value == 1.0


def test_of_many_closures_some_take_part(monkeypatch):
    monkeypatch.setattr("pcm_jax.integrity.chance.MOST", 30)
    pair, _ = evidence_of("SE2", 0, 5, 45)
    assert level_of(pair, GATES["SE2"]).closures == 30


@pytest.mark.parametrize("significance", [0.0, 1.0, np.nan])
def test_a_level_is_a_probability(significance):
    pair, _ = evidence_of("SE2", 0, 5, 45)
    with pytest.raises(InputError, match=r"significance: .*between 0 and 1"):
        level_of(pair, 1.0, significance=significance)


def test_distances_alone_cannot_be_shuffled():
    pair, _ = evidence_of("SE2", 0, 5, 45)
    with pytest.raises(InputError, match="distances alone"):
        chance_level(PairEvidence.from_squared(np.eye(50)), 1.0, places_of(pair, 1.0))


def test_it_says_what_it_is():
    pair, _ = evidence_of("SE2", 0, 5, 45)
    assert len(repr(level_of(pair, GATES["SE2"])).splitlines()) == 3
