"""The compiled search for many small graphs against the one-by-one search and by its own laws."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest
from sample_graphs import complete_multipartite, is_clique, planted_graph, random_graph

from pcm_jax.clique import batched, maximum_clique, maximum_clique_batched
from pcm_jax.clique._words import first, last, pack, precedes, single, unpack
from pcm_jax.errors import InputError

search = jax.jit(maximum_clique_batched)


def one_by_one(graphs: np.ndarray) -> np.ndarray:
    return np.stack([maximum_clique(graph).members for graph in graphs])


def assert_same_as_one_by_one(graphs: np.ndarray) -> None:
    found = search(graphs)
    expected = one_by_one(graphs)
    np.testing.assert_array_equal(found.members, expected)
    np.testing.assert_array_equal(found.size, expected.sum(axis=1))
    assert found.optimal.all()


def random_graphs(count: int, size: int, seed: int, densest: float = 1.0) -> np.ndarray:
    """Of all densities: many ties where there are few or many edges."""
    rng = np.random.default_rng(seed)
    upper = np.triu(rng.random((count, size, size)) < densest * rng.random((count, 1, 1)), 1)
    return upper | upper.transpose(0, 2, 1)


THOUSANDS = random_graphs(3000, 12, 0)


@pytest.mark.slow
def test_thousands_of_small_graphs():
    assert_same_as_one_by_one(THOUSANDS)


@pytest.mark.parametrize(
    ("size", "count", "densest"), [(1, 2, 1.0), (32, 300, 0.8), (130, 20, 0.4)]
)
def test_sizes_around_and_beyond_the_words(size, count, densest):
    assert_same_as_one_by_one(random_graphs(count, size, size, densest))


@pytest.mark.slow
def test_hubs_in_sparse_surroundings():
    """Branches that take fewer colours than they may: what is left is no other branch's."""
    rng = np.random.default_rng(33)
    hub = rng.random((6000, 33)) < 0.25
    density = np.where(hub[:, :, None] | hub[:, None], 0.5, 0.1)
    upper = np.triu(rng.random((6000, 33, 33)) < density, 1)
    assert_same_as_one_by_one(upper | upper.transpose(0, 2, 1))


@pytest.mark.slow
def test_padded_planted_random_empty_and_complete_graphs_of_64_nodes():
    graphs = np.zeros((603, 64, 64), bool)
    for seed, graph in enumerate(graphs[:400]):
        size = 24 + seed % 41
        graph[:size, :size] = planted_graph(size, 10 + seed % 6, 0.05 + seed / 1600, seed)
    graphs[400:600] = random_graphs(200, 64, 2, 0.7)
    graphs[600] = ~np.eye(64, dtype=bool)
    graphs[601] = complete_multipartite(16, 4)
    assert_same_as_one_by_one(graphs)
    assert np.flatnonzero(search(graphs).members[601]).tolist() == list(range(0, 64, 4))


@pytest.mark.slow
def test_without_64_bit_types():
    """Two words a set, as many as a set of 130 has with them."""
    graphs = random_graphs(200, 40, 6, 0.8)
    with jax.enable_x64(False):
        assert pack(jnp.ones((3, 40), bool)).shape == (2, 3)
        found = search(graphs)
    np.testing.assert_array_equal(found.members, one_by_one(graphs))


@pytest.mark.parametrize("lanes", [1, 3])
def test_any_number_of_lanes(lanes, monkeypatch):
    monkeypatch.setattr(batched, "_LANES", lanes)
    graphs = random_graphs(64, 16, 1)
    found = jax.jit(partial(maximum_clique_batched))(graphs)  # a new object: traced anew
    np.testing.assert_array_equal(found.members, one_by_one(graphs))
    assert found.optimal.all()


def test_only_valid_nodes_count():
    graphs = random_graphs(200, 20, 2)
    valid = np.random.default_rng(3).random((200, 20)) < 0.6
    valid[0] = False
    found = search(graphs, valid=valid)
    for graph, mask, members, size in zip(graphs, valid, found.members, found.size, strict=True):
        inside = np.flatnonzero(mask)
        expected = np.zeros(20, bool)
        expected[inside] = maximum_clique(graph[np.ix_(inside, inside)]).members
        np.testing.assert_array_equal(members, expected)
        assert size == expected.sum()


def test_diagonals_are_ignored():
    found = search(THOUSANDS | np.eye(12, dtype=bool))
    np.testing.assert_array_equal(found.members, search(THOUSANDS).members)


def test_leading_axes_and_nothing_to_search():
    flat, found = search(THOUSANDS), search(THOUSANDS.reshape(30, 100, 12, 12))
    assert found.members.shape == (30, 100, 12)
    assert found.size.shape == found.optimal.shape == (30, 100)
    np.testing.assert_array_equal(found.members.reshape(3000, 12), flat.members)
    one = search(THOUSANDS[2])
    assert one.size.shape == one.optimal.shape == ()
    np.testing.assert_array_equal(one.members, flat.members[2])
    empty = search(np.zeros((4, 0, 0), bool))
    assert empty.members.shape == (4, 0)
    assert empty.size.tolist() == [0] * 4
    assert empty.optimal.all()
    assert search(np.zeros((0, 5, 5), bool)).members.shape == (0, 5)


def test_a_mapped_axis_joins_the_batch():
    graphs = random_graphs(12, 11, 8)
    masks = np.random.default_rng(8).random((3, 11)) < 0.7

    def members(graph, valid):
        return maximum_clique_batched(graph, valid=valid).members

    mapped = jax.vmap(jax.vmap(members, in_axes=(0, None)), in_axes=(None, 0))
    program = str(jax.make_jaxpr(mapped)(graphs, masks))
    assert "bool[36,11,11]" in program
    assert "callback" not in program
    inside = masks[:, None, :, None] & masks[:, None, None]
    expected = one_by_one((graphs & inside).reshape(36, 11, 11)).reshape(3, 12, 11)
    np.testing.assert_array_equal(jax.jit(mapped)(graphs, masks), expected)


def test_graphs_without_enough_steps_are_marked():
    graphs = np.stack([random_graph(64, 0.7, seed) for seed in range(20)])
    graphs[3] = planted_graph(64, 12, 0.05, 3)
    bounded = jax.jit(lambda graphs, steps: maximum_clique_batched(graphs, max_steps=steps))
    steps = np.full(20, 200)
    steps[7] = 2**30
    found = bounded(graphs, steps)
    assert found.optimal.tolist() == [index in (3, 7) for index in range(20)]
    expected = one_by_one(graphs)
    np.testing.assert_array_equal(np.asarray(found.members)[[3, 7]], expected[[3, 7]])
    sizes = np.asarray(found.size)
    assert (sizes <= expected.sum(axis=1)).all()
    assert (sizes < expected.sum(axis=1)).any()
    for graph, members, size in zip(graphs, np.asarray(found.members), sizes, strict=True):
        assert is_clique(graph, members)
        assert members.sum() == size > 5


@pytest.mark.parametrize("size", [5, 32, 40, 100])
def test_sets_of_words(size):
    masks = np.random.default_rng(size).random((2, 50, size)) < 0.3
    masks[..., size // 2] = True
    left, right = (pack(jnp.asarray(mask)) for mask in masks)
    np.testing.assert_array_equal(unpack(left, size), masks[0])
    np.testing.assert_array_equal(first(left), masks[0].argmax(axis=1))
    np.testing.assert_array_equal(last(left), size - 1 - masks[0][:, ::-1].argmax(axis=1))
    np.testing.assert_array_equal(unpack(single(first(left), left), size).sum(axis=1), 1)
    expected = [tuple(~mine) < tuple(~theirs) for mine, theirs in zip(*masks, strict=True)]
    np.testing.assert_array_equal(precedes(left, right), expected)


def test_sizes_equal_networkx():
    graphs = map(nx.from_numpy_array, THOUSANDS[:200])
    expected = [nx.max_weight_clique(graph, weight=None)[1] for graph in graphs]
    np.testing.assert_array_equal(search(THOUSANDS).size[:200], expected)


@pytest.mark.parametrize(
    ("graphs", "message"),
    [
        (np.zeros((2, 3, 4), bool), r"graphs: bool \[2, 3, 4\], expected square matrices"),
        (np.zeros(3, bool), r"graphs: bool \[3\], expected square matrices"),
        (np.zeros((3, 3)), r"graphs: float64 \[3, 3\], expected square matrices, bool"),
    ],
)
def test_bad_graphs_are_named(graphs, message):
    with pytest.raises(InputError, match=message):
        maximum_clique_batched(graphs)
