"""`GrowingPair`: rows of the consistency graph as closures come, against all of it at once."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.consistency import GrowingPair, chi2_gate
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.lie import unrolled
from pcm_jax.mapping import MapCovariance
from pcm_jax.pipeline import weigh
from pcm_jax.simulation import simulate_city, simulate_sessions

WORLDS = {
    "SE2": lambda: simulate_city(seed=1, poses=60, robots=2, inliers=25, random=30),
    "SE3": lambda: simulate_sessions(seed=1, poses=60, sessions=2, inliers=20, random=25),
}


@pytest.fixture(scope="module", params=sorted(WORLDS))
def pair(request):
    return weigh(WORLDS[request.param]().graph).pairs[0]


def gate_of(pair) -> float:
    return float(chi2_gate(0.99, pair.measured.tangent_dim))


def grown(pair, closures=None):
    """The graph, closure by closure."""
    closures = pair.measured if closures is None else closures
    found = GrowingPair(pair.covariances, gate_of(pair))
    graph = np.zeros((len(closures), len(closures)), bool)
    for row in range(len(closures)):
        graph[row, :row] = graph[:row, row] = found.agreeing(closures[[row]])
        found.append()
    assert len(found) == len(closures)
    return found, graph


def test_rows_are_those_of_the_whole_graph(pair):
    _, graph = grown(pair)
    assert 20 < graph.sum() < graph.size / 2
    np.testing.assert_array_equal(graph, pair.consistent(gate_of(pair)))


def test_compiled_rows_are_the_same(pair, monkeypatch):
    monkeypatch.setenv("PCM_JAX_COMPILE", "always")
    monkeypatch.setattr("pcm_jax.consistency.growing.AT_ONCE", 16)
    _, graph = grown(pair, pair.measured[:40])
    np.testing.assert_array_equal(graph, pair.consistent(gate_of(pair))[:40, :40])


def test_squared_distances_are_the_same_and_bounds_below_them(pair):
    found = GrowingPair(pair.covariances, gate_of(pair))
    apart = 0
    for row in range(len(pair)):
        new, old = found._one(pair.measured[[row]]), found._numbers[:, :row]
        both = found._row(old, new, found._sides(old, new, found._poses[:, :row]))
        bound = found._row(old, new, found._bounds(old, new))
        np.testing.assert_allclose(both[0], pair.squared[:row, row], rtol=1e-8)
        np.testing.assert_allclose(both[1], pair.squared[row, :row], rtol=1e-8)
        assert (bound <= both * (1.0 + 1e-9)).all()
        apart += np.count_nonzero((bound > found.gate).any(axis=0))
        found._next = new
        found.append()
    assert apart > len(pair) * (len(pair) - 1) / 10


def test_a_closure_apart_from_all_takes_no_column(pair, monkeypatch):
    found, _ = grown(pair)
    asked = []
    monkeypatch.setattr(MapCovariance, "column", lambda *which: asked.append(which))
    far = pair.measured[[0]]
    values = np.array(lie.parameters(far.measurement))
    values[:, -1] += 1e6
    far = dataclasses.replace(far, measurement=far.group(values))
    assert not found.agreeing(far).any()
    assert not asked


def test_taken_in_together(pair):
    found = GrowingPair(pair.covariances, gate_of(pair))
    found.take_in(pair.measured[:-1])
    last = found.agreeing(pair.measured[[-1]])
    np.testing.assert_array_equal(last, pair.consistent(gate_of(pair))[-1, :-1])


def test_removed_and_copied(pair):
    found, _ = grown(pair)
    twin = found.copy()
    kept = np.arange(len(pair)) % 3 != 0
    for row in np.flatnonzero(~kept)[::-1]:
        found.remove(int(row))
    expected = pair.consistent(gate_of(pair))[-1]
    np.testing.assert_array_equal(found.agreeing(pair.measured[[-1]])[:-1], expected[kept][:-1])
    np.testing.assert_array_equal(twin.agreeing(pair.measured[[-1]])[:-1], expected[:-1])


@pytest.mark.parametrize("name", sorted(WORLDS))
def test_closures_that_leave_directions_unsaid(name):
    graph = WORLDS[name]().graph
    information = np.array(graph.closures.information)
    d = information.shape[-1]
    for first, axes in ((0, [d - 1]), (1, [0, d - 1])):
        information[first::3, axes, :] = 0.0
        information[first::3, :, axes] = 0.0
    closures = dataclasses.replace(graph.closures, information=information)
    pair = weigh(dataclasses.replace(graph, closures=closures)).pairs[0]
    assert len(np.unique(pair.freedom)) > 2
    _, found = grown(pair)
    np.testing.assert_array_equal(found, pair.consistent(gate_of(pair)))


def test_lengths_tell_no_more_apart_than_the_bound(pair):
    found, _ = grown(pair)
    told = 0
    for row in range(1, len(pair)):
        new, old = found._one(pair.measured[[row]]), found._numbers[:, :row]
        squared, largest = found._lengths(found._reach[:, :row], new.reach)
        bound = found._row(old, new, found._bounds(old, new))
        assert (squared / largest <= bound.min(axis=0) * (1.0 + 1e-9)).all()
        told += np.count_nonzero(squared > found.gate * largest)
    assert told > len(pair) * (len(pair) - 1) / 20


def test_lengths_hold_for_errors_that_add_up(pair):
    """Map b's errors of one kind each, a turn that moves a place along with or against its own."""
    found, generator = GrowingPair(pair.covariances, gate_of(pair)), np.random.default_rng(0)
    group, dim, count = pair.measured.group, pair.measured.tangent_dim, 4000
    row, column = np.transpose(unrolled.packed_indices(dim))
    tangent: Any = 3.0 * generator.standard_normal((count, dim))
    placed: Any = lie.as_numpy(lie.exp(group, tangent))
    kind = generator.standard_normal((count, dim)) * np.where(np.arange(dim) < dim / 2, 2.0, 1.0)
    numbers = np.zeros((len(found._numbers), count))
    numbers[found._parts[0]] = lie.parameters(placed).T
    numbers[found._parts[3]] = (kind[:, row] * kind[:, column]).T
    reach = found._reach_of(numbers)
    u, v = np.arange(count // 2), np.arange(count // 2, count)
    squared, largest = found._lengths(reach[:, u], reach[:, v])
    apart = lie.translation(lie.compose(lie.take(placed, v), lie.inverse(lie.take(placed, u))))
    np.testing.assert_allclose(squared, np.sum(apart**2, axis=1))
    space, length = apart.shape[1], np.linalg.norm(lie.translation(placed), axis=1)
    nearer = np.where(length[u] < length[v], u, v)
    turned = np.asarray(lie.adjoint(lie.take(placed, nearer)))[:, :space]
    moved = [np.einsum("eij,ej->ei", turned, kind[side]) for side in (u, v)]
    block = 2.0 * sum(each[:, :, None] * each[:, None, :] for each in moved)
    ratio = np.linalg.eigvalsh(block)[:, -1] / largest
    assert 0.7 < ratio.max() <= 1.0 + 1e-9


def test_maps_known_for_certain(pair):
    """Bounds are then the distances themselves."""
    maps = [
        dataclasses.replace(one, information=1e12 * np.asarray(one.information))
        for one in (each.pose_graph for each in pair.covariances)
    ]
    closures = pair.measured
    graph = MultiRobotGraph(tuple(maps), closures)
    whole: Any = weigh(graph, optimized=True).pairs[0]
    gate = float(np.quantile(whole.squared[np.triu_indices(len(closures), 1)], 0.4))
    found = GrowingPair(whole.covariances, gate)
    for row in range(len(closures)):
        agrees = found.agreeing(closures[[row]])
        np.testing.assert_array_equal(agrees, whole.consistent(gate)[row, :row])
        found.append()
