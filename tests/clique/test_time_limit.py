"""Time limits by a clock that moves on by one at every reading: none of it is the machine's."""

from __future__ import annotations

import importlib
import sys
from collections import Counter
from typing import Any

import numpy as np
import pytest
from sample_graphs import complete_multipartite, is_clique, planted_graph, random_graph

from pcm_jax.clique import GrowingClique, growing, maximum_clique
from pcm_jax.clique._adjacency import adjacency_matrix
from pcm_jax.clique._bounds import degrees
from pcm_jax.clique._costs import checked_squared
from pcm_jax.clique._exact import BitGraph
from pcm_jax.clique._heuristic import greedy_clique, greedy_heavy_clique
from pcm_jax.clique._ties import _CheapestClique, smallest_by_total
from pcm_jax.errors import InputError

MODULES = [
    importlib.import_module(f"pcm_jax.clique.{name}")
    for name in (
        *("_adjacency", "_bitset", "_bounds", "_costs", "_exact", "_heuristic", "_lanes"),
        *("_local_search", "_ties", "_weighted", "growing", "maximum"),
    )
]
# Readings after the end, by stages that each find out for themselves that it is over.
FEW = 16


class Clock:
    """Counts its readings, by the module that asks."""

    def __init__(self):
        self.readings = Counter()

    def __call__(self) -> float:
        self.readings[sys._getframe(1).f_globals["__name__"].rpartition(".")[2]] += 1
        return float(self.readings.total())


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    for module in MODULES:
        monkeypatch.setattr(module, "perf_counter", clock)
    return clock


def options_of(size: int) -> dict[str, dict[str, Any]]:
    generator = np.random.default_rng(5)
    weights, squared = generator.integers(0, 4, size), generator.random((size, size))
    return {
        "exact": {},
        "heuristic": {"method": "heuristic"},
        "tie_break": {"tie_break": squared},
        "weights": {"weights": weights},
        "floats": {"weights": 0.1 * weights},
        "weights and tie_break": {"weights": weights, "tie_break": squared},
        "weights, heuristic": {"weights": weights, "method": "heuristic"},
    }


@pytest.mark.parametrize("kind", list(options_of(1)))
def test_wherever_time_runs_out_the_answer_is_a_clique_with_a_bound_at_once(clock, kind):
    adjacency = random_graph(70, 0.6, 3)
    options = options_of(70)[kind]
    full = maximum_clique(adjacency, **{**options, "method": "exact"})
    clock.readings.clear()
    maximum_clique(adjacency, **options)
    needed = clock.readings.total()
    for limit in {*range(0, needed, max(1, needed // 60)), *range(min(needed, 30))}:
        clock.readings.clear()
        cut = maximum_clique(adjacency, time_limit=limit, **options)
        assert clock.readings.total() <= limit + FEW, limit
        assert is_clique(adjacency, cut.members)
        assert cut.weight <= full.weight * (1 + 1e-12) <= cut.weight_bound * (1 + 2e-12), limit
        assert cut.optimal == (cut.weight == cut.weight_bound)
        assert cut.size <= cut.upper_bound
    clock.readings.clear()
    assert (
        maximum_clique(adjacency, **options).members
        == maximum_clique(adjacency, time_limit=needed + FEW, **options).members
    ).all()


@pytest.mark.parametrize("searched", [0, 400])
def test_wherever_time_runs_out_a_clique_that_grows_knows_one_at_once(clock, monkeypatch, searched):
    monkeypatch.setattr(growing, "SEARCHED", searched)
    monkeypatch.setattr(growing, "ROWS", 10)
    adjacency = random_graph(70, 0.6, 3)
    full = maximum_clique(adjacency)
    clock.readings.clear()
    GrowingClique.of_graph(adjacency).largest(1e9)
    needed = clock.readings.total()
    assert clock.readings["growing"] >= 7  # the rows, ten by ten
    for limit in {*range(0, needed, max(1, needed // 60)), *range(min(needed, 40))}:
        clock.readings.clear()
        state = GrowingClique.of_graph(adjacency)
        cut = state.largest(limit)
        assert clock.readings.total() <= limit + FEW, limit
        assert is_clique(adjacency, cut.members)
        assert cut.size <= full.size <= cut.upper_bound, limit
        assert (state.largest(1e9).members == full.members).all(), limit


def test_a_clique_that_grows_looks_at_the_clock_while_it_leaves_out_vertices(clock):
    """Of a path the ends are left out, again and again."""
    path = np.eye(400, k=1, dtype=bool) | np.eye(400, k=-1, dtype=bool)
    state, everything = GrowingClique.of_graph(path), (1 << 400) - 1
    assert len(state._inside(everything, 2, deadline=1e9)) == 0
    assert clock.readings.total() >= 199
    clock.readings.clear()
    with pytest.raises(TimeoutError):
        state._inside(everything, 2, deadline=50)
    assert clock.readings.total() == 51


@pytest.mark.parametrize("weighted", [False, True])
def test_no_stage_forgets_the_clock_on_large_graphs(clock, weighted):
    # A dense half whose core has to be gathered from a graph of twice its size.
    adjacency = np.zeros((1200, 1200), bool)
    adjacency[:600, :600] = complete_multipartite(150, 4)
    adjacency[5, 9] = adjacency[9, 5] = adjacency[300, 304] = adjacency[304, 300] = False
    squared = np.random.default_rng(2).random(adjacency.shape)
    weights = np.where(np.arange(1200) == 17, 2, 1) if weighted else None
    clique = maximum_clique(adjacency, tie_break=squared, weights=weights, time_limit=3000)
    assert clique.optimal
    assert is_clique(adjacency, clique.members)
    assert clock.readings.total() <= 3000 + FEW
    # The order vertex by vertex, the core and the weights of neighbourhoods by tiles.
    assert clock.readings["_bounds"] >= 600 + (3 + 5 + 3 if weighted else 3)
    assert clock.readings["_bitset"] >= 600 // 128
    assert clock.readings["_adjacency"] >= 2
    assert clock.readings["_costs"] >= 3
    assert clock.readings["_heuristic"] >= 1
    assert clock.readings["_ties"] >= 600  # the edges, vertex by vertex
    assert clock.readings["_weighted"] >= weighted  # without weights a colouring is the proof


def test_the_first_clique_ends_with_the_time(clock):
    """Of many members: each takes a step over all that are left."""
    adjacency = complete_multipartite(200, 2)
    weights = np.arange(1.0, 401.0)
    for greedy in (greedy_clique, lambda *given: greedy_heavy_clique(given[0], weights, given[1])):
        clock.readings.clear()
        found = greedy(adjacency, 50.0)
        assert 40 <= len(found) <= 50
        assert is_clique(adjacency, np.isin(np.arange(400), found))


def test_time_limit_holds_for_the_choice_among_equals(clock):
    # 3^40 maximum cliques whose totals differ: the size is proven at once, the cheapest is not.
    adjacency = complete_multipartite(40, 3)
    squared = np.random.default_rng(0).random(adjacency.shape)
    clique = maximum_clique(adjacency, tie_break=squared, time_limit=2000)
    assert clock.readings.total() <= 2000 + FEW
    assert clique.optimal
    assert clique.size == 40


@pytest.mark.slow
def test_bound_of_an_unfinished_search_lies_between_the_answer_and_the_degrees(clock):
    adjacency = planted_graph(300, 20, 0.8, 1)
    first = maximum_clique(adjacency, time_limit=0)
    clique = maximum_clique(adjacency, time_limit=6000)
    assert not clique.optimal
    assert first.size <= clique.size < clique.upper_bound < first.upper_bound <= 300


def test_sorting_the_edges_for_ties_ends_with_the_time():
    adjacency = random_graph(20, 0.5, 0)
    squared = np.zeros((20, 20))
    graph = BitGraph(adjacency)
    clique = [1]
    with pytest.raises(TimeoutError):
        _CheapestClique(graph, squared, 5, deadline=0.0)
    assert smallest_by_total(graph, squared, clique, deadline=0.0) == clique


def test_a_graph_without_time_for_its_check_is_named_where_it_matters():
    with pytest.raises(InputError, match=r"graph: \[0, 1\] is True but \[1, 0\] is False"):
        maximum_clique(np.triu(np.ones((3, 3), bool), 1), time_limit=0)


def test_a_graph_is_copied_only_for_its_diagonal_and_never_changed():
    adjacency = random_graph(30, 0.5, 1)
    assert adjacency_matrix(adjacency) is adjacency
    with_diagonal = adjacency | np.eye(30, dtype=bool)
    assert (adjacency_matrix(with_diagonal) == adjacency).all()
    assert with_diagonal.diagonal().all()


def test_degrees_that_were_not_counted_in_time_are_bounds():
    adjacency = random_graph(600, 0.5, 1)
    counted = adjacency.sum(axis=1)
    assert (degrees(adjacency) == counted).all()
    assert (degrees(adjacency, deadline=0.0) == 599).all()


def test_squared_distances_are_looked_at_until_the_time_is_over():
    adjacency, squared = random_graph(20, 0.5, 1), np.full((20, 20), np.nan)
    with pytest.raises(InputError, match="not finite"):
        checked_squared(squared, adjacency)
    assert checked_squared(squared, adjacency, deadline=0.0) is squared
