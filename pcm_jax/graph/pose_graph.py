"""One robot's map: poses, and the relative measurements between them."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph import checked, symbols, validation
from pcm_jax.graph.checked import batch_size
from pcm_jax.graph.priors import Priors
from pcm_jax.graph.spanning_tree import check_connected, spanning_tree_poses
from pcm_jax.graph.validation import argument_fault

TRACED = ("poses", "tail", "head", "measurement", "information")


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class PoseGraph:
    """Poses of one robot and relative-pose measurements ("edges") between them.

    Edge k says that pose `head[k]`, seen from pose `tail[k]`, is `measurement[k]`, with an error
    in the right perturbation of the measurement, `z exp(δ)`, δ = (translation, rotation) in metres
    and radians, of the given information.

    NumPy-backed, and a pytree with keys: `poses`, `tail`, `head`, `measurement`, `information` are
    its children. `ids`, `name` and `source` live outside the traced part. They are no children and
    no auxiliary data, so they cost no recompilation and cannot go stale, and whatever passes
    through a JAX transformation or `jax.tree.map` comes back with their defaults: `ids` 0 … n − 1,
    no name, no sources. `with_poses`, `with_edges` and `dataclasses.replace` keep them.

    The constructor checks nothing, since its arguments may be tracers: see `from_arrays`.

    Attributes:
        poses: `jaxlie.SE2` or `jaxlie.SE3` `[n]`, float64, in the map's own frame.
        tail: int32 `[e]`, index of the pose an edge starts at.
        head: int32 `[e]`, index of the pose an edge ends at.
        measurement: Lie `[e]`, the pose of the head seen from the tail.
        information: `[e, d, d]`, inverse covariance of δ; 1/m², 1/(m rad), 1/rad².
        ids: int64 NumPy `[n]`, the poses' ids in the file they came from.
        name: the robot's name.
        source: NumPy `[e]` of strings, "file:line" of each edge, or "" where not from a file.
        stamps: float64 NumPy `[n]`, seconds, NaN for a pose without a time; None without times.
        priors: poses measured by themselves; None for none.
    """

    poses: Any
    tail: Int[np.ndarray | Array, " e"]
    head: Int[np.ndarray | Array, " e"]
    measurement: Any
    information: Float[np.ndarray | Array, "e d d"]
    ids: np.ndarray = None  # type: ignore[assignment]
    name: str = ""
    source: np.ndarray = None  # type: ignore[assignment]
    stamps: np.ndarray | None = None
    priors: Priors | None = None

    def __post_init__(self) -> None:
        if self.ids is None:
            object.__setattr__(self, "ids", np.arange(batch_size(self.poses), dtype=np.int64))
        if self.source is None:
            object.__setattr__(self, "source", np.full(batch_size(self.measurement), "", object))

    def __repr__(self) -> str:
        kind = type(self.poses).__name__
        return f"PoseGraph({self.name!r}: {self.num_poses} poses, {self.num_edges} edges, {kind})"

    @property
    def num_poses(self) -> int:
        """The number of poses, n."""
        return batch_size(self.poses)

    @property
    def num_edges(self) -> int:
        """The number of edges, e."""
        return batch_size(self.measurement)

    @property
    def group(self) -> type[Any]:
        """`jaxlie.SE2` or `jaxlie.SE3`."""
        return lie.group_of(self.poses)

    @property
    def tangent_dim(self) -> int:
        """d: 3 for SE(2), 6 for SE(3)."""
        return lie.tangent_dim(self.poses)

    def pose_name(self, index: int) -> str:
        """The robot's name and the pose's id, a symbol's index for symbol keys.

        "a12" for a name of one letter, "name:12" for any other.
        """
        mark = "" if len(self.name) == 1 and not self.name.isdigit() else ":"
        return f"{self.name}{mark}{symbols.indices_of(self.ids[[index]])[0]}"

    def with_poses(self, poses: Any) -> PoseGraph:
        """Puts the same graph at other poses; ids, name and sources are kept."""
        return dataclasses.replace(self, poses=poses)

    def without_priors(self) -> PoseGraph:
        """Leaves out the poses measured by themselves."""
        return dataclasses.replace(self, priors=None)

    def with_edges(self, edges: Any) -> PoseGraph:
        """Keeps some of the edges, by a mask `[e]` or indices; poses, ids and name are kept."""
        rows = np.asarray(edges)
        return dataclasses.replace(
            self,
            tail=np.asarray(self.tail)[rows],
            head=np.asarray(self.head)[rows],
            measurement=lie.take(lie.as_numpy(self.measurement), rows),
            information=np.asarray(self.information)[rows],
            source=self.source[rows],
        )

    @classmethod
    def from_arrays(
        cls,
        *,
        poses: Any = None,
        tail: Any,
        head: Any,
        measurement: Any,
        information: Any = None,
        covariance: Any = None,
        ids: Any = None,
        name: str = "",
        tangent_order: str = "translation-rotation",
        source: Any = None,
    ) -> PoseGraph:
        """Makes a validated pose graph, float64 also where 64-bit types are not enabled.

        Args:
            poses: `jaxlie.SE2` or `jaxlie.SE3` `[n]`, or homogeneous matrices `[n, 3, 3]` or
                `[n, 4, 4]`. None composes the measurements along a spanning tree (poses joined by
                consecutive indices first) from the identity at pose 0.
            tail: integers `[e]` in 0 … n − 1.
            head: integers `[e]` in 0 … n − 1.
            measurement: like `poses`, `[e]`: the head's pose seen from the tail.
            information: `[e, d, d]`, symmetric positive definite; or
            covariance: its inverse. Exactly one of the two.
            ids: integers `[n]`, all different; 0 … n − 1 by default.
            name: the robot's name.
            tangent_order: order of the information's rows and columns,
                "translation-rotation" or "rotation-translation" (GTSAM's `Pose3`).
            source: strings `[e]`, where each edge was read.

        Raises:
            InputError: for a wrong shape, a number that is not finite, an index out of range, a
                self loop, a matrix that is not a rigid motion, information that is not symmetric
                and positive definite, a graph that is not connected.

        Warns:
            InputWarning: for quaternions further than 1e-3 from unit length, which are scaled.
        """
        edges = checked.as_transforms(measurement, "measurement")
        given = None if poses is None else _poses_like(edges, poses)
        n = None if given is None else len(lie.parameters(given))
        tail, head = as_edges(tail, head, n, len(lie.parameters(edges)))
        n = n or 1 + int(max(tail.max(initial=0), head.max(initial=0)))
        matrices = checked.as_information(information, covariance, edges, tangent_order)
        ids = checked.as_ids(ids, n)
        if given is None:
            given = spanning_tree_poses(tail, head, edges, n, prefer="odometry", ids=ids)
        else:
            check_connected(tail, head, n, ids=ids)
        return cls.from_checked(
            poses=given,
            tail=tail,
            head=head,
            measurement=edges,
            information=matrices,
            ids=ids,
            name=name,
            source=checked.as_names(source, len(tail)),
        )

    @classmethod
    def from_checked(
        cls,
        *,
        poses: Any,
        tail: np.ndarray,
        head: np.ndarray,
        measurement: Any,
        information: np.ndarray,
        ids: np.ndarray,
        name: str,
        source: np.ndarray,
        stamps: np.ndarray | None = None,
        priors: Priors | None = None,
    ) -> PoseGraph:
        """Makes a graph of NumPy arrays and NumPy-backed transforms validated before."""
        return cls(
            poses=lie.as_numpy(poses),
            tail=np.asarray(tail, np.int32),
            head=np.asarray(head, np.int32),
            measurement=lie.as_numpy(measurement),
            information=np.asarray(information, np.float64),
            ids=ids,
            name=name,
            source=source,
            stamps=stamps,
            priors=priors,
        )

    @classmethod
    def from_trajectory(
        cls,
        poses: Any,
        *,
        sigma_translation: float,
        sigma_rotation: float,
        ids: Any = None,
        name: str = "",
    ) -> PoseGraph:
        """Makes an odometry chain: consecutive poses joined by their own relative pose.

        Args:
            poses: `jaxlie.SE2` or `jaxlie.SE3` `[n]`, or homogeneous matrices.
            sigma_translation: standard deviation of each translation component of a step, metres.
            sigma_rotation: standard deviation of each rotation component of a step, radians.
            ids: integers `[n]`; 0 … n − 1 by default.
            name: the robot's name.

        Raises:
            InputError: for bad poses (see `from_arrays`) or a sigma that is not positive.
        """
        sigmas = {"sigma_translation": sigma_translation, "sigma_rotation": sigma_rotation}
        for argument, sigma in sigmas.items():
            number = isinstance(sigma, float | int | np.number) and not isinstance(sigma, bool)
            if not number or not 0.0 < sigma < validation.LARGEST:
                raise InputError(f"{argument}: {sigma} given, expected a positive number")
        given = checked.as_transforms(poses, "poses")
        n, d = len(lie.parameters(given)), lie.tangent_dim(given)
        steps = lie.between(lie.take(given, slice(None, -1)), lie.take(given, slice(1, None)))
        translation = lie.module_of(lie.group_of(given)).MATRIX_DIM - 1
        variances = np.full(d, sigma_rotation**2)
        variances[:translation] = sigma_translation**2
        return cls.from_arrays(
            poses=given,
            tail=np.arange(n - 1),
            head=np.arange(1, n),
            measurement=steps,
            information=np.broadcast_to(np.diag(1.0 / variances), (max(n - 1, 0), d, d)),
            ids=ids,
            name=name,
        )


def _poses_like(edges: Any, poses: Any) -> Any:
    """The poses of `from_arrays`, of the group of its measurements."""
    given = checked.as_transforms(poses, "poses")
    if lie.group_of(given) is not lie.group_of(edges):
        raise InputError(
            f"measurement: {lie.group_of(edges).__name__} given,"
            f" expected {lie.group_of(given).__name__} like the poses"
        )
    if not len(lie.parameters(given)):
        raise InputError("poses: none given, expected at least one")
    return given


def as_edges(tail: Any, head: Any, n: int | None, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Both ends of `count` edges between `n` poses (None: as many as they name), checked, int32."""
    tail = validation.as_indices(tail, n, "tail", "poses")
    head = validation.as_indices(head, n, "head", "poses")
    for argument, values in (("tail", tail), ("head", head)):
        if len(values) != count:
            raise InputError(
                f"{argument}: {len(values)} entries given, expected {count}, one per measurement"
            )
    validation.check_self_loops(tail, head, argument_fault("head"))
    return tail, head


def _flatten(graph: PoseGraph) -> tuple[tuple[Any, ...], None]:
    return tuple(getattr(graph, field) for field in TRACED), None


def _flatten_with_keys(graph: PoseGraph) -> tuple[tuple[Any, ...], None]:
    keys = (jax.tree_util.GetAttrKey(field) for field in TRACED)
    return tuple(zip(keys, _flatten(graph)[0], strict=True)), None


jax.tree_util.register_pytree_with_keys(
    PoseGraph, _flatten_with_keys, lambda _, children: PoseGraph(*children), _flatten
)
