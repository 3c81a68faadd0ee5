"""Closures' weights through `select` and `merge`."""

from __future__ import annotations

import dataclasses
import warnings

import networkx as nx
import numpy as np
import pytest

from pcm_jax.errors import InputError, InputWarning
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.pipeline import merge, select, weigh
from pcm_jax.selection import select_from
from pcm_jax.simulation import simulate_city


@pytest.fixture(scope="module")
def world():
    return simulate_city(seed=2, poses=80, robots=3, inliers=8, aliased_size=3, random=10)


@pytest.fixture(scope="module")
def maps(world):
    return weigh(world.graph).maps


@pytest.fixture
def weighed(world, maps):
    """The evidence with other weights of the closures."""

    def of(weight, **options):
        closures = dataclasses.replace(world.graph.closures, weight=np.asarray(weight, float))
        return weigh(MultiRobotGraph(maps, closures), optimized=True, **options)

    return of


def mixed(count, seed=0):
    return np.random.default_rng(seed).integers(1, 9, count).astype(float)


@pytest.mark.parametrize("same", [1.0, 0.3, 17.0])
def test_equal_weights_change_nothing(world, weighed, same):
    plain, equal = select(world.graph), select(weighed(np.full(len(world.is_true), same)))
    np.testing.assert_array_equal(equal.accepted, plain.accepted)
    for one, other in zip(equal.pairs, plain.pairs, strict=True):
        np.testing.assert_array_equal(one.squared, other.squared)
        assert (one.optimal, one.upper_bound) == (other.optimal, other.upper_bound)
        assert (one.weight, one.weight_bound) == (None, None)
        assert repr(one) == repr(other)


def test_the_heaviest_set_wins_and_says_its_weight(world, weighed):
    weight = np.where(world.is_true, 0.1, 5.0)
    weight[::7] = 0.2
    selection = select(weighed(weight), minimum_inliers=2)
    for pair in selection.pairs:
        own = weight[pair.closures]
        graph = nx.from_numpy_array(pair.consistent())
        nx.set_node_attributes(graph, dict(enumerate((10 * own).astype(int).tolist())), "weight")
        heaviest = nx.max_weight_clique(graph)[1] / 10
        assert own[pair.accepted].sum() == pytest.approx(heaviest)
        assert pair.weight == pair.weight_bound == pytest.approx(heaviest)
        assert pair.optimal
        assert f"of weight {pair.weight:.6g}, proven" in repr(pair)
    assert not selection.accepted[world.is_true].all()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["pcm-exact", "pcm-heuristic"])
def test_weights_reach_each_pair_by_its_own_closures(world, weighed, method):
    weight = mixed(len(world.is_true))
    dense = select(weighed(weight), method=method)
    streamed = select(weighed(weight, memory_limit=0), method=method)
    np.testing.assert_array_equal(streamed.accepted, dense.accepted)
    for pair in dense.pairs:
        expected = select_from(
            pair.squared, pair.gate, method=method, weights=weight[pair.closures]
        )
        np.testing.assert_array_equal(pair.accepted, expected)
    assert [pair.weight for pair in streamed.pairs] == [pair.weight for pair in dense.pairs]


def test_no_weight_is_never_kept(world, weighed):
    weight = np.ones(len(world.is_true))
    dropped = np.flatnonzero(select(world.graph).accepted)[:2]
    weight[dropped] = 0.0
    assert not select(weighed(weight)).accepted[dropped].any()
    assert not select(weighed(0.0 * weight), minimum_inliers=0).accepted.any()


@pytest.mark.parametrize(("bad", "told"), [(-1.0, "-1.0"), (np.nan, "nan"), (np.inf, "inf")])
@pytest.mark.parametrize("method", ["pcm-exact", "ransac", "dcs"])
def test_bad_weights_are_refused_by_index(world, weighed, method, bad, told):
    weight = np.ones(len(world.is_true))
    weight[4] = bad
    with pytest.raises(InputError, match=rf"weight\[4\]: {told} given, expected a finite number"):
        merge(weighed(weight), method=method)


@pytest.mark.slow
def test_methods_that_cannot_use_weights_say_so(world, weighed):
    count = len(world.is_true)
    uneven = weighed(mixed(count))
    for ask, method in ((select, "ransac"), (select, "jcbb"), (merge, "gnc")):
        with pytest.warns(InputWarning, match=f"weight: the closures between a and b .*'{method}'"):
            ask(uneven, method=method)
    seen = []

    def mine(evidence, gate):
        seen.append(evidence.measured.weight)
        return np.zeros(len(evidence), bool)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        select(uneven, method=mine)
        select(weighed(np.full(count, 2.0)), method="ransac")
        merge(uneven, accepted=world.is_true)
    for weight, pair in zip(seen, uneven.pairs, strict=True):
        np.testing.assert_array_equal(weight, mixed(count)[pair.closures])


def test_weights_are_no_option_of_select(world):
    for ask in (select, merge):
        with pytest.raises(InputError, match="weights: not an option of select, expected them in"):
            ask(world.graph, weights=np.ones(3))


def test_the_report_has_weights_only_where_they_decided(world, weighed):
    usual = merge(world.graph).report()["robot_pairs"]
    assert not any("weight" in pair for pair in usual)
    result = merge(weighed(mixed(len(world.is_true))))
    for row, pair in zip(result.report()["robot_pairs"], result.selection.pairs, strict=True):
        assert (row["weight"], row["weight_bound"]) == (pair.weight, pair.weight_bound)
        assert row["weight"] == mixed(len(world.is_true))[pair.closures][pair.accepted].sum()
