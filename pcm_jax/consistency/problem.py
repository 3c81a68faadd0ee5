"""The input of Q: two maps and the closures between them. Host code, float64.

A closure u measures pose k of map b from pose i of map a. Q depends on the maps only through the
poses that closures touch and through the covariance of the *differences* of their errors,

    G_ij = Σ_ii + Σ_jj − Σ_ij − Σ_ji,        Σ the joint covariance of all touched poses.

The errors are left perturbations in the map's frame, `exp(ξ_i) X_i`, so that ξ_j − ξ_i is what
moves pose j against pose i, and an error common to the whole map (the choice of a gauge) cancels.
G is built here, in float64, because it is a small difference of large numbers. For the same reason
each map's origin is first moved to its middle (`MapCovariance.origin`), which changes no q, and
does not move when a closure touches another pose.

**Covariances of one's own optimiser.** `consistency_problem` takes maps as it finds them, and the
joint covariance of the poses that closures touch (ascending, each once) as `marginals`. With GTSAM:

```python
import gtsam

def joint_covariance(one, poses):
    factors, values = pcm.to_gtsam(one)                # keys are the poses' ids
    first, gauge = int(one.ids[0]), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    factors.add(gtsam.PriorFactorPose2(first, values.atPose2(first), gauge))
    keys = gtsam.KeyVector(one.ids[poses].tolist())
    return gtsam.Marginals(factors, values).jointMarginalCovariance(keys).fullMatrix()

touched = np.unique(closures.pose_a), np.unique(closures.pose_b)
marginals = tuple(joint_covariance(one, poses) for one, poses in zip(maps, touched))
problem = pcm.consistency_problem(*maps, closures, marginals=marginals)
```
"""

from __future__ import annotations

import dataclasses
import warnings
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import bucket, device_array, on_host, pad_leading
from pcm_jax.consistency._relative import checked_joint, relative_covariance
from pcm_jax.errors import InputError, InputWarning, check_class
from pcm_jax.graph.unsaid import noise_of
from pcm_jax.mapping import MapCovariance

if TYPE_CHECKING:
    from pcm_jax.graph import LoopClosures, PoseGraph

# Up to 64 closures cost under a millisecond, padding included; from 256 its memory matters.
SMALLEST_PADDED, FINE_ABOVE = 64, 256


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, repr=False)
class ConsistencyProblem:
    """The closures between two robots, and the uncertainty of the maps they join.

    A pytree of arrays of padded sizes: `m` closures, `ka` and `kb` touched poses are rounded up to
    a few sizes, so that robot pairs share compilations. Padded closures repeat the last one.

    Attributes:
        measurement: Lie `[m]`, z_u: pose b seen from pose a.
        measurement_covariance: `[m, d, d]` of δ in z exp(δ); m², m rad, rad².
        pose_a: Lie `[m]`, the optimised pose in map a that each closure starts at, in the frame of
            map a with its origin moved to the map's middle.
        pose_b: Lie `[m]`, the one in map b that each closure ends at, likewise.
        row_a: int32 `[m]`, the row of that pose in `relative_covariance_a`.
        row_b: int32 `[m]`, likewise.
        relative_covariance_a: `[d(d+1)/2, ka, ka]`, G of map a: for rows i and j the covariance of
            ξ_j − ξ_i, left perturbations in the frame of `pose_a`. Entries are the lower triangle,
            row by row. Rows come in the order in which closures first touch the poses.
        relative_covariance_b: `[d(d+1)/2, kb, kb]`, likewise.
        valid: bool `[m]`, false for padding.
        free: `[m, d, f]`, directions of δ that closures leave unsaid, as columns, filled up with
            zeros; `measurement_covariance` has some finite value along them, which does not count.
            None where every closure says all: see `LoopClosures.rank`.
    """

    measurement: Any
    measurement_covariance: Float[Array, "m d d"]
    pose_a: Any
    pose_b: Any
    row_a: Int[Array, " m"]
    row_b: Int[Array, " m"]
    relative_covariance_a: Float[Array, "packed ka ka"]
    relative_covariance_b: Float[Array, "packed kb kb"]
    valid: Bool[Array, " m"]
    free: Float[Array, "m d f"] | None = None

    def __repr__(self) -> str:
        group = type(self.measurement).__name__
        padded = getattr(self.valid, "shape", ("?",))[-1]
        count = padded if isinstance(self.valid, Tracer) else int(np.sum(np.asarray(self.valid)))
        sides = self.relative_covariance_a, self.relative_covariance_b
        rows = ", ".join(str(getattr(side, "shape", ("?",))[-1]) for side in sides)
        dtype = getattr(self.measurement_covariance, "dtype", "?")
        return (
            f"ConsistencyProblem({group}, {count} closures)\n"
            f"  padded  {padded} closures; {rows} poses of map a, b\n"
            f"  dtype   {dtype}"
        )

    @on_host
    def astype(self, dtype: Any) -> ConsistencyProblem:
        """The same problem in another precision, which all that is computed of it then has.

        Args:
            dtype: float32 or float64. In float32, squared distances mostly keep four digits, and
                a kernel takes half the memory and, on a GPU, a fraction of the time.

        Raises:
            InputError: for another dtype.

        Warns:
            InputWarning: if float32 moves squared distances by more than 1e-3, relative to
                themselves or to d, in a sample of the pairs (see `single_precision`): maps that
                reach too far for the precision of their closures.
        """
        if dtype not in (np.float32, np.float64):
            raise InputError(f"dtype: {dtype!r}, expected float32 or float64")
        if dtype == np.float32 and self.free is not None:
            raise InputError(
                "dtype: float32 given for closures that leave directions unsaid, expected float64"
            )
        if dtype == np.float32 and self.measurement_covariance.dtype == np.float64:
            _warn_of_rounding(self)
        real = [(x, np.issubdtype(x.dtype, np.floating)) for x in jax.tree.leaves(self)]
        cast = [device_array(x, dtype) if is_real else x for x, is_real in real]
        return jax.tree.unflatten(jax.tree.structure(self), cast)


def _warn_of_rounding(problem: ConsistencyProblem) -> None:
    from pcm_jax.consistency._single_precision import TOLERANCE, single_precision_error

    error = single_precision_error(problem)
    if error > TOLERANCE:
        warnings.warn(
            f"dtype: float32 moves these squared distances by up to {error:.1g} of their value, "
            f"expected at most {TOLERANCE:g}; the maps reach too far for the closures' precision, "
            "keep float64",
            InputWarning,
            stacklevel=4,
        )


@on_host
def consistency_problem(
    map_a: PoseGraph,
    map_b: PoseGraph,
    closures: LoopClosures,
    *,
    marginals: tuple[Float[np.ndarray, "ka*d ka*d"], Float[np.ndarray, "kb*d kb*d"]] | None = None,
) -> ConsistencyProblem:
    """Gathers what Q needs of two optimised maps and the closures between them.

        maps = [pcm_jax.optimize(one).graph for one in graph.maps]
        closures, indices = graph.closures.between(0, 1)
        squared = pcm_jax.squared_mahalanobis(pcm_jax.consistency_problem(*maps, closures))

    Args:
        map_a: the optimised map of the robot that the closures start at.
        map_b: the optimised map of the robot that they end at.
        closures: all from one robot to one other, as `LoopClosures.between` gives them.
        marginals: joint covariances of the touched poses of each map, if other than
            `joint_marginal_covariance`'s. Each is a dense float64 matrix with a d x d block per
            touched pose, the poses in ascending order of index without repetition, for right
            perturbations `X exp(δ)` in (translation, rotation) order; metres and radians. Any
            gauge will do. From GTSAM (whose `Pose3` puts rotation first), for SE(3):

                touched = np.unique(closures.pose_a)
                joint = gtsam.Marginals(graph, values).jointMarginalCovariance(list(touched))
                order = [3, 4, 5, 0, 1, 2]
                blocks = [[joint.at(i, j)[np.ix_(order, order)] for j in touched] for i in touched]
                marginals = (np.block(blocks), ...)

    Returns:
        Padded arrays on the device, float64.

    Raises:
        InputError: for closures of several robot pairs, a pose that a map does not have, groups
            that differ, or marginals of a wrong shape, not finite or not symmetric.
    """
    if marginals is None:
        return problem_from_covariances(MapCovariance(map_a), MapCovariance(map_b), closures)
    check_pair(map_a, map_b, closures)
    a = _given(map_a, np.asarray(closures.pose_a), marginals[0], "marginals[0]")
    b = _given(map_b, np.asarray(closures.pose_b), marginals[1], "marginals[1]")
    return _problem(closures, a, b)


@on_host
def problem_from_covariances(
    covariance_a: MapCovariance, covariance_b: MapCovariance, closures: LoopClosures
) -> ConsistencyProblem:
    """Gathers what Q needs, see `consistency_problem`, of maps that are factorised already."""
    check_pair(covariance_a.pose_graph, covariance_b.pose_graph, closures)
    a = _asked(covariance_a, np.asarray(closures.pose_a))
    b = _asked(covariance_b, np.asarray(closures.pose_b))
    return _problem(closures, a, b)


def _problem(closures: LoopClosures, a: _OneMap, b: _OneMap) -> ConsistencyProblem:
    group, count = closures.group, len(closures)
    size = padded_size(count, closures=count)
    covariance, free = noise_of(np.asarray(closures.information, dtype=np.float64))
    if count == 0:
        d = lie.tangent_dim(group)
        covariance = np.broadcast_to(np.eye(d), (size, d, d))
    return ConsistencyProblem(
        measurement=padded(lie.as_numpy(closures.measurement), size),
        measurement_covariance=device_array(pad_leading(covariance, size)),
        pose_a=padded(a.poses, size),
        pose_b=padded(b.poses, size),
        row_a=device_array(pad_leading(a.rows, size), np.int32),
        row_b=device_array(pad_leading(b.rows, size), np.int32),
        relative_covariance_a=device_array(a.relative_covariance),
        relative_covariance_b=device_array(b.relative_covariance),
        valid=device_array(np.arange(size) < count, np.bool_),
        free=None if free is None else device_array(pad_leading(free, size)),
    )


@dataclasses.dataclass(frozen=True)
class _OneMap:
    """One map's share of a problem, not padded but for `relative_covariance`."""

    poses: Any
    rows: np.ndarray
    relative_covariance: np.ndarray


class _Touched(NamedTuple):
    """The poses of a map that closures touch.

    In the order of first use, neighbouring closures read neighbouring rows of G.

    Attributes:
        poses: `[k]`, ascending.
        order: `[k]`, which of them each row of G stands for.
        rows: `[m]`, the row of each closure's pose.
        size: rows of G, padded.
    """

    poses: Int[np.ndarray, " k"]
    order: Int[np.ndarray, " k"]
    rows: Int[np.ndarray, " m"]
    size: int


def _touched(touching: Int[np.ndarray, " m"]) -> _Touched:
    poses, first, index = np.unique(touching, return_index=True, return_inverse=True)
    order = np.argsort(first)
    size = padded_size(len(poses), closures=len(touching))
    return _Touched(poses, order, np.argsort(order)[index], size)


def _asked(covariance: MapCovariance, touching: Int[np.ndarray, " m"]) -> _OneMap:
    """A map's share of a problem, by its own covariance, which needs no check."""
    touched = _touched(touching)
    d = covariance.pose_graph.tangent_dim
    joint = covariance.joint(touched.poses[touched.order], side="left")
    relative = relative_covariance(joint, None, np.arange(len(touched.order)), touched.size, d)
    return _OneMap(lie.take(covariance.frame, touching), touched.rows, relative)


def _given(
    pose_graph: PoseGraph, touching: Int[np.ndarray, " m"], joint: Any, name: str
) -> _OneMap:
    """A map's share of a problem, by the joint covariance that a user gives."""
    touched, frame = _touched(touching), recentred(lie.as_numpy(pose_graph.poses))
    d = pose_graph.tangent_dim
    joint = checked_joint(joint, len(touched.poses) * d, name)
    adjoint = np.asarray(lie.adjoint(lie.take(frame, touched.poses)))
    relative = relative_covariance(joint, adjoint, touched.order, touched.size, d)
    return _OneMap(lie.take(frame, touching), touched.rows, relative)


def bytes_needed(closures: LoopClosures) -> float:
    """About what the closures between two robots take on the way to Q, in bytes.

    Of k poses that closures touch in a map: their joint covariance, (k d)² numbers, and G; of m
    closures: Q and its tiles.
    """
    d = lie.tangent_dim(closures.measurement)
    of_a_pair_of_poses = d * d + d * (d + 1) // 2
    touched = [len(np.unique(np.asarray(poses))) for poses in (closures.pose_a, closures.pose_b)]
    return 8.0 * (of_a_pair_of_poses * sum(k**2 for k in touched) + 2 * len(closures) ** 2)


def padded_size(rows: int, *, closures: int) -> int:
    """Padded length of closures or of touched poses: one size for both while that is cheap."""
    rows = max(rows, min(closures, FINE_ABOVE))
    return bucket(rows, smallest=SMALLEST_PADDED, fine_above=FINE_ABOVE)


def recentred(poses: Any, about: Any = slice(None)) -> Any:
    """NumPy-backed poses `[n]`, the mean position of those in `about` as their origin."""
    values = np.array(lie.parameters(poses))
    space = lie.module_of(lie.group_of(poses)).MATRIX_DIM - 1
    middle = values[about, -space:]
    if len(middle):
        values[:, -space:] -= middle.mean(axis=0)
    return lie.group_of(poses)(values)


def padded(transforms: Any, size: int) -> Any:
    """A NumPy-backed batch as a device one of `size`, float64; the last element repeated."""
    return lie.as_device(lie.pad_leading(transforms, size))


def check_pair(map_a: PoseGraph, map_b: PoseGraph, closures: LoopClosures) -> None:
    """Raises `InputError`, as `consistency_problem`, for maps and closures that do not match."""
    from pcm_jax.graph import LoopClosures, PoseGraph

    check_class("map_a", map_a, "a PoseGraph", PoseGraph)
    check_class("map_b", map_b, "a PoseGraph", PoseGraph)
    check_class("closures", closures, "LoopClosures", LoopClosures)
    _check_group(map_a, map_b, closures)
    _check_one_pair(closures)
    _check_indices(np.asarray(closures.pose_a), map_a.num_poses, "pose_a")
    _check_indices(np.asarray(closures.pose_b), map_b.num_poses, "pose_b")


def _check_group(map_a: PoseGraph, map_b: PoseGraph, closures: LoopClosures) -> None:
    group = lie.group_of(closures.measurement)
    for name, pose_graph in (("map_a", map_a), ("map_b", map_b)):
        other = lie.group_of(pose_graph.poses)
        if other is not group:
            raise InputError(
                f"{name}: poses are {other.__name__}, expected {group.__name__} like the closures"
            )


def _check_one_pair(closures: LoopClosures) -> None:
    robots = np.stack([np.asarray(closures.robot_a), np.asarray(closures.robot_b)], axis=1)
    pairs = np.unique(robots, axis=0)
    if len(pairs) > 1:
        (a, b), (c, e) = pairs[:2]
        raise InputError(
            f"closures: some join robots {a} to {b}, others {c} to {e}; expected one pair in one "
            "direction, as closures.between(a, b) gives"
        )


def _check_indices(indices: np.ndarray, count: int, argument: str) -> None:
    outside = np.flatnonzero((indices < 0) | (indices >= count))
    if outside.size:
        raise InputError(
            f"closures.{argument}[{outside[0]}]: pose {indices[outside[0]]} is not in the map; "
            f"expected 0 to {count - 1}"
        )
