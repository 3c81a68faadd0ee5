"""`weigh` and what stands on it: asked again and again, computed once."""

from __future__ import annotations

import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.consistency import PairEvidence, chi2_gate
from pcm_jax.errors import InputError, InputWarning
from pcm_jax.experiments import Method, compare_methods
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.mapping import covariance, optimize
from pcm_jax.pipeline import merge, select, select_within, weigh
from pcm_jax.selection import select_from
from pcm_jax.simulation import simulate_city


@pytest.fixture(scope="module")
def world():
    return simulate_city(seed=2, poses=80, robots=3, inliers=8, aliased_size=3, random=10)


@pytest.fixture(scope="module")
def evidence(world):
    return weigh(world.graph)


class Calls:
    """Counts the calls of functions in the modules that use them."""

    def __init__(self, monkeypatch):
        self.monkeypatch, self.counts = monkeypatch, {}

    def watch(self, module, name):
        real = getattr(module, name)

        def counted(*args, **kwargs):
            self.counts[name] = self.counts.get(name, 0) + 1
            return real(*args, **kwargs)

        self.monkeypatch.setattr(module, name, counted)


@pytest.fixture
def calls(monkeypatch):
    import importlib

    stage = importlib.import_module("pcm_jax.pipeline.weigh")
    counter = Calls(monkeypatch)
    counter.watch(stage, "optimize")
    counter.watch(stage, "weighed_on_host")
    counter.watch(stage, "stream_from_covariances")
    counter.watch(covariance, "covariance_factor")
    return counter


def test_a_map_is_optimised_and_factorised_once(world, calls):
    found = weigh(world.graph)
    assert len(found.pairs) == 3
    assert calls.counts == {"optimize": 3, "covariance_factor": 3, "weighed_on_host": 3}


@pytest.mark.slow
def test_asking_again_costs_no_optimisation_no_marginals_and_no_q(evidence, calls):
    for method in ("pcm-exact", "ransac", "scgp"):
        for confidence in (0.5, 0.99):
            select(evidence, method=method, confidence=confidence)
    merge(evidence, confidence=0.9)
    merge(evidence, method="dcs")
    assert calls.counts == {}


@pytest.mark.slow
def test_streamed_evidence_weighs_once_a_gate(world, calls):
    found = weigh(world.graph, memory_limit=0)
    select(found, confidence=0.5)  # the maps are factorised here
    calls.counts.clear()
    answers = [select(found, confidence=0.99).accepted for _ in range(3)]
    assert calls.counts == {"stream_from_covariances": 3}
    np.testing.assert_array_equal(answers[-1], select(world.graph, confidence=0.99).accepted)
    with pytest.raises(InputError, match="squared: not kept"):
        select(found, method="ransac")


@pytest.mark.slow
def test_evidence_answers_as_the_graph_does(world, evidence):
    for options in ({}, {"confidence": 0.5}, {"method": "pcm-heuristic"}):
        direct, asked = select(world.graph, **options), select(evidence, **options)
        np.testing.assert_array_equal(direct.accepted, asked.accepted)
        assert direct.gate == asked.gate
    direct, asked = merge(world.graph), merge(evidence)
    np.testing.assert_array_equal(direct.accepted, asked.accepted)
    assert direct.solution == asked.solution


@pytest.mark.slow
def test_a_method_of_ones_own(world, evidence):
    def agrees_with_two(pair, gate):
        return pair.consistent(gate).sum(axis=1) >= 2

    result = merge(evidence, method=agrees_with_two)
    assert result.method == "agrees_with_two"
    assert result.accepted[world.is_true].mean() > 0.8
    np.testing.assert_array_equal(
        select(world.graph, method=agrees_with_two).accepted, result.accepted
    )
    row = {"own": Method(agrees_with_two)}
    compared = compare_methods(world.graph, world.is_true, methods=row)["own"]
    np.testing.assert_array_equal(compared.accepted, result.accepted)
    squared = evidence.pairs[0].squared
    gate = float(chi2_gate(0.99, 3))
    kept = select_from(squared, gate, method=agrees_with_two)
    np.testing.assert_array_equal(kept, result.selection.pairs[0].accepted)
    within = select_within(world.graph.maps[0], method=agrees_with_two)
    assert within.accepted.all()  # what the simulation closes inside a map is right


def test_a_metric_of_ones_own(world):
    def apart(map_a, map_b, closures):  # metres between where two closures put map b
        reached = lie.compose(lie.take(map_a.poses, closures.pose_a), closures.measurement)
        placed = lie.compose(reached, lie.inverse(lie.take(map_b.poses, closures.pose_b)))
        places = lie.translation(placed)
        return np.sum((places[:, None] - places[None]) ** 2, axis=-1)

    found = weigh(world.graph, metric=apart)
    assert found.metric == "apart"
    result = merge(found, method=lambda pair, gate: select_from(pair.squared, 4.0))
    assert result.accepted[world.is_true].mean() > 0.5
    same = merge(
        world.graph, metric=apart, method=lambda pair, gate: select_from(pair.squared, 4.0)
    )
    np.testing.assert_array_equal(same.accepted, result.accepted)


@pytest.mark.parametrize(
    ("method", "message"),
    [
        (lambda pair, gate: np.ones(2, bool), r"returned bool \[2\], expected bool \[24\]"),
        (lambda pair, gate: np.ones(len(pair)), r"returned float64 \[24\], expected bool \[24\]"),
    ],
)
def test_a_method_must_return_a_mask(evidence, method, message):
    with pytest.raises(InputError, match=message):
        select(evidence, method=method)


def test_a_metric_must_return_a_square(world):
    with pytest.raises(InputError, match=r"metric: 'small' returned shape \(1, 1\), expected"):

        def small(map_a, map_b, closures):
            return np.zeros((1, 1))

        weigh(world.graph, metric=small)
    with pytest.raises(InputError, match="metric: 'euclid', expected None, 'mahalanobis'"):
        weigh(world.graph, metric="euclid")


def test_what_weighing_took_cannot_be_asked_of_evidence(evidence):
    for option in ({"optimized": True}, {"memory_limit": 1e9}, {"metric": "mahalanobis"}):
        with pytest.raises(InputError, match=f"{next(iter(option))}: given with evidence"):
            select(evidence, **option)
    with pytest.raises(InputError, match="graph: NoneType given, expected a MultiRobotGraph"):
        select(None)  # type: ignore[arg-type]


def test_progress_names_stages_and_counts_them(world):
    told = []
    merge(world.graph, progress=lambda *now: told.append(now))
    stages = list(dict.fromkeys(stage for stage, _, _ in told))
    assert stages == ["optimize", "consistency", "clique", "chance", "merge"]
    assert all(0 <= done <= total for _, done, total in told)
    assert {stage for stage, done, total in told if done == total} == set(stages)


def test_frames_do_not_move_when_a_closure_touches_another_pose(world):
    maps = tuple(optimize(one).graph for one in world.graph.maps)
    every = weigh(MultiRobotGraph(maps, world.graph.closures), optimized=True)
    some = np.flatnonzero(np.asarray(world.graph.closures.robot_b) == 1)[:-2]
    fewer = weigh(MultiRobotGraph(maps, world.graph.closures[some]), optimized=True)
    for one, other in zip(every.covariances, fewer.covariances, strict=True):
        np.testing.assert_array_equal(one.origin, other.origin)
    pair, part = every.pairs[0], fewer.pairs[0]
    rows = np.flatnonzero(np.isin(pair.closures, some[part.closures]))
    np.testing.assert_allclose(pair.squared[np.ix_(rows, rows)], part.squared, rtol=1e-9)


def test_objects_say_what_they_are(evidence):
    selection = select(evidence)
    result = merge(evidence)
    shown = [evidence, evidence.pairs[0], selection, selection.pairs[0], result]
    for one in shown:
        assert len(repr(one).splitlines()) == 3
    assert "3 maps" in repr(evidence)
    assert PairEvidence.from_squared(np.zeros((2, 2))).squared.shape == (2, 2)


def test_maps_that_are_not_at_their_optimum_are_told(world):
    """A loop that is not followed yet leaves a map where odometry has it."""
    first, *rest = world.graph.maps
    chain = first.with_edges(np.arange(first.num_poses - 1))
    unsolved = first.with_poses(optimize(chain).graph.poses)
    graph = MultiRobotGraph(
        (unsolved, *(optimize(one).graph for one in rest)), world.graph.closures
    )
    with pytest.warns(
        InputWarning, match="optimized: map 'a' is not at its optimum, a step changes"
    ):
        weigh(graph, optimized=True)
    weigh(MultiRobotGraph((optimize(first).graph, *graph.maps[1:]), graph.closures), optimized=True)
