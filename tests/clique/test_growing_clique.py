"""`GrowingClique` against `maximum_clique` of the same graph after every step."""

from __future__ import annotations

import numpy as np
import pytest

from pcm_jax.clique import GrowingClique, growing, maximum_clique


def random_steps(seed: int, density: float, leaving: float, steps: int):
    """A growing clique and its graph, after each of some random steps."""
    generator = np.random.default_rng(seed)
    found, graph = GrowingClique(), np.zeros((0, 0), bool)
    for _ in range(steps):
        count = len(graph)
        if count and generator.random() < leaving:
            vertex = int(generator.integers(count))
            found.remove(vertex)
            graph = np.delete(np.delete(graph, vertex, 0), vertex, 1)
        else:
            row = generator.random(count) < density
            assert found.add(row) == count
            graph = np.block([[graph, row[:, None]], [row[None], np.zeros((1, 1), bool)]])
        yield found, graph


@pytest.mark.parametrize("seed", range(40))
def test_equals_the_batch_whenever_asked(seed):
    generator = np.random.default_rng([7, seed])
    density, leaving = generator.uniform(0.1, 0.95), generator.uniform(0.0, 0.5)
    for found, graph in random_steps(seed, density, leaving, 40):
        if generator.random() < 0.4:
            batch = maximum_clique(graph)
            assert found.size == batch.size
            np.testing.assert_array_equal(found.first(), batch.members)
            np.testing.assert_array_equal(found.dense(), graph)
            assert len(found) == len(graph)


@pytest.mark.parametrize("steps", [0, 1, 3])
@pytest.mark.parametrize("searched", [5, 400])
def test_what_is_left_undecided_is_decided_when_asked(monkeypatch, steps, searched):
    monkeypatch.setattr(growing, "STEPS", steps)
    monkeypatch.setattr(growing, "SEARCHED", searched)
    for seed in range(15):
        *_, (found, graph) = random_steps(seed, 0.7, 0.2, 45)
        batch = maximum_clique(graph)
        assert found.size == batch.size
        np.testing.assert_array_equal(found.first(), batch.members)


def test_many_new_vertices_at_once(monkeypatch):
    monkeypatch.setattr(growing, "FEW", 2)
    for found, graph in random_steps(3, 0.6, 0.0, 60):
        if len(graph) % 9 == 0:
            np.testing.assert_array_equal(found.first(), maximum_clique(graph).members)


def test_a_graph_to_start_from():
    for seed in range(10):
        *_, (found, graph) = random_steps(seed, 0.5, 0.1, 30)
        started = GrowingClique.of_graph(graph)
        assert started.size == found.size
        np.testing.assert_array_equal(started.first(), found.first())
        row = np.arange(len(graph)) % 2 == 0
        for one in (started, found):
            one.add(row)
        np.testing.assert_array_equal(started.first(), found.first())


def test_a_copy_stays():
    *_, (found, graph) = random_steps(1, 0.5, 0.0, 20)
    twin = found.copy()
    found.add(np.ones(20, bool))
    found.remove(0)
    np.testing.assert_array_equal(twin.dense(), graph)
    np.testing.assert_array_equal(twin.first(), maximum_clique(graph).members)


def test_no_vertices():
    found = GrowingClique()
    assert (found.size, len(found), found.first().shape) == (0, 0, (0,))
    found.add(np.zeros(0, bool))
    found.remove(0)
    assert (found.size, found.dense().shape) == (0, (0, 0))
    assert repr(found) == "GrowingClique(0 vertices, largest clique 0)"
    assert GrowingClique.of_graph(np.zeros((0, 0), bool)).size == 0


def test_a_step_costs_a_bounded_search():
    """A graph whose proof takes minutes: each step stays small, and the bound is told."""
    generator = np.random.default_rng(0)
    found = GrowingClique()
    for count in range(150):
        found.add(generator.random(count) < 0.9)
    assert " to " in repr(found)


def test_the_largest_with_its_certificate():
    for seed in range(10):
        for found, graph in random_steps(seed, 0.7, 0.2, 30):
            if len(graph) % 3 == 0:
                batch, largest = maximum_clique(graph), found.largest(60.0)
                np.testing.assert_array_equal(largest.members, batch.members)
                certificate = largest.size, largest.optimal, largest.upper_bound
                assert certificate == (batch.size, True, batch.size)


def test_a_time_limit_gives_the_best_known_and_a_bound(monkeypatch):
    monkeypatch.setattr(growing, "STEPS", 0)
    *_, (found, graph) = random_steps(2, 0.8, 0.0, 60)
    early = found.largest(0.0)
    members = np.flatnonzero(early.members)
    assert graph[np.ix_(members, members)].sum() == len(members) * (len(members) - 1)
    batch = maximum_clique(graph)
    assert not early.optimal and early.size <= batch.size <= early.upper_bound
    np.testing.assert_array_equal(found.largest(60.0).members, batch.members)
    np.testing.assert_array_equal(found.first(), batch.members)


def test_a_graph_to_start_from_knows_a_clique_without_a_search():
    for seed in range(10):
        *_, (_, graph) = random_steps(seed, 0.7, 0.2, 45)
        known = GrowingClique.of_graph(graph).largest(0.0).members
        inside = graph[np.ix_(known, known)]
        assert inside.sum() == known.sum() * (known.sum() - 1)
        assert not graph[~known][:, known].all(axis=1).any()  # with whom another would agree


def test_a_clique_grows_by_an_exchange(monkeypatch):
    """The new vertex disagrees with one of those in hand; another one outside takes its place."""
    monkeypatch.setattr(growing, "SEARCHED", 0)
    found = GrowingClique()
    for row in ([], [1], [1, 1], [1, 1, 0]):
        found.add(np.array(row, bool))
    assert repr(found) == "GrowingClique(4 vertices, largest clique 3)"
    found.add(np.array([1, 1, 0, 1], bool))
    assert repr(found) == "GrowingClique(5 vertices, largest clique 4)"
    np.testing.assert_array_equal(np.flatnonzero(found.first()), [0, 1, 3, 4])
