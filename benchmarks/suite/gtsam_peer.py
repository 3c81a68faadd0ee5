"""The same graphs, solves and marginals by GTSAM, the peer that users know.

The factors carry exactly our measurements and information, the start is ours, and the stopping rule
is the same: relative and absolute tolerance 1e-9. GTSAM's pip build runs on one thread. The first
pose is held by a tight prior at its own start, which adds nothing to the cost.

GTSAM's `Pose3` puts rotation first in its tangent, `Pose2` is (x, y, θ) like ours.

JAX is not imported where a graph comes as `PlainGraph`: what GTSAM's process holds is GTSAM's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from benchmarks.suite.harness import NotMeasuredError

if TYPE_CHECKING:
    from pcm_jax import PoseGraph

try:
    import gtsam  # pyright: ignore[reportMissingImports]
except ImportError:
    gtsam: Any = None

TOLERANCE = 1e-9
_SIGMA_HELD = {"solve": 1e-4, "marginals": 1e-8}
"""Of the first pose: the first is kind to GTSAM's conditioning, the second to its covariances."""


def require() -> None:
    """Raises unless GTSAM is installed."""
    if gtsam is None:
        raise NotMeasuredError("gtsam is not installed: pip install '.[bench]'")


class PlainGraph(NamedTuple):
    """A pose graph as NumPy arrays, which a file can hold.

    Attributes:
        poses: `[n, k + 1, k + 1]` homogeneous matrices, k = 2 or 3.
        tail, head: `[e]`.
        measurement: `[e, k + 1, k + 1]`.
        information: `[e, d, d]`, our order.
    """

    poses: Float[np.ndarray, "n k1 k1"]
    tail: Int[np.ndarray, " e"]
    head: Int[np.ndarray, " e"]
    measurement: Float[np.ndarray, "e k1 k1"]
    information: Float[np.ndarray, "e d d"]


def plain(graph: PoseGraph) -> PlainGraph:
    """The graph in plain arrays."""
    ends = np.asarray(graph.tail), np.asarray(graph.head)
    information = np.asarray(graph.information)
    return PlainGraph(_matrices(graph.poses), *ends, _matrices(graph.measurement), information)


def factors_and_values(graph: PoseGraph | PlainGraph, purpose: str) -> tuple[Any, Any]:
    """A nonlinear factor graph and the graph's own poses as GTSAM values.

    Args:
        graph: the graph.
        purpose: "solve" or "marginals".
    """
    require()
    if not isinstance(graph, PlainGraph):
        graph = plain(graph)
    d = graph.information.shape[-1]
    pose, factor, prior, order = _kinds(d)
    noise = gtsam.noiseModel
    values, factors = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for index, matrix in enumerate(graph.poses):
        values.insert(index, pose(matrix))
    information = graph.information[:, order[:, None], order]
    ends = graph.tail.tolist(), graph.head.tolist()
    for tail, head, matrix, weight in zip(*ends, graph.measurement, information, strict=True):
        factors.add(factor(tail, head, pose(matrix), noise.Gaussian.Information(weight)))
    held = noise.Isotropic.Sigma(d, _SIGMA_HELD[purpose])
    factors.add(prior(0, pose(graph.poses[0]), held))
    return factors, values


def gauss_newton(factors: Any, values: Any) -> Any:
    """A Gauss-Newton optimiser, ordering found: `.optimize()` is what is left to do."""
    parameters = gtsam.GaussNewtonParams()
    parameters.setRelativeErrorTol(TOLERANCE)
    parameters.setAbsoluteErrorTol(TOLERANCE)
    return gtsam.GaussNewtonOptimizer(factors, values, parameters)


def lago_and_gauss_newton(factors: Any) -> Any:
    """The optimum of a planar graph in one go: start by LAGO, ordering, Gauss-Newton.

    LAGO (Carlone et al. 2014) is GTSAM's linear initialisation in the plane; it needs diagonal
    information.
    """
    return gauss_newton(factors, gtsam.lago.initialize(factors)).optimize()


def levenberg_marquardt(factors: Any, values: Any) -> Any:
    """The same with Levenberg-Marquardt, GTSAM's own damping."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(TOLERANCE)
    parameters.setAbsoluteErrorTol(TOLERANCE)
    return gtsam.LevenbergMarquardtOptimizer(factors, values, parameters)


def joint_marginal_covariance(
    factors: Any, values: Any, poses: Int[np.ndarray, " k"]
) -> Float[np.ndarray, "k*d k*d"]:
    """One big joint marginal covariance, factorisation included, blocks ascending, GTSAM's order.

    Args:
        factors, values: see `factors_and_values`, for "marginals".
        poses: ascending.
    """
    marginals = gtsam.Marginals(factors, values)
    return marginals.jointMarginalCovariance(gtsam.KeyVector(poses.tolist())).fullMatrix()


def in_our_order(
    covariance: Float[np.ndarray, "k*d k*d"], tangent_dim: int
) -> Float[np.ndarray, "k*d k*d"]:
    """A joint covariance with translations before rotations in every pose."""
    order = _kinds(tangent_dim)[-1]
    rows = (np.arange(0, len(covariance), tangent_dim)[:, None] + order).ravel()
    return covariance[np.ix_(rows, rows)]


def _kinds(tangent_dim: int) -> tuple[Any, Any, Any, np.ndarray]:
    """Pose from a matrix, factor types, and where our tangent's entries stand in GTSAM's."""
    if tangent_dim == 3:
        return _pose2, gtsam.BetweenFactorPose2, gtsam.PriorFactorPose2, np.arange(3)
    order = np.array([3, 4, 5, 0, 1, 2])  # its own inverse
    return gtsam.Pose3, gtsam.BetweenFactorPose3, gtsam.PriorFactorPose3, order


def _pose2(matrix: Float[np.ndarray, "3 3"]) -> Any:
    return gtsam.Pose2(matrix[0, 2], matrix[1, 2], np.arctan2(matrix[1, 0], matrix[0, 0]))


def _matrices(transforms: Any) -> Float[np.ndarray, "n k k"]:
    from pcm_jax import lie

    return np.asarray(lie.as_matrix(lie.as_numpy(transforms)))
