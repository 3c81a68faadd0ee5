"""The input of Q inside one map: odometry and the loop closures. Host, float64.

Closure u measures pose k from an earlier pose i of the same robot, so that all four poses of a
pair's loop come from one map and their errors correlate. The map here is the odometry chain alone,
X_{s+1} = X_s z_s, whose joint covariance needs no factorisation: with left perturbations in the
map's frame every step adds an independent error,

    x_k = Σ_{s<k} Ad(X_{s+1}) δ_s,     S_k = Cov(x_k) = Σ_{s<k} Ad(X_{s+1}) Σ_s Ad(X_{s+1})ᵀ,
    Cov(x_i, x_j) = S_min(i, j)

and the covariance of any two steps' differences is a difference of S. Differences are what enters
q², so S starts at the first touched pose, and the map's origin is moved to the mean of the touched
poses, which keeps lever arms short; neither changes q².

All closures are turned to start at the earlier of their two poses. Turned the other way, a pair's
loop is another one, through the sum of the two closures' odometry instead of its difference: as
well calibrated, but less sharp, since what both share then adds up and does not cancel.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import device_array, on_host, pad_leading
from pcm_jax.consistency.problem import padded, padded_size, recentred
from pcm_jax.errors import InputError
from pcm_jax.lie import unrolled

if TYPE_CHECKING:
    from pcm_jax.graph import PoseGraph


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class WithinProblem:
    """The loop closures inside one robot's map, and the uncertainty of its odometry.

    A pytree of arrays of padded sizes, as `ConsistencyProblem` is: `m` closures, `k` touched poses.

    Attributes:
        measurement: Lie `[m]`, z_u: pose b seen from pose a.
        measurement_covariance: `[m, d, d]` of δ in z exp(δ); m², m rad, rad².
        pose_a: Lie `[m]`, the pose each closure starts at, by odometry alone, the origin moved to
            the mean of the touched poses.
        pose_b: Lie `[m]`, the pose it ends at, likewise.
        row_a: int32 `[m]`, the touched pose that it starts at. Rows are in the order of time.
        row_b: int32 `[m]`, likewise.
        cumulated_covariance: `[d(d+1)/2, k]`, S of the touched poses: what odometry has added since
            the first of them, left perturbations in the frame of `pose_a`. Entries are the lower
            triangle, row by row.
        valid: bool `[m]`, false for padding.
    """

    measurement: Any
    measurement_covariance: Float[Array, "m d d"]
    pose_a: Any
    pose_b: Any
    row_a: Int[Array, " m"]
    row_b: Int[Array, " m"]
    cumulated_covariance: Float[Array, "packed k"]
    valid: Bool[Array, " m"]


@on_host
def within_problem(pose_graph: PoseGraph) -> WithinProblem:
    """Gathers what Q needs of the loop closures inside one map: all edges but its odometry.

    The poses are those that the odometry measurements add up to, whatever the graph's own are: an
    optimised map has the closures in it that are in doubt.

    Args:
        pose_graph: a chain, see `odometry_edges`, with closures.

    Returns:
        Padded arrays on the device, float64; closures in the order of the graph's edges, each from
        its earlier to its later pose.

    Raises:
        InputError: for consecutive poses that no edge joins.
    """
    odometry = odometry_edges(pose_graph)
    closing = np.ones(pose_graph.num_edges, bool)
    closing[odometry] = False
    start, end, measurement, covariance = forward(*_edges(pose_graph, np.flatnonzero(closing)))
    touched, rows = np.unique(np.stack([start, end]), return_inverse=True)
    rows = rows.reshape(2, -1)
    poses, cumulated = _chain(pose_graph, odometry, touched)
    count = len(start)
    size = padded_size(count, closures=count)
    cumulated = pad_leading(cumulated, padded_size(len(touched), closures=count))
    return WithinProblem(
        measurement=padded(measurement, size),
        measurement_covariance=device_array(pad_leading(covariance, size)),
        pose_a=padded(lie.take(poses, rows[0]), size),
        pose_b=padded(lie.take(poses, rows[1]), size),
        row_a=device_array(pad_leading(rows[0], size), np.int32),
        row_b=device_array(pad_leading(rows[1], size), np.int32),
        cumulated_covariance=device_array(cumulated.T),
        valid=device_array(np.arange(size) < count, np.bool_),
    )


class OwnLoops(NamedTuple):
    """The loops that m closures make with odometry alone, one by one; NumPy, float64.

    All as left perturbations in the frame of `WithinProblem`, metres and radians: of a right
    closure the error is drawn from N(0, odometry + measured).

    Attributes:
        error: `[m, d]`, r_u = Log(T_u⁻¹).
        odometry: `[m, d, d]`, the covariance of what odometry adds between the closure's poses.
        measured: `[m, d, d]`, that of the closure's own measurement.
    """

    error: Float[np.ndarray, "m d"]
    odometry: Float[np.ndarray, "m d d"]
    measured: Float[np.ndarray, "m d d"]

    def take(self, some: Any) -> OwnLoops:
        """Those of a slice, a mask or indices."""
        return OwnLoops(*(each[some] for each in self))


@on_host
def own_loops(problem: WithinProblem, order: Int[np.ndarray, " m"] | None = None) -> OwnLoops:
    """Finds the loop of each closure with odometry alone.

    Args:
        problem: of m closures, see `within_problem`.
        order: closure u gets the measurement, and its covariance, of `order[u]`; by default its
            own.
    """
    count = int(np.count_nonzero(np.asarray(problem.valid)))
    wanted = np.arange(count) if order is None else np.asarray(order)
    own = np.arange(count)
    measured = lie.take(lie.as_numpy(problem.measurement), wanted)
    pose_a, pose_b = (lie.take(lie.as_numpy(p), own) for p in (problem.pose_a, problem.pose_b))
    reached = lie.compose(pose_a, measured)
    error = np.asarray(lie.log(lie.compose(pose_b, lie.inverse(reached))))
    adjoint = np.asarray(lie.adjoint(reached))
    covariance = np.asarray(problem.measurement_covariance)[wanted]
    cumulated = np.asarray(problem.cumulated_covariance)
    start, end = (np.asarray(row)[:count] for row in (problem.row_a, problem.row_b))
    added = cumulated[:, end] - cumulated[:, start]
    odometry = np.empty((count, error.shape[1], error.shape[1]))
    for entry, (i, j) in zip(added, unrolled.packed_indices(error.shape[1]), strict=True):
        odometry[:, i, j] = odometry[:, j, i] = entry
    return OwnLoops(error, odometry, adjoint @ covariance @ adjoint.swapaxes(1, 2))


@on_host
def reordered(problem: WithinProblem, order: Int[np.ndarray, " m"]) -> WithinProblem:
    """Gives closure u the measurement, and its covariance, of closure `order[u]`."""
    rows = np.arange(len(np.asarray(problem.valid)))
    rows[: len(order)] = order
    return dataclasses.replace(
        problem,
        measurement=lie.as_device(lie.take(lie.as_numpy(problem.measurement), rows)),
        measurement_covariance=device_array(np.asarray(problem.measurement_covariance)[rows]),
    )


@on_host
def with_odometry_errors(problem: WithinProblem, factor: float) -> WithinProblem:
    """Multiplies the standard deviations of odometry by a factor."""
    cumulated = factor**2 * np.asarray(problem.cumulated_covariance)
    return dataclasses.replace(problem, cumulated_covariance=device_array(cumulated))


def odometry_edges(pose_graph: PoseGraph) -> Int[np.ndarray, " steps"]:
    """The edge from each pose to the next, in either direction; the first of several.

    Raises:
        InputError: for consecutive poses that no edge joins.
    """
    tail, head = np.asarray(pose_graph.tail), np.asarray(pose_graph.head)
    steps = np.flatnonzero(np.abs(tail - head) == 1)
    joined, first = np.unique(np.minimum(tail, head)[steps], return_index=True)
    missing = np.setdiff1d(np.arange(pose_graph.num_poses - 1), joined)
    if missing.size:
        before, after = (pose_graph.pose_name(int(missing[0]) + k) for k in (0, 1))
        raise InputError(
            f"map {pose_graph.name!r}: no edge joins poses {before} and {after}, expected odometry"
            f" between all consecutive poses; split(pose_graph, [{missing[0] + 1}]) cuts it there"
        )
    return steps[first]


def forward(
    tail: Int[np.ndarray, " e"],
    head: Int[np.ndarray, " e"],
    measurement: Any,
    information: Float[np.ndarray, "e d d"],
) -> tuple[Int[np.ndarray, " e"], Int[np.ndarray, " e"], Any, Float[np.ndarray, "e d d"]]:
    """Earlier pose, later pose, measurement and covariance of edges, turned to run that way.

    With z' = z⁻¹, an error z exp(δ) is z' exp(−Ad(z) δ).
    """
    backward = (tail > head)[:, None]
    turned = np.where(
        backward, lie.parameters(lie.inverse(measurement)), lie.parameters(measurement)
    )
    covariance = np.linalg.inv(information)
    adjoint = np.asarray(lie.adjoint(measurement))
    carried = adjoint @ covariance @ adjoint.swapaxes(1, 2)
    covariance = np.where(backward[..., None], carried, covariance)
    group = lie.group_of(measurement)
    return np.minimum(tail, head), np.maximum(tail, head), group(turned), covariance


def _edges(pose_graph: PoseGraph, rows: Any) -> tuple[np.ndarray, np.ndarray, Any, np.ndarray]:
    """Tail, head, measurement and information of some edges."""
    tail, head, information = (
        np.asarray(each)[rows]
        for each in (pose_graph.tail, pose_graph.head, pose_graph.information)
    )
    return tail, head, lie.take(lie.as_numpy(pose_graph.measurement), rows), information


def _chain(
    pose_graph: PoseGraph, odometry: np.ndarray, touched: np.ndarray
) -> tuple[Any, Float[np.ndarray, "k packed"]]:
    """Touched poses of the composed odometry, recentred, and S of them, packed."""
    from pcm_jax.graph import spanning_tree_poses

    n, d = pose_graph.num_poses, pose_graph.tangent_dim
    start, end, steps, covariance = forward(*_edges(pose_graph, odometry))
    poses = recentred(spanning_tree_poses(start, end, steps, n), touched)
    added = added_by_steps(lie.take(poses, slice(1, None)), covariance)
    added[: touched[0] if len(touched) else n] = 0.0
    cumulated = np.zeros((n, d * (d + 1) // 2))
    np.cumsum(added, axis=0, out=cumulated[1:])
    return lie.take(poses, touched), cumulated[touched]


def added_by_steps(
    ends: Any, covariance: Float[np.ndarray, "n d d"]
) -> Float[np.ndarray, "n packed"]:
    """The share that each step adds to S, Ad(X_{s+1}) Σ_s Ad(X_{s+1})ᵀ, packed.

    Args:
        ends: Lie `[n]`, the poses at which steps end.
        covariance: of their measurements.
    """
    left = np.asarray(lie.adjoint(ends))
    rows, columns = np.transpose(unrolled.packed_indices(covariance.shape[-1]))
    return (left @ covariance @ left.swapaxes(1, 2))[:, rows, columns]
