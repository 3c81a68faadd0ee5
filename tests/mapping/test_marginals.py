"""Joint marginals against the dense inverse, the gauge, GTSAM and Monte Carlo."""

import jax
import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.mapping import joint_marginal_covariance, optimize
from pcm_jax.mapping._linearization import linearize
from pcm_jax.mapping.least_squares import padded_edges
from pcm_jax.mapping.optimization import host_arrays


def dense_covariance(graph):
    """Inverse of the dense information, first pose held."""
    _, by_tail, by_head = map(
        np.asarray, jax.jit(linearize)(graph.poses, padded_edges(*host_arrays(graph), size=256))
    )
    n, d, e = graph.num_poses, graph.tangent_dim, graph.num_edges
    jacobian = np.zeros((e, d, n, d))
    for k, (i, j) in enumerate(zip(np.asarray(graph.tail), np.asarray(graph.head), strict=True)):
        jacobian[k, :, i] += by_tail[:, :, k]
        jacobian[k, :, j] += by_head[:, :, k]
    free = jacobian.reshape(e * d, n * d)[:, d:]
    return np.linalg.inv(free.T @ free).reshape(n - 1, d, n - 1, d)


def test_block_of_the_dense_inverse(group, make_map):
    graph = optimize(make_map(group)).graph
    wanted = np.array([17, 3, 29, 8])
    expected = dense_covariance(graph)[wanted - 1][:, :, wanted - 1]
    found = joint_marginal_covariance(graph, wanted)
    d = graph.tangent_dim
    atol = 1e-10 * np.abs(expected).max()
    np.testing.assert_allclose(found.reshape(4, d, 4, d), expected, atol=atol)


def test_the_held_pose_is_certain(group, make_map):
    graph = optimize(make_map(group)).graph
    d = graph.tangent_dim
    found = joint_marginal_covariance(graph, np.array([5, 0, 9]))
    without = joint_marginal_covariance(graph, np.array([5, 9]))
    assert not found[d : 2 * d].any()
    kept = np.r_[0:d, 2 * d : 3 * d]
    np.testing.assert_allclose(found[np.ix_(kept, kept)], without, rtol=1e-12)
    assert not joint_marginal_covariance(graph, np.array([0])).any()


def test_agrees_with_gtsam(group, make_map):
    gtsam = pytest.importorskip("gtsam")
    graph = optimize(make_map(group, poses=40)).graph
    is_3d = group is jaxlie.SE3
    order = [3, 4, 5, 0, 1, 2] if is_3d else [0, 1, 2]

    def pose(matrix):
        if is_3d:
            return gtsam.Pose3(matrix)
        return gtsam.Pose2(matrix[0, 2], matrix[1, 2], np.arctan2(matrix[1, 0], matrix[0, 0]))

    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for index, matrix in enumerate(np.asarray(lie.as_matrix(graph.poses))):
        values.insert(index, pose(matrix))
    factor = gtsam.BetweenFactorPose3 if is_3d else gtsam.BetweenFactorPose2
    parts = graph.tail, graph.head, lie.as_matrix(graph.measurement), graph.information
    for i, j, z, omega in zip(*map(np.asarray, parts), strict=True):
        noise = gtsam.noiseModel.Gaussian.Information(omega[np.ix_(order, order)])
        factors.add(factor(int(i), int(j), pose(z), noise))
    sure = gtsam.noiseModel.Isotropic.Sigma(graph.tangent_dim, 1e-7)
    prior = gtsam.PriorFactorPose3 if is_3d else gtsam.PriorFactorPose2
    first = values.atPose3(0) if is_3d else values.atPose2(0)
    factors.add(prior(0, first, sure))
    wanted = np.array([4, 11, 30])
    joint = gtsam.Marginals(factors, values).jointMarginalCovariance(wanted.tolist()).fullMatrix()
    rows = (np.arange(3)[:, None] * graph.tangent_dim + np.array(order)).ravel()
    found = joint_marginal_covariance(graph, wanted)
    np.testing.assert_allclose(found, joint[np.ix_(rows, rows)], rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        (np.array([1, 99]), r"poses\[1\]: 99 given, expected 0 … 29"),
        (np.array([-1]), r"poses\[0\]: -1 given"),
        (np.array([4, 4]), "poses: 4 given twice"),
        (np.array([[1, 2]]), "expected integers"),
        (np.array([1.0]), "expected integers"),
    ],
)
def test_bad_indices(make_map, poses, message):
    with pytest.raises(InputError, match=message):
        joint_marginal_covariance(make_map(), poses)
