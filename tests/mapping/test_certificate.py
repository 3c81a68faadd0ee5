"""Certificates of global minima, against dense linear algebra, wrong minima and published costs."""

import dataclasses
from typing import Any

import jaxlie
import numpy as np
import pytest

from pcm_jax import InputError, PoseGraph, lie, optimize, read_graph
from pcm_jax.graph import Priors
from pcm_jax.mapping import certificate, certify
from pcm_jax.simulation import simulate_city

PUBLISHED = {
    "sphere2500.g2o.xz": 1687.0,
    "torus3D.g2o.xz": 24227.0,
    "parking-garage.g2o.xz": 1.2625,
}
"""F at the global minimum: SE-Sync, IJRR 2019, table 1."""


NOISE = {3: np.array([0.05, 0.05, 0.01]), 6: np.array([0.05] * 3 + [0.01] * 3)}


def exp(group, tangent: Any):
    return lie.exp(group, tangent)


@pytest.fixture(scope="module", params=[jaxlie.SE2, jaxlie.SE3], ids=["SE2", "SE3"])
def solution(request):
    """A random walk of 30 poses with 20 loops."""
    group, rng = request.param, np.random.default_rng(5)
    d = 3 if group is jaxlie.SE2 else 6
    truth = [lie.identity(group)]
    for _ in range(29):
        truth.append(lie.compose(truth[-1], exp(group, rng.normal(size=d))))
    truth = lie.stack(truth)
    loops = rng.permuted(np.argwhere(np.triu(np.ones((30, 30)), 2)), axis=0)[:20]
    ends = np.concatenate([np.stack([np.arange(29), np.arange(1, 30)], axis=1), np.sort(loops)])
    ends = ends[ends[:, 0] != ends[:, 1]]
    exact = lie.between(lie.take(truth, ends[:, 0]), lie.take(truth, ends[:, 1]))
    noise = exp(group, rng.normal(size=(len(ends), d)) * NOISE[d])
    graph = PoseGraph.from_arrays(
        tail=ends[:, 0],
        head=ends[:, 1],
        measurement=lie.compose(exact, noise),
        information=np.tile(np.diag(NOISE[d] ** -2), (len(ends), 1, 1)),
    )
    return optimize(graph)


def ring(poses, turns, group=jaxlie.SE2):
    """A closed ring whose measurements say "straight on, no turn", as poses that wind round."""
    angle = 2.0 * np.pi * turns / poses
    d = 3 if group is jaxlie.SE2 else 6
    steps = np.zeros((poses, d))
    steps[:, -1] = angle
    placed = [lie.identity(group)]
    for step in range(poses - 1):
        placed.append(lie.compose(placed[-1], exp(group, steps[step])))
    return PoseGraph.from_arrays(
        poses=lie.stack(placed),
        tail=np.arange(poses),
        head=(np.arange(poses) + 1) % poses,
        measurement=lie.as_numpy(lie.identity(group, (poses,))),
        information=np.tile(np.eye(d), (poses, 1, 1)),
    )


def dense_of(problem, poses):
    """M and X by their definition, edge by edge and number by number."""
    n, s = len(poses), poses.shape[1] - 1
    m = np.zeros((n * (s + 1), n * (s + 1)))
    for e in range(len(problem.tail)):
        of_t = np.zeros((1, n, s + 1))
        of_t[0, problem.head[e], 0] = 1.0
        of_t[0, problem.tail[e], 0] -= 1.0
        of_t[0, problem.tail[e], 1:] -= problem.shift[e]
        of_r = np.zeros((s, n, s + 1))
        of_r[:, problem.head[e], 1:] = np.eye(s)
        of_r[:, problem.tail[e], 1:] -= problem.turn[e].T
        for rows, weight in ((of_t, problem.tau[e]), (of_r, problem.kappa[e])):
            flat = rows.reshape(len(rows), -1)
            m += weight * flat.T @ flat
    x = np.concatenate([poses[:, :s, s:], poses[:, :s, :s]], axis=2).transpose(0, 2, 1)
    return m, x.reshape(-1, s)


def matrices(graph):
    return np.asarray(lie.as_matrix(lie.as_numpy(graph.poses)), np.float64)


def test_the_cost_is_the_quadratic_form_and_the_bound_a_bound(solution):
    problem = certificate._Problem.of(solution.graph)
    poses = problem.minimum(matrices(solution.graph))
    m, x = dense_of(problem, poses)
    assert problem.cost(poses) == pytest.approx(np.trace(x.T @ m @ x), rel=1e-9)
    n, s = len(poses), poses.shape[1] - 1
    multipliers = np.zeros_like(m)
    trace = 0.0
    for i in range(n):
        rows = slice(i * (s + 1) + 1, (i + 1) * (s + 1))
        own = (m @ x)[rows] @ x[rows].T
        multipliers[rows, rows] = 0.5 * (own + own.T)
        trace += np.trace(own)
    smallest = np.linalg.eigvalsh(m - multipliers)[0]
    assert smallest > -1e-6 * np.abs(m).max()
    bound = problem.lower_bound(poses)
    assert bound <= trace + 1e-9
    assert bound == pytest.approx(problem.cost(poses), rel=1e-3)


def test_no_poses_cost_less_than_the_bound(solution):
    problem = certificate._Problem.of(solution.graph)
    bound = 2.0 * solution.certificate.lower_bound
    rng = np.random.default_rng(0)
    group, d = solution.graph.group, solution.graph.tangent_dim
    for size in (1e-4, 1e-2, 1.0):
        moved = exp(group, rng.normal(scale=size, size=(solution.graph.num_poses, d)))
        poses = lie.compose(lie.as_numpy(solution.graph.poses), moved)
        assert problem.cost(np.asarray(lie.as_matrix(poses), np.float64)) >= bound


def test_a_simulated_map_is_certified(solution):
    found = solution.certificate
    assert found.certified
    assert found is solution.certificate  # found once
    assert found.lower_bound <= found.cost
    assert found.cost == pytest.approx(solution.cost, rel=0.2)  # noise is nearly isotropic
    assert "certified" in repr(found)


def fitting(graph, precision=1.0):
    """The map with edges that its poses fit exactly, translations of a given precision."""
    d = graph.tangent_dim
    weight = np.where(np.arange(d) < (2 if d == 3 else 3), precision, 1.0)
    poses = lie.as_numpy(graph.poses)
    return dataclasses.replace(
        graph,
        measurement=lie.between(lie.take(poses, graph.tail), lie.take(poses, graph.head)),
        information=np.tile(np.diag(weight), (graph.num_edges, 1, 1)),
    )


def displaced(graph, by):
    """The map with poses that are off by tangent vectors `[n, d]`."""
    return graph.with_poses(lie.compose(lie.as_numpy(graph.poses), exp(graph.group, by)))


@pytest.mark.parametrize("pose", [1, 17])
def test_it_says_how_far_the_minimum_is(solution, pose):
    """The first pose held, only the one that was displaced comes back."""
    by = np.zeros((solution.graph.num_poses, solution.graph.tangent_dim))
    by[pose, 0], by[pose, -1] = 0.3, 0.2
    found = certify(displaced(fitting(solution.graph), by))
    assert found.certified
    chord = 2.0 * 0.3 / 0.2 * np.sin(0.1)  # of an arc of 0.3 m that turns by 0.2
    assert found.moved == (pytest.approx(chord, rel=1e-9), pytest.approx(0.2, rel=2e-3))


@pytest.mark.parametrize("missing, certified", [(0.9e-3, True), (1.1e-3, False)])
def test_a_thousandth_of_one_may_be_missing_where_the_cost_is_less(
    solution, monkeypatch, missing, certified
):
    monkeypatch.setattr(certificate._Problem, "lower_bound", lambda *_: -missing)
    assert certify(fitting(solution.graph)).certified is certified


def test_a_step_that_costs_more_is_halved(solution):
    graph = fitting(solution.graph, precision=100.0)
    problem = certificate._Problem.of(graph)
    by = np.random.default_rng(7).normal(size=(30, graph.tangent_dim))
    by[0] = 0.0
    start = matrices(displaced(graph, by))
    whole = start @ certificate._exp(problem._step(start), start.shape[1] - 1)
    assert problem.cost(whole) > 1.1 * problem.cost(start)
    np.testing.assert_allclose(problem.minimum(start), matrices(graph), atol=1e-7)


@pytest.mark.parametrize("group", [jaxlie.SE2, jaxlie.SE3])
def test_a_local_minimum_is_not_certified(group):
    """Wound round once, every step is off by a little; straight, none is."""
    wound = optimize(ring(30, turns=1, group=group), initial="given")
    assert wound.converged
    assert wound.cost > 0.1
    assert not wound.certificate.certified
    assert wound.certificate.lower_bound == -np.inf
    straight = optimize(ring(30, turns=0, group=group), initial="given")
    assert straight.certificate.certified
    assert straight.certificate.cost == pytest.approx(0.0, abs=1e-12)


def test_maps_of_one_pose_and_maps_with_priors():
    one = simulate_city(seed=1, poses=20).graph.maps[0]
    alone = PoseGraph.from_arrays(
        poses=np.eye(3)[None],
        tail=np.zeros(0, int),
        head=np.zeros(0, int),
        measurement=np.zeros((0, 3, 3)),
        information=np.zeros((0, 3, 3)),
    )
    assert certify(alone).certified
    priors = Priors.from_arrays(pose=[0], measurement=np.eye(3)[None], information=np.eye(3)[None])
    with pytest.raises(InputError, match="it has priors, expected edges alone"):
        certify(dataclasses.replace(one, priors=priors))


@pytest.mark.slow
@pytest.mark.parametrize("name", PUBLISHED)
def test_the_published_minima(shared_data, name):
    (graph,) = read_graph(shared_data / "classic3d" / name).maps
    found = optimize(graph).certificate
    assert found.certified
    assert 2.0 * found.cost == pytest.approx(PUBLISHED[name], rel=1e-3)
