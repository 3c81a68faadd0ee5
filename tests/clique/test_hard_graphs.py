"""The benchmarks' hard graphs are the published ones, their cliques are found, peers agree."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.suite.clique_graphs import HARD, consistency_like, planted_graph
from benchmarks.suite.clique_peers import PEERS, installed, within
from pcm_jax.clique import maximum_clique

# Of the second DIMACS challenge: nodes, edges, size of the largest clique.
PUBLISHED = {
    "keller4": (171, 9435, 11),
    "hamming8-4": (256, 20864, 16),
    "johnson16-2-4": (120, 5460, 8),
    "c-fat500-10": (500, 46627, 126),
    "san200_0.9_1": (200, 17910, 70),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_constructed_graphs_are_the_published_ones(name):
    graph, known = HARD[name][0](), HARD[name][1]
    clique = maximum_clique(graph)
    assert (len(graph), graph.sum() // 2, clique.size) == PUBLISHED[name]
    assert clique.optimal
    assert known == clique.size


@pytest.mark.parametrize("name", ["brock200_2", "brock200_4", "p_hat300-1", "p_hat300-2", "C125.9"])
def test_drawn_graphs_have_the_published_density(name):
    published = {
        "brock200_2": 0.496,
        "brock200_4": 0.658,
        "p_hat300-1": 0.244,
        "p_hat300-2": 0.489,
        "C125.9": 0.898,
    }
    graph = HARD[name][0]()
    density = graph.sum() / (len(graph) * (len(graph) - 1))
    assert density == pytest.approx(published[name], abs=0.015)


def test_planted_graphs_are_symmetric_and_have_their_clique():
    for graph, members in [(planted_graph(300, 40, 0.05, 1), 40), *_with_size()]:
        assert maximum_clique(graph).size >= members  # which refuses what is not symmetric
        assert not graph.diagonal().any()


def _with_size():
    return [(graph, 10) for graph in consistency_like(20, 64, seed=3)]


@pytest.mark.slow
@pytest.mark.parametrize("peer", PEERS)
def test_a_peer_finds_as_many_or_is_ended(peer):
    if not installed(peer):
        pytest.skip(f"{peer} is not installed")
    graph = planted_graph(40, 12, 0.2, 2)
    seconds, size = within(60.0, peer, graph)
    assert size == maximum_clique(graph).size
    assert 0.0 < seconds < 60.0


def test_a_peer_that_computes_for_too_long_is_ended():
    assert within(0.05, "networkx", np.array(HARD["G(200,.7)"][0]())) is None
