"""Monte Carlo: a 95 % gate lets 95 % of the right pairs inside one map pass.

Odometry drifts and closures are noisy as measured = true · exp(noise); their ways overlap, enclose
each other or lie apart at random.
"""

import jax
import jaxlie
import numpy as np
import pytest
from scipy import stats

from pcm_jax import lie
from pcm_jax.consistency import (
    chi2_gate,
    consistency_problem,
    squared_mahalanobis,
    squared_own_loops,
    within_problem,
)
from pcm_jax.graph import LoopClosures, PoseGraph

pytestmark = pytest.mark.slow


WORLDS, POSES, CLOSURES = 800, 25, 6
SIGMA = 0.01
OFF_DIAGONAL = ~np.eye(CLOSURES, dtype=bool)


def drifting_map(group, rng):
    """A chain and closures between random poses, all of the same noise."""
    d = lie.tangent_dim(group)
    truth = lie.exp(group, rng.normal(size=(POSES, d)))
    span = np.subtract.outer(np.arange(POSES), np.arange(POSES))
    ends = rng.choice(np.argwhere((span > 1) & (span < 9)), CLOSURES, replace=False)
    tail, head = np.array([*zip(range(POSES - 1), range(1, POSES), strict=True), *ends]).T
    exact = lie.between(lie.take(truth, tail), lie.take(truth, head))
    noise = lie.exp(group, SIGMA * rng.normal(size=(len(tail), d)))
    return PoseGraph.from_arrays(
        tail=tail,
        head=head,
        measurement=lie.compose(exact, noise),
        covariance=np.broadcast_to(SIGMA**2 * np.eye(d), (len(tail), d, d)),
    )


def independent_sides(graph, problem):
    """The same closures between two maps of the same odometry, whose errors are taken as two."""
    d, n = graph.tangent_dim, graph.num_poses
    ends = np.sort([graph.tail, graph.head], axis=0)[:, n - 1 :]
    poses = lie.as_numpy(graph.poses)
    steps = SIGMA**2 * np.eye(d)
    adjoint = np.asarray(lie.adjoint(poses))
    cumulated = np.cumsum([0.0 * steps, *(a @ steps @ a.T for a in adjoint[1:])], axis=0)
    marginals = []
    for touched in map(np.unique, ends):
        left = cumulated[np.minimum(touched[:, None], touched)]
        back = np.linalg.inv(adjoint[touched])
        joint = np.einsum("pab,pqbc,qdc->paqd", back, left, back)
        marginals.append(joint.reshape(len(touched) * d, -1))
    closures = LoopClosures.from_arrays(
        robot_a=np.zeros(CLOSURES, int),
        pose_a=ends[0],
        robot_b=np.ones(CLOSURES, int),
        pose_b=ends[1],
        measurement=lie.take(lie.as_numpy(problem.measurement), slice(CLOSURES)),
        covariance=problem.measurement_covariance[:CLOSURES],
    )
    return consistency_problem(graph, graph, closures, marginals=tuple(marginals))


@pytest.fixture(scope="module", params=[jaxlie.SE2, jaxlie.SE3], ids=lambda group: group.__name__)
def worlds(request):
    """d; q² of pairs, of own loops; which pairs lie apart; their q² with independent sides."""
    rng = np.random.default_rng(20180522)
    problems, independent = [], []
    for _ in range(WORLDS):
        graph = drifting_map(request.param, rng)
        problems.append(within_problem(graph))
        if len(independent) < WORLDS // 8:
            independent.append(independent_sides(graph, problems[-1]))
    every = jax.tree.map(lambda *leaves: np.stack(leaves), *problems)
    others = jax.tree.map(lambda *leaves: np.stack(leaves), *independent)
    cut = np.s_[:, :CLOSURES, :CLOSURES]
    before = every.row_b[:, :CLOSURES, None] <= every.row_a[:, None, :CLOSURES]
    return (
        lie.tangent_dim(request.param),
        np.asarray(jax.jit(jax.vmap(squared_mahalanobis))(every))[cut],
        np.asarray(jax.jit(jax.vmap(squared_own_loops))(every))[:, :CLOSURES],
        before | before.swapaxes(1, 2),
        np.asarray(jax.jit(jax.vmap(squared_mahalanobis))(others))[cut],
    )


def test_pairs_are_calibrated(worlds):
    d, squared, _, apart, _ = worlds
    gate = chi2_gate(0.95, d)
    assert 0.94 < np.mean(squared[:, OFF_DIAGONAL] <= gate) < 0.96
    assert 0.94 < np.mean(squared[apart] <= gate) < 0.96
    # One pair of each world, so that the sample's members are independent.
    assert stats.kstest(squared[:, 0, 1], stats.chi2(d).cdf).pvalue > 0.01
    inside = int(np.sum(squared[:, 0, 1] <= gate))
    assert stats.binomtest(inside, WORLDS, 0.95).pvalue > 0.01


def test_own_loops_are_calibrated(worlds):
    d, _, own, *_ = worlds
    assert 0.94 < np.mean(own <= chi2_gate(0.95, d)) < 0.96
    assert stats.kstest(own[:, 0], stats.chi2(d).cdf).pvalue > 0.01


def test_sides_taken_as_independent_are_not(worlds):
    """Where one closure's way ends before the other's begins, all between is walked twice."""
    d, _, _, apart, independent = worlds
    assert np.mean(independent[apart[: len(independent)]] <= chi2_gate(0.95, d)) > 0.98
