"""Ways, runs and places."""

import dataclasses

import numpy as np
import pytest

from pcm_jax import InputError, MapCovariance, PairEvidence, PoseGraph, lie, weigh
from pcm_jax.integrity import Places, places_of, way_of
from pcm_jax.simulation import simulate_city


@pytest.fixture(scope="module")
def pair():
    world = simulate_city(seed=0, poses=40, inliers=6, aliased_groups=0, random=6)
    (pair,) = weigh(world.graph).pairs
    return pair


def along(way_a, way_b, separation):
    return Places(np.array(way_a, float), np.array(way_b, float), separation)


def test_a_way_adds_up_the_steps(pair):
    one = pair.maps[0]
    where = lie.translation(lie.as_numpy(one.poses))
    steps = np.linalg.norm(where[1:] - where[:-1], axis=1)
    np.testing.assert_allclose(way_of(one), [steps[:k].sum() for k in range(len(where))])


def test_closures_beside_each_other_on_both_ways_are_one_witness():
    places = along([0, 3, 6, 50, 50], [0, 3, 6, 2, 80], 10.0)
    assert places.count() == 3
    assert places.count(np.array([True, True, True, False, False])) == 1
    apart = places.apart()
    assert not apart[0, 1] and apart[0, 3] and apart[3, 4]
    np.testing.assert_array_equal(apart, apart.T)


def test_without_a_separation_only_one_pose_pair_is_one_witness():
    assert along([0, 0, 1], [5, 5, 5], 0.0).count() == 2


def test_a_chain_counts_as_often_as_it_is_apart():
    chain = np.arange(0.0, 101.0)
    assert along(chain, chain, 20.0).count() == 5  # 0, 21, 42, 63, 84


def test_the_greedy_count_is_at_most_that_of_all_subsets():
    generator = np.random.default_rng(0)
    for _ in range(50):
        places = along(*generator.uniform(0, 10, (2, 8)), 3.0)
        apart = places.apart() | np.eye(8, dtype=bool)
        subsets = [np.flatnonzero(np.array(list(f"{k:08b}"), int)) for k in range(256)]
        most = max(len(s) for s in subsets if apart[np.ix_(s, s)].all())
        assert most // 2 < places.count() <= most


def test_reach_is_along_the_longer_way():
    assert along([0, 3, 9], [0, 40, 1], 1.0).reach(np.array([True, True, False])) == 40.0


def test_runs_of_the_others_set_the_separation(pair):
    """Closures at steps 0 … 11 of straight maps; those that agree in a row are the last five."""
    poses = lie.stack(
        [lie.exp(lie.group_of(pair.maps[0].poses), np.array([2.0 * k, 0, 0])) for k in range(12)]
    )
    straight = PoseGraph.from_trajectory(poses, sigma_translation=0.1, sigma_rotation=0.01)
    squared = np.full((12, 12), 50.0)
    squared[:3, :3] = 1.0
    for k in range(7, 11):
        squared[k, k + 1] = squared[k + 1, k] = 1.0
    at = np.arange(12, dtype=np.int32)
    closures = dataclasses.replace(pair.measured, pose_a=at, pose_b=at)
    both = MapCovariance(straight), MapCovariance(straight)
    evidence = PairEvidence(0, 1, np.arange(12), closures, both, _squared=squared)
    members = np.arange(12) < 3
    assert places_of(evidence, gate=9.0, members=members).separation == pytest.approx(8.0)
    # Once one of the run agrees with a member, it is no mistake if the set is right.
    squared[0, 9] = squared[9, 0] = 1.0
    assert places_of(evidence, gate=9.0, members=members).separation == pytest.approx(2.0)
    assert places_of(evidence, 3.5).separation == 3.5


@pytest.mark.parametrize("separation", [-1.0, np.nan])
def test_a_separation_is_a_length(pair, separation):
    with pytest.raises(InputError, match=r"separation: .*expected metres, at least 0"):
        places_of(pair, separation)


def test_what_it_takes(pair):
    with pytest.raises(InputError, match="the gate and the members"):
        places_of(pair)
    with pytest.raises(InputError, match="distances alone"):
        places_of(PairEvidence.from_squared(np.eye(3)), 1.0)


def test_it_says_what_it_is(pair):
    assert len(repr(places_of(pair, 10.0)).splitlines()) == 3
