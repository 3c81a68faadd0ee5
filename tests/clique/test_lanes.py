"""The search on lanes answers as the one by one does, whenever it begins and ends."""

from __future__ import annotations

import itertools
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import networkx as nx
import numpy as np
import pytest
from sample_graphs import complete_multipartite, is_clique, johnson_graph, random_graph

from pcm_jax.clique import CliqueInterrupt, maximum_clique
from pcm_jax.clique import _exact as exact
from pcm_jax.clique import _lanes as lanes
from pcm_jax.clique import _subgraphs as subgraphs
from pcm_jax.clique._colouring import Colourings
from pcm_jax.clique._exact import BitGraph, largest_clique
from pcm_jax.clique._subgraphs import Subgraphs

NODES_ONLY: Any = None  # as networkx's documentation says, which its stubs do not know
ONE_BY_ONE = {"_VISITS": 10**9, "_WORTH_LANES": np.inf}
# From the start; few lanes and little room, so that what is rare comes often; as it is.
ON_LANES = [
    {"_VISITS": 1, "_WORTH_LANES": 0, "_FEW": 1},
    {"_VISITS": 2, "_WORTH_LANES": 0, "_WORDS": 12, "_STEPS": 3, "_BYTES": 60_000, "_LOOKS": 1},
    {"_VISITS": 3, "_WORTH_LANES": 0, "MOST_WORDS": 1, "_STEPS": 1, "_FEW": 4, "_LOOKS": 0},
]


def set_up(monkeypatch, **constants):
    for name, value in constants.items():
        module = next(each for each in (exact, lanes, subgraphs) if hasattr(each, name))
        monkeypatch.setattr(module, name, value)


@pytest.fixture
def runs(monkeypatch):
    """The words of all lanes that ran."""
    seen, run = [], lanes.Lanes.run

    def counted(self, *arguments):
        seen.append(self.words)
        return run(self, *arguments)

    monkeypatch.setattr(lanes.Lanes, "run", counted)
    return seen


def graphs(number: int):
    generator = np.random.default_rng(7)
    for seed in range(number):
        size = int(generator.integers(1, 70 if seed % 8 else 140))
        adjacency = random_graph(size, generator.random() * (1.0 if size < 70 else 0.7), seed)
        if seed % 3 == 0:
            chosen = generator.permutation(size)[: 1 + size // 4]
            adjacency[np.ix_(chosen, chosen)] = True
            np.fill_diagonal(adjacency, False)
        yield seed, adjacency


@pytest.mark.slow
@pytest.mark.parametrize("constants", ON_LANES)
def test_members_are_those_of_the_search_one_by_one(monkeypatch, runs, constants):
    for seed, adjacency in graphs(120):
        squared = np.random.default_rng(seed).random(adjacency.shape) if seed % 4 == 0 else None
        set_up(monkeypatch, **ONE_BY_ONE)
        expected = maximum_clique(adjacency, tie_break=squared)
        set_up(monkeypatch, **constants)
        clique = maximum_clique(adjacency, tie_break=squared)
        assert (clique.members == expected.members).all(), seed
        assert clique.optimal
        assert clique.upper_bound == clique.size
        if len(adjacency) < 40:
            theirs = nx.max_weight_clique(nx.from_numpy_array(adjacency), weight=NODES_ONLY)
            assert clique.size == theirs[1], seed
    assert len(runs) > 100
    assert set(runs) >= ({1} if constants.get("MOST_WORDS") == 1 else {1, 2})


@pytest.mark.parametrize(("density", "seed"), [(0.5, 0), (0.5, 1), (0.6, 2)])
def test_lanes_at_work_find_what_has_moved_to_make_room(monkeypatch, density, seed):
    moved, forget = [], lanes.Lanes._forget

    def counted(self):
        moved.append(self._busy.any())
        forget(self)

    monkeypatch.setattr(lanes.Lanes, "_forget", counted)
    adjacency = random_graph(100, density, seed)
    set_up(monkeypatch, **ONE_BY_ONE)
    expected = maximum_clique(adjacency)
    assert not moved
    set_up(monkeypatch, **ON_LANES[1] | {"_BYTES": 20_000})
    clique = maximum_clique(adjacency)
    assert any(moved)
    assert clique.members.tolist() == expected.members.tolist()
    theirs = nx.max_weight_clique(nx.from_numpy_array(adjacency), weight=NODES_ONLY)
    assert clique.optimal and clique.size == theirs[1]


def test_a_hard_graph_is_left_to_lanes_and_an_easy_one_is_not(runs):
    adjacency = random_graph(150, 0.7, 5)
    assert maximum_clique(adjacency).optimal
    assert runs
    runs.clear()
    assert maximum_clique(complete_multipartite(40, 3)).optimal
    assert maximum_clique(random_graph(60, 0.5, 1)).optimal
    assert not runs


@pytest.mark.parametrize("words", range(1, 7))
def test_sets_of_every_number_of_words(monkeypatch, words):
    set_up(monkeypatch, _FEW=1)
    adjacency = random_graph(64 * words, 0.2, words)
    graph, best = BitGraph(adjacency), lanes.Best(2)
    whole = lanes.Part([], graph.everything)
    assert lanes.Lanes(graph, words, best).run(iter([whole]), np.inf) == []
    assert best.labels is not None
    assert len(best.labels) == maximum_clique(adjacency).size
    assert is_clique(adjacency, np.isin(np.arange(64 * words), graph.vertices_of(best.labels)))


def test_larger_cliques_are_found_on_the_way_and_the_ceiling_ends_it(monkeypatch, runs):
    set_up(monkeypatch, **ON_LANES[0])
    adjacency = random_graph(90, 0.7, 3)
    size, graph = maximum_clique(adjacency).size, BitGraph(adjacency)
    for floor in range(size + 1):
        labels = largest_clique(graph, graph.everything, floor).labels
        if floor == size:
            assert labels is None
            break
        assert labels is not None
        assert len(labels) == size
        assert is_clique(adjacency, np.isin(np.arange(90), graph.vertices_of(labels)))
    for ceiling in range(3, size + 1):
        found = largest_clique(graph, graph.everything, 1, ceiling=ceiling).labels
        assert found is not None
        assert len(found) == ceiling
    assert runs


def test_only_cliques_with_a_member_among_some_are_looked_for(monkeypatch, runs):
    adjacency = random_graph(60, 0.6, 2)
    graph = BitGraph(adjacency)
    for constants in (ONE_BY_ONE, ON_LANES[0]):
        set_up(monkeypatch, **constants)
        for labels in ([1], [20, 30], [5, 6, 7, 50]):
            among = sum(graph.single[label] for label in labels)
            found = largest_clique(graph, graph.everything, 0, among=among).labels
            sizes = []
            for vertex in graph.vertices_of(labels):
                inside = np.append(np.flatnonzero(adjacency[vertex]), vertex)
                theirs = nx.from_numpy_array(adjacency[np.ix_(inside, inside)])
                sizes.append(nx.max_weight_clique(theirs, weight=NODES_ONLY)[1])
            assert found is not None
            assert len(found) == max(sizes)
            assert set(found) & set(labels)
    assert runs


@pytest.mark.slow
def test_wherever_time_runs_out_larger_cliques_are_inside_what_is_unsettled(monkeypatch, runs):
    adjacency = random_graph(70, 0.7, 4)
    size, graph = maximum_clique(adjacency).size, BitGraph(adjacency)
    for constants in ON_LANES:
        set_up(monkeypatch, **constants)
        stopped, reading = True, 0
        while stopped:
            clock = itertools.count()
            monkeypatch.setattr(exact, "perf_counter", clock.__next__)
            monkeypatch.setattr(lanes, "perf_counter", clock.__next__)
            outcome = largest_clique(graph, graph.everything, size - 2, deadline=reading)
            stopped, found = bool(outcome.unsettled), len(outcome.labels or [0])
            assert found == size or stopped
            inside = graph.vertices_of(graph.members(outcome.unsettled))
            rest = nx.from_numpy_array(adjacency[np.ix_(inside, inside)])
            assert found == size or nx.max_weight_clique(rest, weight=NODES_ONLY)[1] == size
            assert next(clock) <= reading + 8
            reading = 1 + reading * 6 // 5
        assert found == size
    assert runs


@pytest.mark.parametrize("kind", ["plain", "weights", "tie_break"])
def test_an_interrupt_brings_the_best_clique_so_far(monkeypatch, kind):
    adjacency = random_graph(110, 0.7, 6)
    generator = np.random.default_rng(0)
    options: dict[str, Any] = {
        "plain": {},
        "weights": {"weights": generator.integers(1, 9, 110)},
        "tie_break": {"tie_break": generator.random((110, 110))},
    }[kind]
    full = maximum_clique(adjacency, **options)
    weights = []
    for module, reading in [("_heuristic", 1), ("_local_search", 9), ("_ties", 3), ("_lanes", 9)]:
        clock = itertools.count()

        def interrupted(clock=clock, reading=reading):
            if next(clock) == reading:
                raise KeyboardInterrupt
            return 0.0

        with monkeypatch.context() as patch:
            patch.setattr(f"pcm_jax.clique.{module}.perf_counter", interrupted)
            try:
                maximum_clique(adjacency, **options)
            except KeyboardInterrupt as interrupt:
                assert isinstance(interrupt, CliqueInterrupt)
                clique = interrupt.clique
                assert is_clique(adjacency, clique.members)
                assert clique.weight <= full.weight <= clique.weight_bound
                weights.append(clique.weight)
    assert weights
    assert max(weights) > 0


def test_ctrl_c_ends_a_search_that_is_on_lanes(monkeypatch):
    if threading.current_thread() is not threading.main_thread():
        pytest.skip("signals reach the main thread only")
    advance, looks = Colourings.advance, itertools.count()

    def pressed(self, *arguments):
        if next(looks) == 5:
            signal.raise_signal(signal.SIGINT)
        advance(self, *arguments)

    monkeypatch.setattr(Colourings, "advance", pressed)
    adjacency = random_graph(150, 0.7, 5)
    # A shell that runs tests in the background has the signal ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(CliqueInterrupt) as caught:
            maximum_clique(adjacency)
    finally:
        signal.signal(signal.SIGINT, before)
    assert is_clique(adjacency, caught.value.clique.members)
    monkeypatch.undo()
    assert maximum_clique(adjacency).optimal


def test_threads_do_not_share_lanes():
    adjacencies = [random_graph(120, 0.7, seed) for seed in range(4)]
    expected = [maximum_clique(adjacency).members for adjacency in adjacencies]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda adjacency: maximum_clique(adjacency).members, adjacencies))
    assert (np.array(found) == np.array(expected)).all()


@pytest.mark.parametrize("words", [1, 2, 3])
def test_subgraphs_are_those_of_the_graph_and_move_together(words):
    adjacency = random_graph(220, 0.5, words)
    graph, generator = BitGraph(adjacency), np.random.default_rng(words)
    kept, sets = Subgraphs(graph, words), []
    for count in (1, 7, 8, 64 * words - 1, 64 * words):
        chosen = generator.permutation(np.arange(1, 221))[:count]
        sets.append(sum(graph.single[label] for label in chosen))
    columns, offsets = kept.add(sets)
    assert [int(column) for column in offsets] == [k * kept.width for k in range(5)]
    kept.keep(np.array([0, 2, 4]))
    for slot, column in enumerate((0, 2, 4)):
        labels = kept.labels(slot * kept.width, columns[:, column])
        assert sum(graph.single[label] for label in labels) == sets[column]
        vertices = graph.vertices_of(labels)
        rows = kept.strangers[:, slot * kept.width + kept.row[: len(labels)]]
        octets = np.ascontiguousarray(rows.T).view(np.uint8)
        strangers = np.unpackbits(octets, axis=1, bitorder="little").astype(bool)
        near = adjacency[np.ix_(vertices, vertices)] | np.eye(len(labels), dtype=bool)
        assert (strangers[:, : len(labels)] == ~near).all()
        assert not strangers[:, len(labels) :].any()
        degree = near.sum(axis=1)
        assert (np.diff(degree) <= 0).all()


def test_classes_are_counted_in_an_octet_and_do_not_wrap():
    lanes, classes = np.arange(5), np.array([1, 2, 256, 257, 5000])
    colourings = Colourings(1)
    colourings.rearrange(np.zeros(0, np.int64), 5)
    colourings.start(lanes, np.ones((1, 5), np.uint64), np.zeros(5, np.uint64), classes)
    assert colourings.left.tolist() == [0, 1, 255, 255, 255]


@pytest.mark.parametrize("words", [1, 2, 4])
def test_lanes_colour_as_a_greedy_colouring_from_the_lowest_place_does(words):
    width, generator = 64 * words, np.random.default_rng(words)
    adjacency = random_graph(width, 0.6, words)
    graph = BitGraph(adjacency)
    subgraphs = Subgraphs(graph, words)
    ((column,), (offset,)) = [each.T for each in subgraphs.add([graph.everything])]
    order = graph.vertices_of(subgraphs.labels(int(offset), column))
    near = adjacency[np.ix_(order, order)]
    chosen = generator.random((50, width)) < generator.random((50, 1))
    octets = np.packbits(chosen, axis=1, bitorder="little")
    sets = np.ascontiguousarray(octets).view(np.uint64).T
    classes = generator.integers(1, 12, 50)
    colourings = Colourings(words)
    colourings.rearrange(np.zeros(0, np.int64), 50)
    colourings.start(np.arange(50), sets, np.full(50, offset, np.uint64), classes)
    colourings.advance(subgraphs.strangers, 2 * width)
    left = np.ascontiguousarray(colourings.open.T).view(np.uint8)
    left = np.unpackbits(left, axis=1, bitorder="little").astype(bool)
    for members, number, rest in zip(chosen, classes, left, strict=True):
        uncoloured = members.copy()
        for _ in range(number):
            class_: list[int] = []
            for place in np.flatnonzero(uncoloured):
                if not near[place, class_].any():
                    class_.append(int(place))
            uncoloured[class_] = False
        assert (rest == uncoloured).all()


def test_regular_graphs_of_known_clique_number(monkeypatch, runs):
    set_up(monkeypatch, **ON_LANES[0])
    assert maximum_clique(johnson_graph(12)).size == 6
    assert runs
