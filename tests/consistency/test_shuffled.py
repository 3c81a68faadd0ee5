"""Shuffled closures, against Q of closures that are shuffled before it is made."""

import dataclasses

import numpy as np
import pytest

from pcm_jax import MultiRobotGraph, chi2_gate, consistency_graph, lie, squared_mahalanobis, weigh
from pcm_jax.consistency import shuffled
from pcm_jax.lie import unrolled
from pcm_jax.simulation import simulate_city, simulate_sessions

WORLDS = {"SE2": simulate_city, "SE3": simulate_sessions}
COUNT = 40


@pytest.fixture(scope="module", params=WORLDS)
def pair(request):
    """Drift large enough that shuffled closures do agree now and then."""
    world = WORLDS[request.param](
        seed=3,
        poses=60,
        inliers=10,
        aliased_groups=0,
        random=COUNT - 10,
        sigma_translation=0.3,
        sigma_rotation=0.15,
    )
    (pair,) = weigh(world.graph).pairs
    return pair


@pytest.fixture
def order():
    generator = np.random.default_rng(0)
    return generator.permuted(np.tile(np.arange(COUNT), (6, 1)), axis=1)


def gate_of(pair):
    return float(chi2_gate(0.99, pair.measured.tangent_dim))


def of_shuffled_closures(pair, order):
    """The slow, obvious form: all of Q, of the problem with its measurements reordered."""
    problem = pair.problem()
    size = len(problem.valid)
    padded = np.concatenate([order, np.full(size - COUNT, order[-1])])
    shuffled = dataclasses.replace(
        problem,
        measurement=lie.take(problem.measurement, padded),
        measurement_covariance=np.asarray(problem.measurement_covariance)[padded],
    )
    return np.asarray(squared_mahalanobis(shuffled))


def dense(pairs):
    squared = np.zeros((COUNT, COUNT))
    squared[pairs.u, pairs.v] = pairs.squared
    return squared + squared.T


@pytest.mark.parametrize("share", [2.0, 0.0], ids=["some pairs", "all pairs, compiled"])
def test_weighs_what_q_of_shuffled_closures_weighs(pair, order, share, monkeypatch):
    monkeypatch.setattr(shuffled, "DENSE", share)
    monkeypatch.setenv("PCM_JAX_COMPILE", "always")
    gate = gate_of(pair)
    found = pair.shuffles(gate).weigh(order)
    edges = 0
    for number, each in enumerate(order):
        squared = of_shuffled_closures(pair, each)
        graph = np.asarray(consistency_graph(squared, gate))
        expected = np.where(graph, np.maximum(squared, squared.T), 0.0)
        np.testing.assert_allclose(dense(found.of(number)), expected, rtol=1e-9)
        edges += graph.sum() // 2
    assert edges > 10  # there is something to compare


def test_compiles_once_dense_shuffles_have_cost_as_much(pair, order, monkeypatch):
    monkeypatch.setattr(shuffled, "DENSE", 0.0)
    shuffles = pair.shuffles(gate_of(pair))
    shuffles.weigh(order[:1])
    monkeypatch.setattr("pcm_jax.compiling.SECONDS_TO_COMPILE", 2.5 * shuffles._seconds)
    asked, kernel = [], shuffled.limits_of
    monkeypatch.setattr(shuffled, "limits_of", lambda p: asked.append(p) or kernel(p))
    one_by_one = [shuffles.weigh(order[:1]) for _ in range(3)]
    assert len(asked) == 2
    for one in one_by_one:
        np.testing.assert_allclose(dense(one), dense(one_by_one[0]), rtol=1e-9)


def test_the_given_order_is_the_evidence_itself(pair):
    found = dense(pair.shuffles(gate_of(pair)).weigh(np.arange(COUNT)[None]))
    np.testing.assert_array_equal(found > 0, pair.consistent(gate_of(pair)))


@pytest.mark.parametrize("share", [2.0, 0.0], ids=["some pairs", "all pairs, compiled"])
def test_only_pairs_of_interest_are_joined(pair, order, share, monkeypatch):
    monkeypatch.setattr(shuffled, "DENSE", share)
    monkeypatch.setenv("PCM_JAX_COMPILE", "always")
    joined = np.random.default_rng(1).uniform(size=(COUNT, COUNT)) < 0.5
    joined |= joined.T
    every = pair.shuffles(gate_of(pair)).weigh(order[:1])
    some = pair.shuffles(gate_of(pair), joined=joined).weigh(order[:1])
    np.testing.assert_array_equal(dense(some), dense(every) * joined)


def test_cliques_of_the_size_asked_for_are_kept(pair, order):
    shuffles = pair.shuffles(gate_of(pair))
    orders = np.vstack([np.arange(COUNT), order])
    every, peeled = shuffles.weigh(orders), shuffles.weigh(orders, at_least=4)
    for number in range(len(orders)):
        squared = dense(every.of(number))
        # The core by definition: closures of fewer than 3 neighbours leave, until none does.
        core = np.ones(COUNT, bool)
        while (low := core & (((squared > 0) & core).sum(axis=1) < 3)).any():
            core &= ~low
        some = dense(peeled.of(number))
        np.testing.assert_array_equal(some[np.ix_(core, core)], squared[np.ix_(core, core)])
        exact = every.of(number).peeled(4)
        np.testing.assert_array_equal(dense(exact), squared * (core & core[:, None]))
    assert len(shuffles.weigh(orders, at_least=COUNT + 1).u) == 0


def test_some_closures_alone(pair, order):
    among = np.arange(0, COUNT, 2)
    full = dense(pair.shuffles(gate_of(pair)).weigh(np.arange(COUNT)[None]))
    part = pair.shuffles(gate_of(pair), among).weigh(np.arange(len(among))[None])
    squared = np.zeros((len(among), len(among)))
    squared[part.u, part.v] = part.squared
    np.testing.assert_allclose(squared + squared.T, full[np.ix_(among, among)], rtol=1e-9)


def test_a_metric_of_ones_own_is_shuffled_too(pair, order):
    def metric(map_a, map_b, closures):
        where = lie.translation(lie.as_numpy(closures.measurement))
        return ((where[:, None] - where) ** 2).sum(axis=-1)

    graph = MultiRobotGraph(pair.maps, pair.measured)
    (own,) = weigh(graph, metric=metric, optimized=True).pairs
    found = own.shuffles(4.0).weigh(order)
    where = lie.translation(lie.as_numpy(pair.measured.measurement))
    for number, each in enumerate(order):
        squared = ((where[each][:, None] - where[each]) ** 2).sum(axis=-1)
        expected = np.where((squared <= 4.0) & ~np.eye(COUNT, dtype=bool), squared, 0.0)
        np.testing.assert_allclose(dense(found.of(number)), expected)


def test_closures_that_are_not_finite_agree_with_nothing(pair):
    values = np.array(lie.parameters(lie.as_numpy(pair.measured.measurement)))
    values[4] = np.nan
    measurement = lie.group_of(pair.measured.measurement)(values)
    measured = dataclasses.replace(pair.measured, measurement=measurement)
    broken = dataclasses.replace(pair, measured=measured)
    found = broken.shuffles(gate_of(pair)).weigh(np.arange(COUNT)[None])
    assert not ((found.u == 4) | (found.v == 4)).any()
    assert len(found.u)


def test_largest_eigenvalues_are_numpys(pair):
    random = np.random.default_rng(0).normal(size=(200, 3, 3))
    matrices = random @ random.swapaxes(1, 2)
    matrices[:3] = np.eye(3), np.zeros((3, 3)), np.diag([2.0, 2.0, 1.0])
    row, column = np.transpose(unrolled.packed_indices(3))
    found = shuffled._largest_eigenvalue(list(matrices[:, row, column].T))
    np.testing.assert_allclose(found, np.linalg.eigvalsh(matrices)[:, -1], atol=1e-9)
