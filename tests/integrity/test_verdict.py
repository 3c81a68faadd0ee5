"""What is believed, all pairs of robots together."""

import numpy as np
import pytest
from integrity_worlds import evidence_of

from pcm_jax import InputError, merge, select
from pcm_jax.integrity import holm
from pcm_jax.simulation import simulate_city


def test_holm_by_its_definition():
    generator = np.random.default_rng(0)
    for _ in range(100):
        p = generator.uniform(0, 0.03, generator.integers(1, 8))
        expected, left = np.zeros(len(p), bool), list(np.argsort(p))
        while left and p[left[0]] <= 0.02 / len(left):
            expected[left.pop(0)] = True
        np.testing.assert_array_equal(holm(p, 0.02), expected)


def test_a_p_value_at_its_level_passes():
    assert holm(np.array([0.01]), 0.01).all()
    assert holm(np.array([0.005, 0.01]), 0.01).all()


@pytest.mark.parametrize("seed", range(3))
def test_robots_that_never_met_are_left_apart(seed):
    world = simulate_city(
        seed=seed,
        poses=80,
        inliers=0,
        aliased_groups=0,
        random=60,
        sigma_translation=0.2,
        sigma_rotation=0.03,
    )
    assert select(world.graph, minimum_inliers=2).accepted.any()  # by the fixed rule they are not
    selection = select(world.graph)
    assert not selection.accepted.any()
    (pair,) = selection.pairs
    assert pair.found >= 2
    assert not pair.verdict.believed
    assert "chance does as well with p = " in pair.verdict.why


def test_too_few_are_said_to_be_too_few():
    _, world = evidence_of("SE2", 1, 3, 0)
    (pair,) = select(world.graph).pairs
    assert (pair.found, int(pair.accepted.sum())) == (3, 0)
    assert "cannot be told from chance" in pair.verdict.why
    assert "more closures would help" in pair.verdict.why
    assert select(world.graph, minimum_inliers=2).accepted.all()


def test_one_place_is_said_to_be_one():
    _, world = evidence_of("SE2", 0, 15, 40)
    (pair,) = select(world.graph, separation=1e6).pairs
    assert "all at one place" in pair.verdict.why
    assert pair.verdict.places == 1


def test_a_fixed_number_that_is_not_reached_is_said():
    _, world = evidence_of("SE2", 0, 15, 40)
    (pair,) = select(world.graph, minimum_inliers=20).pairs
    assert not pair.accepted.any()
    assert pair.verdict.why == "15 of 55 closures found that agree, 20 asked for"


def test_the_report_says_why():
    _, world = evidence_of("SE2", 0, 15, 40)
    (row,) = merge(world.graph).report()["robot_pairs"]
    assert (row["found"], row["places"], row["ambiguous"]) == (15, row["places"], False)
    assert row["chance"] == pytest.approx(0.01, abs=1e-4)
    assert row["joint"]["dof"] == 14 * 3
    assert row["joint"]["p"] > 1e-4
    assert row["why"].startswith("15 of 55 closures agree, at ")


def test_every_pair_of_a_team_counts():
    """The level is shared: with six pairs each must be six times as rare."""
    world = simulate_city(seed=0, poses=60, robots=4, inliers=6, aliased_groups=0, random=14)
    selection = select(world.graph)
    assert len(selection.pairs) == 6
    for pair in selection.pairs:
        assert pair.verdict.believed
        assert pair.verdict.chance.p_value <= 0.01 / 6 + 1e-12


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"minimum_inliers": "luck"}, "minimum_inliers: 'luck', expected 'chance' or a number"),
        ({"minimum_inliers": 3, "significance": 0.1}, "significance: 0.1 given with"),
        ({"minimum_inliers": 3, "seed": 1}, "seed: 1 given with minimum_inliers 3"),
        ({"minimum_inliers": 3, "on_ambiguous": "split"}, "on_ambiguous: split given with"),
        ({"prefer": "robots"}, "prefer: 'robots', expected 'places' or 'closures'"),
        ({"minimum_inliers": 3, "prefer": "places"}, "prefer: 'places', expected 'closures' with"),
        ({"significance": 0.0}, "significance: 0.0, expected"),
        ({"separation": -1.0}, "separation: -1.0, expected metres"),
    ],
)
def test_bad_options(options, message):
    _, world = evidence_of("SE2", 0, 15, 40)
    with pytest.raises(InputError, match=message):
        select(world.graph, **options)


def test_robust_methods_have_a_number():
    _, world = evidence_of("SE2", 0, 15, 40)
    with pytest.raises(InputError, match="minimum_inliers: 'chance' given with method 'dcs'"):
        merge(world.graph, method="dcs", minimum_inliers="chance")
    with pytest.raises(InputError, match="significance: not an option of method 'dcs'"):
        merge(world.graph, method="dcs", significance=0.1)
