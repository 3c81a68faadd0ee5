"""The first step of a map as loops come: by the covariance that it had before.

At its optimum the gradient of a map's cost is zero, so the first step of Gauss-Newton with further
loops needs the old information H, the whitened Jacobians G of the loops, and the residuals r of
those that are new, all else being zero:

    ξ = −(H + Gᵀ G)⁻¹ Gᵀ [0; r] = −V S⁻¹ [0; r],  V = Σ Gᵀ,  S = I + G V,  Σ = H⁻¹

(Woodbury), where V is made of the columns of Σ that belong to the loops' poses: two solves a loop
with the factor of H, and no new one. Loops that came since H was factorised are in G, with no
residual left.

H is that of other poses, so the step is no whole one of Gauss-Newton where loops turn the map; used
again and again it would diverge there, so it is used once. Host.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.graph import PoseGraph
from pcm_jax.mapping._linearization import linearize
from pcm_jax.mapping.covariance import LOOPS_SINCE, MapCovariance
from pcm_jax.mapping.least_squares import padded_edges
from pcm_jax.mapping.optimization import host_arrays
from pcm_jax.mapping.priors import priors_of


def first_step(known: MapCovariance, before: int, grown: PoseGraph) -> Any | None:
    """Poses of a map with new edges after one step of Gauss-Newton.

    Args:
        known: of the map at an earlier optimum, `MapCovariance.known`; its factor is used, and made
            if it is not there.
        before: edges of the map when it was last at its optimum, at least as many as `known` has.
        grown: the map, with the edges it had in their order, the new ones behind, and poses at the
            last optimum; new poses where the odometry puts them.

    Returns:
        Lie `[n]`, NumPy; None for a map with priors, with new poses that no odometry reaches, or
        with no loops, or more than `LOOPS_SINCE`, since `known`.

    Raises:
        InputError: for a singular map.
    """
    edges = known.pose_graph.num_edges
    steps = _steps(grown, known.pose_graph.num_poses, edges)
    if steps is None or priors_of(grown) is not None:
        return None
    loops = np.setdiff1d(np.arange(edges, grown.num_edges), steps)
    if not 0 < len(loops) <= LOOPS_SINCE:
        return None
    chain = known.extend(grown.with_edges(np.append(np.arange(edges), steps)))
    residual, ends, slopes = _linearized(chain, grown.with_edges(loops))
    columns = _columns(chain, ends, slopes)
    d, count = grown.tangent_dim, len(loops)
    total = np.eye(count * d).reshape(count, d, count, d)  # S
    for poses, slope in zip(ends, slopes, strict=True):
        total += np.einsum("aij,bajk->aibk", slope, columns[:, poses])
    right = residual * (loops >= before)[:, None]
    weight = np.linalg.solve(total.reshape(count * d, -1), right.ravel()).reshape(count, d)
    step: Any = -np.einsum("bnij,bj->ni", columns, weight)
    moved = np.array(lie.parameters(lie.compose(lie.exp(grown.group, step), chain.frame)))
    moved[:, -len(chain.origin) :] += chain.origin
    moved[0] = lie.parameters(chain.pose_graph.poses)[0]  # which is held, to the last bit
    return lie.normalize(grown.group(moved))


class _Linearized(NamedTuple):
    """Loops at the poses that they join.

    Attributes:
        residual: `[k, d]`, whitened.
        ends: `[2, k]` tails and heads.
        slopes: `[2, k, d, d]`, of the residuals by left perturbations of these poses' `frame`: G.
    """

    residual: Float[np.ndarray, "k d"]
    ends: Int[np.ndarray, "2 k"]
    slopes: Float[np.ndarray, "2 k d d"]


def _linearized(chain: MapCovariance, loops: PoseGraph) -> _Linearized:
    arrays = host_arrays(loops)
    edges = padded_edges(*arrays, size=loops.num_edges)
    residual, *by_right = map(np.asarray, linearize(lie.as_numpy(loops.poses), edges))
    ends = np.stack(arrays[:2])
    adjoint = np.asarray(lie.adjoint(lie.take(chain.frame, ends.ravel())))  # ξ = Ad(X) δ
    slopes = np.stack(by_right).transpose(0, 3, 1, 2)
    return _Linearized(residual.T, ends, slopes @ np.linalg.inv(adjoint).reshape(slopes.shape))


def _columns(
    chain: MapCovariance, ends: Int[np.ndarray, "2 k"], slopes: Float[np.ndarray, "2 k d d"]
) -> Float[np.ndarray, "k n d d"]:
    """V: the covariance of all poses with what each loop measures."""
    everyone, d = np.arange(chain.pose_graph.num_poses), slopes.shape[-1]
    columns = np.zeros((ends.shape[1], len(everyone), d, d))
    for pose in np.unique(ends).tolist():  # loops of one time have an end in common
        column = chain.column(pose, everyone)
        for end, loop in np.argwhere(ends == pose).tolist():
            columns[loop] += column @ slopes[end, loop].T
    return columns


def _steps(graph: PoseGraph, poses: int, edges: int) -> Int[np.ndarray, " g"] | None:
    """The edges that lead, pose by pose, to all from `poses` on; None where one is missing."""
    tail, head = np.asarray(graph.tail)[edges:], np.asarray(graph.head)[edges:]
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    rows = np.flatnonzero((low == high - 1) & (high >= poses))
    reached, first = np.unique(high[rows], return_index=True)
    if not np.array_equal(reached, np.arange(poses, graph.num_poses)):
        return None
    return edges + rows[first]
