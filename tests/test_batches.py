"""Hundreds of problems in one program, from covariances to merged maps and back; three are bad."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

import pcm_jax as pcm
from pcm_jax import lie
from pcm_jax.selection import select_batched

pytestmark = pytest.mark.slow


SAMPLES, COUNT = 250, 6
NOT_A_NUMBER, NOT_DEFINITE, NOT_CONVERGING = BAD = 10, 100, 249
GATE = 11.3


def world():
    """Two straight maps, four closures that agree and two that do not, and what Q needs of it."""
    path = lie.exp(jaxlie.SE2, np.arange(5.0)[:, None] * np.array([1.0, 0.0, 0.2]))
    own = pcm.PoseGraph.from_trajectory(path, sigma_translation=0.1, sigma_rotation=0.05)
    ends = np.array([[0, 1, 2, 4, 3, 1], [1, 0, 2, 3, 4, 3]])
    exact = lie.between(*(lie.take(path, rows) for rows in ends))
    error = 0.05 * np.random.default_rng(0).normal(size=(COUNT, 3))
    error[4:] += [[2.0, 1.0, 0.0], [-1.0, 3.0, 1.0]]
    closures = pcm.LoopClosures.from_arrays(
        robot_a=[0] * COUNT,
        pose_a=ends[0],
        robot_b=[1] * COUNT,
        pose_b=ends[1],
        measurement=lie.compose(exact, lie.exp(jaxlie.SE2, error)),
        covariance=np.tile(0.01 * np.eye(3), (COUNT, 1, 1)),
    )
    problem = pcm.consistency_problem(own, own, closures)
    by_closure = ("measurement", "measurement_covariance", "pose_a", "pose_b", "row_a", "row_b")
    cut = {name: jax.tree.map(lambda x: x[:COUNT], getattr(problem, name)) for name in by_closure}
    problem = dataclasses.replace(problem, **cut, valid=problem.valid[:COUNT])
    return pcm.MultiRobotGraph((own, own), closures), problem


@pytest.fixture(scope="module")
def run():
    graph, problem = world()

    def loss(covariance, factor):
        moved = dataclasses.replace(problem, measurement_covariance=covariance)
        squared = pcm.squared_mahalanobis(moved)
        kept = select_batched(squared, GATE, method="pcm-heuristic")
        soft = pcm.soft_select(squared, GATE, temperature=1.0)
        closures = graph.closures
        closures = dataclasses.replace(closures, information=factor * closures.information)
        merged = pcm.merge_differentiable(pcm.MultiRobotGraph(graph.maps, closures), soft)
        poses = lie.parameters(merged[1])
        total = jnp.sum(poses**2)
        return jnp.where(jnp.isfinite(total), total, 0.0), (squared, kept, soft, poses)

    return jax.jit(jax.vmap(jax.value_and_grad(loss, has_aux=True)))


def test_the_other_247_stay_the_same_bit_for_bit(run):
    scale = np.random.default_rng(1).uniform(0.5, 2.0, SAMPLES)
    covariance = scale[:, None, None, None] * np.tile(0.01 * np.eye(3), (COUNT, 1, 1))
    factor = np.ones(SAMPLES)
    (_, before), slope = run(covariance, factor)
    assert all(np.isfinite(each).all() for each in before)
    assert (np.asarray(before[1]) == (np.arange(COUNT) < 4)).all()
    covariance[NOT_A_NUMBER, 1] = np.nan
    covariance[NOT_DEFINITE, 0] = np.diag([0.01, -5.0, 0.01])
    factor[NOT_CONVERGING] = -1.0  # saddles have no minimum to find
    (losses, after), changed = run(covariance, factor)
    others = np.setdiff1d(np.arange(SAMPLES), BAD)
    for one, other in zip((*after, changed), (*before, slope), strict=True):
        np.testing.assert_array_equal(one[others], other[others])
    squared, _, soft, poses = after
    flagged = np.isnan(squared).any(axis=(1, 2))
    np.testing.assert_array_equal(np.flatnonzero(flagged), [NOT_A_NUMBER, NOT_DEFINITE])
    np.testing.assert_array_equal(
        np.flatnonzero(np.isnan(poses).any(axis=(1, 2))), [NOT_CONVERGING]
    )
    assert np.isfinite(soft).all()
    assert np.isfinite(changed).all()
    assert losses[NOT_CONVERGING] == 0.0
    for nothing in (changed[NOT_CONVERGING], changed[NOT_A_NUMBER, 1], changed[NOT_DEFINITE, 0]):
        np.testing.assert_array_equal(nothing, 0.0)
    assert np.abs(slope).max(axis=(1, 2, 3)).min() > 1e-6
