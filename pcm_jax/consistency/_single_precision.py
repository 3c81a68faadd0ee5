"""The change that float32 makes to squared distances, measured on pairs of the problem at hand.

Rounding moves a loop's error by about ε L, L the extent of the maps and ε = 6e-8, and so q by
ε L / σ, σ the loop's standard deviation: a thousandth of q² when L is some ten thousand σ. Its
covariance M loses ε times its condition number. Both differ from pair to pair, so a sample of them
is weighed twice, in NumPy: random ones, and neighbours in map a, whose M is smallest.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Float

from pcm_jax import lie
from pcm_jax.lie import unrolled

if TYPE_CHECKING:
    from pcm_jax.consistency.problem import ConsistencyProblem

TOLERANCE = 1e-3
SAMPLE = 1_000  # pairs of either kind


def single_precision_error(problem: ConsistencyProblem) -> float:
    """The largest |q²(float32) − q²| / max(q², d) of a sample of pairs; 0 for fewer than two.

    Below d, the mean of a right pair's q², no digit decides anything.

    Args:
        problem: float64, not traced.
    """
    count = int(np.count_nonzero(np.asarray(problem.valid)))
    if count < 2:
        return 0.0
    u, v = _sampled_pairs(np.asarray(problem.row_a)[:count])
    double = jax.tree.map(np.asarray, problem)
    single = jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == float else x, double)
    with np.errstate(all="ignore"):
        exact = _squared(double, u, v)
        moved = np.abs(_squared(single, u, v) - exact) / np.maximum(exact, _dim(problem))
    known = moved[np.isfinite(exact)]
    return float(np.where(np.isnan(known), np.inf, known).max(initial=0.0))


def _sampled_pairs(row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Random pairs u ≠ v, and pairs of neighbours in the order of `row`."""
    generator, count = np.random.default_rng(0), len(row)
    u = generator.integers(count, size=SAMPLE)
    v = (u + generator.integers(1, count, size=SAMPLE)) % count
    order = np.argsort(row, kind="stable")
    first = generator.permutation(count - 1)[:SAMPLE]
    return np.concatenate([u, order[first]]), np.concatenate([v, order[first + 1]])


def _squared(
    problem: ConsistencyProblem, u: np.ndarray, v: np.ndarray
) -> Float[np.ndarray, " pairs"]:
    """q²_uv of the pairs, by the equations of `closed_form`, in the arrays' own precision."""
    module = lie.module_of(lie.group_of(problem.measurement))
    t_u, noise_u = _placed(problem, u)
    t_v, noise_v = _placed(problem, v)
    side_a = tuple(problem.relative_covariance_a[:, problem.row_a[u], problem.row_a[v]])
    side_b = tuple(problem.relative_covariance_b[:, problem.row_b[u], problem.row_b[v]])
    carried = module.adjoint_sandwich(t_v, unrolled.unpack(side_b))
    covariance = unrolled.add(unrolled.unpack(side_a), carried, noise_u, noise_v)
    error = module.log(module.compose(t_v, module.inverse(t_u)))
    return unrolled.inverse_quadratic_form(covariance, error)


def _placed(
    problem: ConsistencyProblem, index: np.ndarray
) -> tuple[tuple[np.ndarray, ...], unrolled.Matrix]:
    """T and Z of some closures."""
    poses = problem.pose_a, problem.measurement, problem.pose_b
    pose_a, measurement, pose_b = (lie.components(lie.take(x, index)) for x in poses)
    module = lie.module_of(lie.group_of(problem.measurement))
    reached = module.compose(pose_a, measurement)
    covariance = unrolled.from_array(problem.measurement_covariance[index])
    noise = module.adjoint_sandwich(reached, covariance)
    return module.compose(reached, module.inverse(pose_b)), noise


def _dim(problem: ConsistencyProblem) -> int:
    return lie.tangent_dim(problem.measurement)
