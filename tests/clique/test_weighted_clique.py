"""The heaviest clique against enumeration, networkx, and the search without weights."""

from __future__ import annotations

import itertools
import math
from typing import Any

import hypothesis
import hypothesis.strategies as st
import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest
from sample_graphs import (
    all_cliques,
    complete_multipartite,
    is_clique,
    planted_graph,
    random_graph,
)

from pcm_jax.clique import _weighted, maximum_clique
from pcm_jax.clique._local_search import improved_clique
from pcm_jax.clique._ties import first_of_heaviest
from pcm_jax.clique._weighted import WeightedGraph, clique_of_weight, heaviest_cliques
from pcm_jax.clique._weights import checked_weights
from pcm_jax.errors import InputError

WEIGHTS = {
    "few and none": lambda rng, m: rng.integers(0, 4, m),
    "integers": lambda rng, m: rng.integers(1, 11, m),
    "large integers": lambda rng, m: rng.integers(1, 3, m).astype(np.uint64) << np.uint64(62),
    "tenths": lambda rng, m: rng.choice([0.1, 0.2, 0.3], m),
    "continuous": lambda rng, m: rng.random(m),
    "whole floats": lambda rng, m: rng.integers(1, 4, m).astype(float),
    "tiny": lambda rng, m: rng.choice([1e-300, 2e-300], m),
}


def members(clique) -> tuple[int, ...]:
    return tuple(np.flatnonzero(clique.members).tolist())


def cases(count: int, kind: str, largest: int = 11):
    rng = np.random.default_rng(7)
    for seed in range(count):
        adjacency = random_graph(int(rng.integers(1, largest)), rng.random(), seed)
        yield seed, adjacency, WEIGHTS[kind](rng, len(adjacency))


def heaviest_of(adjacency: np.ndarray, weights: np.ndarray) -> list[tuple[int, ...]]:
    """All heaviest cliques without vertices of weight 0, by enumeration; floats to 12 digits."""
    values = weights.tolist()
    total = {
        clique: math.fsum(values[v] for v in clique)
        if weights.dtype.kind == "f"
        else sum(values[v] for v in clique)
        for clique in all_cliques(adjacency)
        if all(values[v] > 0 for v in clique)
    }
    best = max(total.values())
    slack = 1e-12 * best if weights.dtype.kind == "f" else 0
    return [clique for clique, weight in total.items() if weight >= best - slack]


@pytest.fixture(params=[256, 0], ids=["remembered", "searched for"])
def remembered(request, monkeypatch):
    """Both ways to choose among equals: of those remembered, and by a search of its own."""
    monkeypatch.setattr(_weighted, "_REMEMBERED", request.param)


@pytest.mark.parametrize("kind", WEIGHTS)
@pytest.mark.usefixtures("remembered")
def test_is_the_first_by_index_of_the_heaviest_by_enumeration(kind):
    for seed, adjacency, weights in cases(250, kind):
        expected = min(heaviest_of(adjacency, weights))
        clique = maximum_clique(adjacency, weights=weights)
        assert members(clique) == expected, seed
        assert clique.optimal
        assert clique.weight == clique.weight_bound
        assert clique.weight == pytest.approx(sum(weights.tolist()[v] for v in expected), rel=1e-12)
        assert clique.size <= clique.upper_bound


@pytest.mark.parametrize("kind", ["few and none", "tenths"])
@pytest.mark.usefixtures("remembered")
def test_tie_break_is_the_cheapest_of_the_heaviest_by_enumeration(kind):
    rng = np.random.default_rng(4)
    chosen_otherwise = 0
    for seed, adjacency, weights in cases(300, kind):
        squared = np.round(3 * rng.random(adjacency.shape), seed % 2)
        larger = np.maximum(squared, squared.T)

        def total(clique, larger=larger):
            return round(sum(larger[i, j] for i, j in itertools.combinations(clique, 2)), 9)

        ties = heaviest_of(adjacency, weights)
        expected = min((total(clique), clique) for clique in ties)[1]
        found = members(maximum_clique(adjacency, weights=weights, tie_break=squared))
        assert found == expected, seed
        chosen_otherwise += expected != min(ties)
    assert chosen_otherwise > 10


def test_weight_equals_networkx_s():
    rng = np.random.default_rng(8)
    for seed in range(200):
        adjacency = random_graph(int(rng.integers(1, 45)), 0.9 * rng.random(), seed)
        weights = rng.integers(0, 10, len(adjacency))
        graph = nx.from_numpy_array(adjacency)
        nx.set_node_attributes(graph, dict(enumerate(weights.tolist())), "weight")
        assert maximum_clique(graph, weights=weights).weight == nx.max_weight_clique(graph)[1], seed


def test_planted_heavy_clique_is_found_and_proven():
    adjacency = planted_graph(800, 40, 0.1, 3)
    inside = maximum_clique(adjacency).members
    weights = np.where(inside, 3, np.random.default_rng(0).integers(1, 9, 800))
    clique = maximum_clique(adjacency, weights=weights)
    assert (clique.members == inside).all()
    assert clique.weight == clique.weight_bound == 120


def test_equal_weights_give_the_answer_without_weights_bit_for_bit():
    for seed in range(60):
        adjacency = random_graph(1 + seed, 0.5, seed)
        squared = np.random.default_rng(seed).random(adjacency.shape)
        kinds: list[dict[str, Any]] = [{}, {"tie_break": squared}]
        for options in (*kinds, {"method": "heuristic"}, {"time_limit": 0.0}):
            plain = maximum_clique(adjacency, **options)
            for weights in (np.ones(1 + seed), np.full(1 + seed, 7)):
                clique = maximum_clique(adjacency, weights=weights, **options)
                assert (clique.members == plain.members).all()
                assert (clique.size, clique.optimal) == (plain.size, plain.optimal)
                assert clique.upper_bound == plain.upper_bound
                assert clique.weight == weights[0] * plain.size
                assert clique.weight_bound == pytest.approx(weights[0] * plain.upper_bound)


@pytest.mark.usefixtures("remembered")
def test_weighted_search_of_equal_weights_is_the_search_without():
    # `maximum_clique` passes equal weights on; here they go through the weighted search.
    for seed in range(60):
        adjacency = random_graph(30, 0.6, seed)
        weights = checked_weights(np.ones(30), 30)
        graph = WeightedGraph(adjacency, weights.units, weights.coarse()[0])
        found = heaviest_cliques(graph, [1], weights.slack)
        labels = first_of_heaviest(graph, found, np.inf)
        assert tuple(sorted(graph.vertices_of(labels).tolist())) == members(
            maximum_clique(adjacency)
        ), seed


def test_vertices_of_weight_0_are_never_members():
    everything = np.ones((5, 5), bool)
    clique = maximum_clique(everything, weights=np.array([0, 2, 0, 1, 0]))
    assert (members(clique), clique.weight) == ((1, 3), 3)
    nothing = maximum_clique(everything, weights=np.zeros(5))
    assert (nothing.size, nothing.weight, nothing.weight_bound, nothing.optimal) == (0, 0, 0, True)
    assert maximum_clique(everything, weights=np.zeros(5), method="heuristic").size == 0
    assert maximum_clique(np.zeros((0, 0), bool), weights=np.array([])).weight == 0


def test_one_heavy_vertex_outweighs_a_large_clique():
    adjacency = np.zeros((6, 6), bool)
    adjacency[1:, 1:] = True
    clique = maximum_clique(adjacency, weights=np.array([5.5, 1, 1, 1, 1, 1]))
    assert (members(clique), clique.weight, clique.upper_bound) == ((0,), 5.5, 5)


def test_floats_that_differ_by_rounding_are_ties_and_integers_never_are():
    # 0.1 + 0.2 > 0.3 in the last digit: {0} and {1, 2} weigh the same, and 0 comes first.
    adjacency = np.zeros((3, 3), bool)
    adjacency[1, 2] = adjacency[2, 1] = True
    assert members(maximum_clique(adjacency, weights=np.array([0.3, 0.1, 0.2]))) == (0,)
    assert members(maximum_clique(adjacency, weights=np.array([0.3, 0.1, 0.2 + 1e-11]))) == (1, 2)
    large = 10**17
    assert members(maximum_clique(adjacency, weights=np.array([large, large - 1, 1]))) == (0,)
    assert members(maximum_clique(adjacency, weights=np.array([large, large - 1, 2]))) == (1, 2)


def test_more_ties_than_are_remembered_take_the_first_of_each_part():
    weights = np.ones(60, int)
    weights[59] = 2  # so that weights are not equal; 3^19 cliques of weight 21
    clique = maximum_clique(complete_multipartite(20, 3), weights=weights)
    assert members(clique) == (*range(0, 57, 3), 59)


def test_heuristic_is_a_clique_with_a_valid_certificate():
    lighter = proven = 0
    for kind in ("few and none", "continuous"):
        for seed, adjacency, weights in cases(150, kind, largest=40):
            exact = maximum_clique(adjacency, weights=weights)
            quick = maximum_clique(adjacency, weights=weights, method="heuristic")
            assert is_clique(adjacency, quick.members), seed
            assert quick.weight <= exact.weight * (1 + 1e-12)
            assert exact.weight <= quick.weight_bound * (1 + 1e-12)
            assert quick.optimal == (quick.weight == quick.weight_bound)
            lighter += quick.weight < exact.weight
            proven += quick.optimal
    assert lighter > 0
    assert proven > 50


def test_bounds_and_decisions_of_the_weighted_graph_by_enumeration():
    for seed, adjacency, weights in cases(150, "integers", largest=12):
        best = max(sum(weights[list(c)].tolist()) for c in all_cliques(adjacency))
        graph = WeightedGraph(adjacency, weights.tolist(), weights.astype(float))
        assert graph.weight_bound(graph.everything) >= best, seed
        assert graph.uncovered(graph.everything, best - 1) != 0
        found = clique_of_weight(graph, graph.everything, best)
        assert found is not None
        assert sum(graph.weights[label] for label in found) == best
        assert clique_of_weight(graph, graph.everything, best + 1) is None


def literal_colouring(adjacency: np.ndarray, weights: np.ndarray, order: np.ndarray) -> int:
    """The weighted colouring, one independent set and one unit of weight at a time."""
    left, spent = weights.copy(), 0
    while left.any():
        chosen: list[int] = []
        for vertex in order[::-1]:
            if left[vertex] and not adjacency[vertex, chosen].any():
                chosen.append(vertex)
        left[chosen] -= 1
        spent += 1
    return spent


@pytest.mark.parametrize("density", [0.1, 0.3, 0.6, 0.9])
def test_weighted_colouring_is_the_literal_one(density):
    for seed in range(40):
        adjacency = random_graph(16, density, seed)
        weights = np.random.default_rng(seed).integers(1, 6, 16)
        graph = WeightedGraph(adjacency, weights.tolist(), weights.astype(float))
        literal = literal_colouring(adjacency, weights, graph.vertices)
        assert graph.weight_bound(graph.everything) == literal, seed
        assert graph.uncovered(graph.everything, literal) == 0
        assert graph.uncovered(graph.everything, literal - 1) != 0


def test_an_unfinished_search_is_bounded_wherever_it_stops(monkeypatch):
    for seed, adjacency, weights in cases(40, "integers", largest=15):
        best = maximum_clique(adjacency, weights=weights).weight
        graph = WeightedGraph(adjacency, weights.tolist(), weights.astype(float))
        reading, stopped, weight = 0, True, 0
        while stopped:
            monkeypatch.setattr(_weighted, "perf_counter", itertools.count().__next__)
            found = heaviest_cliques(graph, [1], lambda _: 0, deadline=reading)
            stopped, weight = bool(found.unsettled), found.weight
            assert weight <= best <= max(weight, graph.weight_bound(found.unsettled)), seed
            reading += 1
        assert weight == best


def test_a_weight_that_is_nothing_beside_another_still_counts():
    clique = maximum_clique(np.ones((2, 2), bool), weights=np.array([1e-30, 1.0]))
    assert members(clique) == (0, 1)


def test_local_search_looks_for_weight():
    gains = 0
    for seed in range(10):
        adjacency = random_graph(100, 0.6, seed)
        weights = np.random.default_rng(seed).integers(1, 20, 100)
        graph = WeightedGraph(adjacency, weights.tolist(), weights.astype(float))
        better = improved_clique(graph, [1], deadline=np.inf)
        inside = np.isin(np.arange(100), graph.vertices_of(better))
        assert is_clique(adjacency, inside)
        gains += int(weights[inside].sum()) - graph.weights[1]
    assert gains > 500


@hypothesis.settings(max_examples=50, deadline=None)
@hypothesis.given(st.integers(1, 45), st.floats(0, 1), st.integers(0, 2**32 - 1))
def test_weight_does_not_change_under_permutation_and_answers_repeat(size, density, seed):
    rng = np.random.default_rng(seed)
    adjacency, order = random_graph(size, density, seed), rng.permutation(size)
    weights = rng.integers(0, 6, size)
    clique = maximum_clique(adjacency, weights=weights)
    permuted = maximum_clique(adjacency[np.ix_(order, order)], weights=weights[order])
    assert permuted.weight == clique.weight
    assert is_clique(adjacency, clique.members)
    assert members(maximum_clique(jnp.asarray(adjacency), weights=jnp.asarray(weights))) == members(
        clique
    )


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ([1.0, 2.0], r"weights: shape \(2,\), expected one a node, \(3,\)"),
        (np.ones((3, 1)), r"weights: shape \(3, 1\)"),
        ([1.0, -0.5, 1.0], r"weights: \[1\] is -0.5, expected a finite number, at least 0"),
        ([1, 1, -2], r"weights: \[2\] is -2"),
        ([1.0, 1.0, np.nan], r"weights: \[2\] is nan"),
        ([np.inf, 1.0, 1.0], r"weights: \[0\] is inf"),
        ([1e308, 1e308, 1e308], "weights: their sum is infinite"),
        ([True, True, False], "weights: dtype bool, expected real numbers"),
        ([1j, 1, 1], "weights: dtype complex128"),
        (["a", "b", "c"], "weights: dtype <U1"),
    ],
)
def test_bad_weights_are_named(weights, message):
    with pytest.raises(InputError, match=message):
        maximum_clique(np.ones((3, 3), bool), weights=np.asarray(weights))


def test_negative_distances_are_refused_with_weights():
    squared = np.zeros((3, 3))
    squared[1, 2] = -1.0
    maximum_clique(np.ones((3, 3), bool), tie_break=squared)
    with pytest.raises(InputError, match=r"tie_break: \[1, 2\] is -1, expected at least 0"):
        maximum_clique(np.ones((3, 3), bool), tie_break=squared, weights=np.array([1, 2, 3]))


def test_reprs_tell_the_weight_and_the_proof():
    adjacency = random_graph(40, 0.7, 1)
    weights = np.random.default_rng(0).random(40)
    proven = maximum_clique(adjacency, weights=weights)
    assert f"weight {proven.weight:.6g}" in repr(proven)
    assert "proven the heaviest" in repr(proven)
    cut = maximum_clique(adjacency, weights=weights, time_limit=0.0)
    assert f"none weighs more than {cut.weight_bound:.6g}" in repr(cut)
    assert "weight" not in repr(maximum_clique(adjacency))
