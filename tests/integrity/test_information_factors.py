"""Factors on information: the likelihood they maximise, worlds whose noise is known, words."""

import copy
import dataclasses
import pickle
from types import SimpleNamespace

import numpy as np
import pytest

import pcm_jax
from pcm_jax import chi2_gate, lie
from pcm_jax.errors import InputError
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.integrity import variance_components as components
from pcm_jax.integrity.calibration import Factor, _how, closing_edges, scaled_graph
from pcm_jax.integrity.variance_components import (
    SAMPLES,
    Part,
    _Cut,
    _Score,
    scaled_information,
    variance_components,
)
from pcm_jax.mapping import optimize
from pcm_jax.mapping._linearization import linearize
from pcm_jax.mapping.least_squares import padded_edges
from pcm_jax.mapping.optimization import host_arrays
from pcm_jax.merging._innovation import squared_by_leaving
from pcm_jax.simulation import simulate_city

STATED = np.array([4.0, 0.25, 9.0, 0.5])
"""Factors by which the worlds below understate (or overstate) their information."""


@pytest.fixture(scope="module")
def city():
    return simulate_city(seed=1, poses=120)


@pytest.fixture(scope="module")
def misstated(city):
    return scaled_graph(city.graph, 1.0 / STATED)


@pytest.fixture(scope="module")
def calibration(city, misstated):
    return pcm_jax.calibrate(misstated, city.is_true)


def restricted_log_likelihood(graph, closing, variance):
    """The logarithm of the density of all contrasts that the poses do not enter; dense."""
    tail, head, measurement, information = host_arrays(graph)
    identity = np.broadcast_to(np.eye(3), information.shape)
    edges = padded_edges(tail, head, measurement, identity, size=len(tail))
    linear = linearize(lie.as_numpy(graph.poses), edges)
    jacobian = np.zeros((3 * len(tail), 3 * graph.num_poses))
    for part, ends in ((linear.tail, tail), (linear.head, head)):
        for edge, pose in enumerate(ends):
            rows, columns = (slice(3 * k, 3 * k + 3) for k in (edge, pose))
            jacobian[rows, columns] += np.asarray(part)[:, :, edge]
    _, _, right = np.linalg.svd(jacobian[:, 3:].T)
    contrasts = right[3 * graph.num_poses - 3 :]
    scaled = np.linalg.inv(scaled_information(information, closing, 1.0 / variance))
    total = np.zeros((3 * len(tail),) * 2)
    for edge, block in enumerate(scaled):
        total[3 * edge : 3 * edge + 3, 3 * edge : 3 * edge + 3] = block
    covariance = contrasts @ total @ contrasts.T
    misfit = contrasts @ np.asarray(linear.residual).T.ravel()
    _, volume = np.linalg.slogdet(covariance)
    return -0.5 * (volume + misfit @ np.linalg.solve(covariance, misfit))


def test_no_other_factors_are_likelier():
    one = simulate_city(seed=4, poses=80).graph.maps[0]
    closing = closing_edges(one)
    one = optimize(one).graph
    found = variance_components([Part(one, closing, closing & False)])
    assert found.converged
    best = restricted_log_likelihood(one, closing, found.variance)
    for kind in range(4):
        for times in (0.5, 2.0):
            other = found.variance.copy()
            other[kind] *= times
            assert restricted_log_likelihood(one, closing, other) < best


def test_known_factors_lie_in_their_intervals(calibration):
    assert calibration.components.converged
    for factor, stated in zip(calibration.factors, STATED, strict=True):
        low, high = factor.interval
        assert 0.9 * low < stated < 1.1 * high
        assert 0.7 < factor / stated < 1.4


def test_a_cut_leaves_the_mean_and_the_variance_of_what_passes():
    """Of a part of a vector, two numbers of three, whose square is cut off as a whole."""
    rng = np.random.default_rng(5)
    drawn = rng.normal(size=(400_000, 3))
    gate = 4.0
    passed = drawn[(drawn**2).sum(axis=1) <= gate]
    halves = np.stack([(drawn[:, :2] ** 2).sum(axis=1), drawn[:, 2] ** 2], axis=-1)[:, None]
    cut = _Cut.at(np.array([gate]), 3).of(halves)[:, 0]
    left = np.stack([(passed[:, :2] ** 2).sum(axis=1), passed[:, 2] ** 2], axis=-1)
    np.testing.assert_allclose(cut.mean(axis=0), left.mean(axis=0), rtol=0.01)
    np.testing.assert_allclose(cut.var(axis=0), left.var(axis=0), rtol=0.02)
    wide = _Cut.at(np.array([np.inf]), 3).of(halves)
    np.testing.assert_allclose(wide, halves, atol=1e-12)


def test_tails_are_the_edges_own_variance_over_the_simulated_one():
    """Of two maps together; what spreads less than simulated errors has no tails."""
    rng, found, closing = np.random.default_rng(2), [], np.array([False, True, False, True, True])
    off = np.array([[3.0, 0.5], [1.5, 4.0]])  # standard deviations: by map, of its two kinds
    own, simulated = np.zeros(4), np.zeros(4)
    for kinds in off:
        draws = rng.normal(size=(SAMPLES, 5, 2)) * rng.uniform(1.0, 2.0, (5, 2)) + 4.0
        mean, deviation = draws.mean(axis=0), draws.std(axis=0)
        real = mean + kinds[closing.astype(int)][:, None] * deviation
        part = SimpleNamespace(closing=closing)
        found.append(SimpleNamespace(part=part, real=real, simulated=draws))
        variance = [(deviation[closing == kind] ** 2).sum(axis=0) for kind in (False, True)]
        simulated += np.concatenate(variance)
        own += np.repeat(kinds**2, 2) * np.concatenate(variance)
    score = _Score.of(found, [None, None])
    assert own[0] > 2.0 * simulated[0]
    np.testing.assert_allclose(score.tails, own / simulated)
    for each in found:
        each.real = each.simulated.mean(axis=0) + 0.5 * each.simulated.std(axis=0)
    np.testing.assert_array_equal(_Score.of(found, [None, None]).tails, 1.0)


@pytest.mark.slow
def test_what_a_gate_cut_off_is_made_up_for():
    """A gate of 97 % takes a ninth of closures' errors; factors are those of all the same."""
    aware, unaware, gate = [], [], float(chi2_gate(0.97, 3))
    for seed in range(7):
        one = simulate_city(seed=seed, poses=120).graph.maps[0]
        closing = closing_edges(one)
        whole = Part(optimize(one).graph, closing, closing & False)
        every = np.flatnonzero(closing)
        kept = ~closing
        kept[every] = squared_by_leaving(whole.graph, closing | True, every) <= gate
        part = Part(optimize(one.with_edges(kept)).graph, closing[kept], closing[kept])
        of_all = variance_components([whole]).variance
        aware.append(np.log(variance_components([part], gate).variance / of_all))
        unaware.append(np.log(variance_components([part]).variance / of_all))
    assert np.abs(np.mean(aware, axis=0))[2:].max() < 0.08
    assert np.mean(unaware, axis=0)[2:].max() < -0.1


@pytest.mark.slow
def test_intervals_cover():
    """All four, of 20 worlds; benchmarks.calibration_coverage has 200."""
    covered = []
    for seed in range(20):
        one = simulate_city(seed=100 + seed, poses=60).graph.maps[0]
        closing = closing_edges(one)
        found = variance_components([Part(optimize(one).graph, closing, closing & False)])
        covered.append((found.low <= 1.0) & (found.high >= 1.0))
    assert 0.8 <= np.mean(covered) <= 1.0


def test_applied_factors_leave_nothing_to_find(city, misstated, calibration):
    applied = calibration.apply(misstated)
    again = pcm_jax.calibrate(applied, city.is_true)
    for factor in again.factors:
        assert factor == pytest.approx(1.0, abs=0.02)
    one = misstated.maps[0]
    alone = calibration.apply(one)
    np.testing.assert_array_equal(alone.information, applied.maps[0].information)
    closing = closing_edges(one)
    ratio = np.asarray(alone.information)[:, 2, 2] / np.asarray(one.information)[:, 2, 2]
    np.testing.assert_allclose(ratio[closing], calibration.closures.rotation)
    np.testing.assert_allclose(ratio[~closing], calibration.odometry.rotation)


def test_maps_are_judged_as_stated(misstated, calibration):
    for one, chi2 in zip(misstated.maps, calibration.map_consistency, strict=True):
        solved = optimize(one)
        freedom = 3 * (one.num_edges - one.num_poses + 1)
        assert chi2 == pytest.approx(2.0 * solved.cost / freedom, rel=1e-6)


def test_closures_are_selected_where_none_are_given(city, misstated):
    found = pcm_jax.calibrate(pcm_jax.weigh(misstated))
    assert not found.accepted[~city.is_true].any()
    assert found.accepted[city.is_true].mean() > 0.8
    for factor, stated in zip(found.factors, STATED, strict=True):
        assert 0.6 < factor / stated < 1.6


@pytest.mark.slow
def test_far_too_small_deviations_widen_the_gate(city):
    """A tenth of the deviations: two right closures hardly ever agree as stated."""
    sure = scaled_graph(city.graph, np.full(4, 100.0))
    chains = tuple(one.with_edges(~closing_edges(one)) for one in sure.maps)
    found = pcm_jax.calibrate(MultiRobotGraph(chains, sure.closures))
    assert found.widened > 1.0
    assert found.accepted[city.is_true].mean() > 0.8
    assert not found.accepted[~city.is_true].any()
    told = f"few of {len(found.accepted)} closures between robots agree, under these factors"
    assert f"{told} {found.accepted.sum()} do" in str(found)
    assert "too small" in str(found)
    assert found.map_consistency == (None, None)


def test_false_loops_are_left_out():
    one = simulate_city(seed=2, poses=100).graph.maps[0]
    rng = np.random.default_rng(0)
    false = 30
    ends = rng.choice(np.argwhere(np.triu(np.ones((100, 100)), 20)), false).T
    wrong = lie.exp(one.group, rng.uniform(-5.0, 5.0, (false, 3)))
    information = np.asarray(one.information)
    dirty = pcm_jax.PoseGraph.from_arrays(
        poses=one.poses,
        tail=np.append(one.tail, ends[0]),
        head=np.append(one.head, ends[1]),
        measurement=lie.concatenate([lie.as_numpy(one.measurement), wrong]),
        information=np.concatenate([information, information[:false]]),
    )
    found = pcm_jax.calibrate(dirty)
    assert false <= found.left_out <= false + 15
    for factor in found.factors:
        assert 0.5 < factor < 2.0


@pytest.mark.parametrize(
    ("factor", "interval", "words"),
    [
        (2.25, (1.5, 3.4), "errors are stated 1.5 times too large (information times 2.25, 1.5 to"),
        (0.25, (0.2, 0.3), "errors are stated 2 times too small (information times 0.25, 0.2 to"),
        (1.2, (1.1, 1.3), "errors are about as stated (information times 1.2, 1.1 to 1.3)"),
        (0.9, (0.6, 1.3), "errors are about as stated (information times 0.9, 0.6 to 1.3)"),
        (0.7, (0.5, 1.0), "errors are about as stated (information times 0.7, 0.5 to 1)"),
        (1.0, (0.3, 3.1), "errors may be as stated (information times 1, 0.3 to 3.1)"),
        (3.0, (1.1, 12.0), "errors are stated 1.73 times too large (information times 3, 1.1 to"),
        (1.0, (0.0, np.inf), "errors cannot be told from these data"),
    ],
)
def test_how_errors_are_stated(factor, interval, words):
    assert _how(Factor(factor, interval)).startswith(words)


def test_words(calibration):
    text = str(calibration)
    assert text.startswith("odometry: translation errors are stated ")
    assert "rotation errors are stated" in text
    assert "too small" in text
    assert repr(calibration).startswith("Calibration(by ")
    told = calibration.as_dict()
    assert told["odometry"]["translation"]["factor"] == calibration.odometry.translation
    assert told["advice"] == "\n".join(calibration.advice())
    for kind in ("odometry", "closures"):
        expected, observed = (told["quantiles"][kind][name] for name in ("expected", "observed"))
        assert len(expected) == len(observed) <= 200
        assert expected == sorted(expected)
        assert observed == sorted(observed)


def test_the_square_root_is_recognised(city):
    """Information that holds its square root: the factor is the number that stands there."""
    information = np.sqrt(np.asarray(city.graph.maps[0].information)[0].diagonal())
    rooted = scaled_graph(city.graph, 1.0 / information[[0, 2, 0, 2]])
    found = pcm_jax.calibrate(rooted, city.is_true)
    assert "--information sqrt" in str(found)
    assert "--information sqrt" not in str(pcm_jax.calibrate(city.graph, city.is_true))


def test_what_cannot_be_known_is_said():
    one = simulate_city(seed=0, poses=30).graph.maps[0]
    chain = one.with_edges(~closing_edges(one))
    with pytest.raises(InputError, match="no map has a loop"):
        pcm_jax.calibrate(chain)
    looped = one.with_edges(np.append(np.flatnonzero(~closing_edges(one)), len(one.tail) - 1))
    found = pcm_jax.calibrate(looped)
    assert not found.closures.translation.known
    assert found.closures.translation == 1.0
    assert "cannot be told" in str(found)


def test_bad_arguments(city):
    with pytest.raises(InputError, match="graph: str given"):
        pcm_jax.calibrate("graph")
    with pytest.raises(InputError, match="accepted: bool"):
        pcm_jax.calibrate(city.graph, np.ones(3, bool))
    with pytest.raises(InputError, match="accepted: int"):
        pcm_jax.calibrate(city.graph, [10**6])


@pytest.mark.slow
def test_intervals_cover_what_differs_from_length_to_length():
    """A drift of 0.3 sigma a step: short loops fix the factor, and long ones contradict it."""
    one = simulate_city(seed=6, poses=400).graph.maps[0]
    closing = closing_edges(one)
    assert not pcm_jax.calibrate(one).growth.uneven
    bias = np.where(closing[:, None], 0.0, [0.0, 0.0, 0.003])
    drifting = lie.compose(lie.as_numpy(one.measurement), lie.as_numpy(lie.exp(one.group, bias)))
    found = pcm_jax.calibrate(dataclasses.replace(one, measurement=drifting))
    assert found.growth.uneven
    assert found.growth.words in str(found)
    short, times = found.components, found.growth.variance
    assert times > 1.1
    ends = zip(found.odometry, short.variance, short.low, short.high, strict=False)
    for factor, likeliest, low, high in ends:
        assert factor == pytest.approx(1.0 / (times * likeliest))
        assert factor.interval[0] < 0.9 / (times * high)
        assert factor.interval[1] > 1.1 / (times * low)


def test_contradictions_are_given_up_soon(city, monkeypatch):
    """A map that no step leads to the optimum of: three steps, of few evaluations each."""
    graph = optimize(city.graph.maps[0]).graph
    part = Part(graph, closing_edges(graph), np.zeros(graph.num_edges, bool))
    asked = []

    def unsolved(graph, **how):
        asked.append(how["max_steps"])
        return dataclasses.replace(optimize(graph, **how), converged=False)

    assert variance_components([part]).converged
    monkeypatch.setattr(components, "optimize", unsolved)
    assert not variance_components([part]).converged
    assert asked == [30, 30, 30]


def test_a_factor_is_a_number():
    factor = Factor(2.0, (1.5, 2.5))
    assert factor * 2 == 4.0
    for same in (copy.deepcopy(factor), pickle.loads(pickle.dumps(factor))):
        assert (same, same.interval) == (2.0, (1.5, 2.5))
    assert repr(Factor(1.0, (0.0, np.inf))) == "unknown"
