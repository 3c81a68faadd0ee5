"""The exact and heuristic searches against enumeration, networkx and graphs of known answer."""

from __future__ import annotations

import itertools

import hypothesis
import hypothesis.strategies as st
import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest
from sample_graphs import (
    all_cliques,
    complete_multipartite,
    hamming_graph,
    is_clique,
    johnson_graph,
    planted_graph,
    random_graph,
)

import pcm_jax.clique.maximum as entrance
from pcm_jax.clique import _exact as exact
from pcm_jax.clique import maximum_clique
from pcm_jax.clique._exact import BitGraph
from pcm_jax.clique._heuristic import _greedy_from, greedy_clique
from pcm_jax.clique._local_search import improved_clique
from pcm_jax.errors import InputError


def members(clique) -> tuple[int, ...]:
    return tuple(np.flatnonzero(clique.members).tolist())


def small_graphs(count: int, largest: int):
    rng = np.random.default_rng(20)
    for seed in range(count):
        yield seed, random_graph(int(rng.integers(1, largest)), rng.random(), seed)


def test_exact_is_the_first_by_index_of_the_largest_by_enumeration():
    for seed, adjacency in small_graphs(600, 12):
        best = max(all_cliques(adjacency), key=lambda c: (len(c), [-v for v in c]))
        clique = maximum_clique(adjacency)
        assert members(clique) == best, seed
        assert clique.optimal
        assert clique.size == clique.upper_bound == len(best)


def test_size_equals_networkx():
    for seed, adjacency in small_graphs(400, 30):
        graph = nx.from_numpy_array(adjacency)
        expected = nx.max_weight_clique(graph, weight=None)[1]
        assert maximum_clique(graph).size == expected, seed


@pytest.mark.parametrize("kind", ["continuous", "few values", "all equal"])
def test_tie_break_is_the_cheapest_by_enumeration(kind):
    rng = np.random.default_rng(4)
    for seed, adjacency in small_graphs(150, 11):
        squared = rng.random(adjacency.shape)
        if kind == "few values":
            squared = np.round(3 * squared)
        elif kind == "all equal":
            squared = np.zeros_like(squared)
        larger = np.maximum(squared, squared.T)

        def total(clique, larger=larger):
            return sum(larger[i, j] for i, j in itertools.combinations(clique, 2))

        cliques = all_cliques(adjacency)
        size = max(map(len, cliques))
        best = min((round(total(c), 9), c) for c in cliques if len(c) == size)[1]
        assert members(maximum_clique(adjacency, tie_break=squared)) == best, seed


def test_heuristic_is_a_clique_with_a_valid_certificate():
    smaller = 0
    for seed, adjacency in small_graphs(400, 40):
        exact, quick = maximum_clique(adjacency), maximum_clique(adjacency, method="heuristic")
        assert is_clique(adjacency, quick.members), seed
        assert quick.size <= exact.size <= quick.upper_bound, seed
        assert quick.optimal == (quick.size == quick.upper_bound)
        smaller += quick.size < exact.size
    assert smaller > 0


def test_the_bound_by_degeneracy_holds_where_it_is_sharp():
    """Five vertices all joined, each to a hub of its own: the degeneracy is four, the clique five.

    The heuristic follows the hubs' degrees, and finds two.
    """
    size, leaves = 5, 20
    hubs = size + np.arange(size)
    adjacency = np.zeros((2 * size + size * leaves,) * 2, bool)
    adjacency[:size, :size] = ~np.eye(size, dtype=bool)
    adjacency[np.arange(size), hubs] = True
    adjacency[np.repeat(hubs, leaves), 2 * size + np.arange(size * leaves)] = True
    adjacency |= adjacency.T
    quick = maximum_clique(adjacency, method="heuristic")
    assert (quick.size, quick.upper_bound, quick.optimal) == (2, 5, False)
    assert maximum_clique(adjacency, time_limit=0.0).upper_bound >= 5
    assert maximum_clique(adjacency).size == 5


def test_heuristic_takes_the_largest_degree_in_the_whole_graph():
    # Vertex 0 has a triangle (0 1 2) and a neighbour 3 of larger degree in the whole graph,
    # which shares no neighbour with it: started at 0, HeuPatt ends with {0, 3}.
    graph = nx.Graph([(0, 1), (0, 2), (1, 2), (0, 3), (3, 4), (3, 5), (3, 6)])
    adjacency = nx.to_numpy_array(graph, nodelist=range(7), dtype=bool)
    assert _greedy_from(adjacency, adjacency.sum(axis=1), 0).tolist() == [0, 3]
    assert maximum_clique(graph, method="heuristic").size == 3


def literal_heupatt(adjacency: np.ndarray) -> int:
    """Algorithm 3 of the paper, line by line, without its pruning."""
    degree, best = adjacency.sum(axis=1), 0
    for start in range(len(adjacency)):
        candidates, size = set(np.flatnonzero(adjacency[start])), 1
        while candidates:
            chosen = max(candidates, key=lambda v: (degree[v], -v))
            candidates &= set(np.flatnonzero(adjacency[chosen]))
            size += 1
        best = max(best, size)
    return best


def test_heuristic_size_is_that_of_the_published_algorithm():
    for seed, adjacency in small_graphs(200, 40):
        assert maximum_clique(adjacency, method="heuristic").size == literal_heupatt(adjacency), (
            seed
        )


def test_local_search_only_improves_and_repeats_itself():
    gains = 0
    for seed in range(10):
        adjacency = random_graph(150, 0.6, seed)
        graph = BitGraph(adjacency)
        start = graph.labels_of(greedy_clique(adjacency))
        better = improved_clique(graph, start, deadline=np.inf)
        members = np.isin(np.arange(150), graph.vertices_of(better))
        assert is_clique(adjacency, members)
        assert len(better) == members.sum() >= len(start)
        assert better == improved_clique(graph, start, deadline=np.inf)
        assert len(improved_clique(graph, start, deadline=0.0)) == len(start)
        gains += len(better) - len(start)
    assert gains > 0


@pytest.mark.parametrize("parts", [1, 5, 9])
def test_moon_moser_graphs_take_the_first_of_each_part(parts):
    clique = maximum_clique(complete_multipartite(parts, 3))
    assert members(clique) == tuple(range(0, 3 * parts, 3))


def test_graphs_of_known_clique_number():
    assert maximum_clique(hamming_graph(6, 4)).size == 4
    assert maximum_clique(hamming_graph(6, 2)).size == 32
    assert maximum_clique(johnson_graph(8)).size == 4
    assert maximum_clique(~np.eye(150, dtype=bool)).size == 150


def test_no_vertices_no_edges_and_one_edge():
    empty = maximum_clique(np.zeros((0, 0), bool))
    assert (empty.size, empty.upper_bound, empty.optimal) == (0, 0, True)
    assert empty.members.shape == (0,)
    assert maximum_clique(nx.Graph()).size == 0
    assert maximum_clique([[]]).members.shape == (0,)
    assert members(maximum_clique(np.zeros((4, 4), bool))) == (0,)
    assert members(maximum_clique(np.zeros((4, 4), bool), method="heuristic")) == (0,)
    assert members(maximum_clique(nx.Graph([(2, 1), (0, 3)]))) == (0, 3)


def test_one_answer_for_every_kind_of_graph_and_any_diagonal():
    adjacency = random_graph(40, 0.5, 3)
    expected = members(maximum_clique(adjacency))
    with_diagonal = adjacency | np.eye(40, dtype=bool)
    numbers = adjacency.astype(np.int32)
    for graph in (with_diagonal, jnp.asarray(adjacency), numbers, nx.from_numpy_array(adjacency)):
        assert members(maximum_clique(graph)) == expected
    assert with_diagonal.diagonal().all()


@hypothesis.settings(max_examples=60, deadline=None)
@hypothesis.given(st.integers(1, 60), st.floats(0, 1), st.integers(0, 2**32 - 1))
def test_size_does_not_change_under_permutation(size, density, seed):
    adjacency = random_graph(size, density, seed)
    order = np.random.default_rng(seed).permutation(size)
    clique = maximum_clique(adjacency)
    permuted = maximum_clique(adjacency[np.ix_(order, order)])
    assert permuted.size == clique.size
    assert is_clique(adjacency, clique.members)
    assert members(maximum_clique(adjacency)) == members(clique)


@pytest.mark.slow
def test_cliques_deeper_than_the_recursion_limit():
    graph = ~np.eye(1100, dtype=bool)
    graph[3, 7] = graph[7, 3] = False
    squared = np.zeros(graph.shape)
    squared[3, 5] = 1.0
    assert members(maximum_clique(graph)) == tuple(np.delete(np.arange(1100), 7))
    cheaper = maximum_clique(graph, tie_break=squared)
    assert members(cheaper) == tuple(np.delete(np.arange(1100), 3))


def test_an_unfinished_search_is_bounded_wherever_it_stops(monkeypatch):
    for seed in range(30):
        adjacency = random_graph(14, 0.5, seed)
        size, graph = maximum_clique(adjacency).size, BitGraph(adjacency)
        stopped, reading = True, 0
        while stopped:
            clock = itertools.count()
            monkeypatch.setattr(exact, "perf_counter", clock.__next__)
            outcome = exact.largest_clique(graph, graph.everything, 1, deadline=reading)
            found, stopped = len(outcome.labels or [0]), bool(outcome.unsettled)
            assert found <= size <= max(found, graph.chromatic_bound(outcome.unsettled)), seed
            reading += 1
        assert found == size


def test_totals_that_differ_by_rounding_are_ties():
    # 0.1 + 0.2 and 0.3 + 0 differ in the last digit: triangles of equal total, the first wins,
    # though the heuristic meets the second first (of larger degree, for its edge to 6).
    graph = nx.Graph([(0, 1), (0, 2), (1, 2), (3, 4), (3, 5), (4, 5), (3, 6)])
    squared = np.zeros((7, 7))
    squared[0, 1], squared[1, 2], squared[3, 4] = 0.1, 0.2, 0.3
    assert 0.1 + 0.2 > 0.3
    assert members(maximum_clique(graph, tie_break=squared)) == (0, 1, 2)


@pytest.mark.parametrize(("size", "planted"), [(1000, 150), (3000, 300)])
def test_planted_clique_is_found_and_proven(size, planted):
    clique = maximum_clique(planted_graph(size, planted, 0.05, 7))
    assert clique.optimal
    assert clique.size == planted


def test_the_paper_s_proportions_take_a_handful_of_steps(monkeypatch):
    # 15 true, two groups of 5 aliased and 90 random measurements.
    adjacency = random_graph(115, 0.03, 2)
    for group in (slice(0, 15), slice(15, 20), slice(20, 25)):
        adjacency[group, group] = True
    np.fill_diagonal(adjacency, False)
    clock = itertools.count()
    monkeypatch.setattr(exact, "perf_counter", clock.__next__)
    assert members(maximum_clique(adjacency)) == tuple(range(15))
    assert next(clock) < 20  # nodes of the search


@pytest.mark.parametrize(
    ("graph", "message"),
    [
        (np.zeros((2, 3), bool), r"graph: shape \(2, 3\), expected a square"),
        (np.zeros(3, bool), r"graph: shape \(3,\), expected a square"),
        (np.triu(np.ones((3, 3), bool)), r"graph: \[0, 1\] is True but \[1, 0\] is False"),
        (np.full((2, 2), 0.5), r"graph: \[0, 0\] is 0.5, expected bool"),
        (np.full((2, 2), np.nan), r"graph: \[0, 0\] is nan, expected bool"),
        (np.full((2, 2), "a"), "graph: dtype <U1, expected bool"),
        (nx.Graph([(1, 2)]), r"graph: node 2, expected the nodes 0\.\.1"),
        (nx.DiGraph([(0, 1)]), "graph: is directed"),
    ],
)
def test_bad_graphs_are_named(graph, message):
    with pytest.raises(InputError, match=message):
        maximum_clique(graph)


def test_asymmetry_is_found_in_any_tile():
    adjacency = np.zeros((1300, 1300), bool)
    adjacency[1200, 30] = True
    with pytest.raises(InputError, match=r"graph: \[30, 1200\] is False but \[1200, 30\] is True"):
        maximum_clique(adjacency)


def test_bad_options_are_named():
    graph = np.ones((3, 3), bool)
    with pytest.raises(InputError, match="method: 'guess', expected one of exact, heuristic"):
        maximum_clique(graph, method="guess")
    with pytest.raises(InputError, match="time_limit: -1"):
        maximum_clique(graph, time_limit=-1)
    with pytest.raises(InputError, match="tie_break: given with method 'heuristic'"):
        maximum_clique(graph, method="heuristic", tie_break=np.zeros((3, 3)))
    with pytest.raises(InputError, match=r"tie_break: shape \(2, 2\)"):
        maximum_clique(graph, tie_break=np.zeros((2, 2)))
    with pytest.raises(InputError, match=r"tie_break: \[0, 1\] is not finite"):
        maximum_clique(graph, tie_break=np.full((3, 3), np.nan))


def test_a_wrong_answer_is_never_returned(monkeypatch):
    monkeypatch.setattr(entrance, "greedy_clique", lambda *_: np.array([0, 1]))
    with pytest.raises(RuntimeError, match="not a clique"):
        maximum_clique(np.zeros((2, 2), bool), method="heuristic")
