"""Measurements between the poses of different robots."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import as_array
from pcm_jax.errors import InputError, check_class
from pcm_jax.graph import checked, symbols, validation
from pcm_jax.graph.checked import batch_size
from pcm_jax.graph.unsaid import ranks
from pcm_jax.graph.validation import argument_fault

if TYPE_CHECKING:
    from pcm_jax.graph.pose_graph import PoseGraph

TRACED = ("robot_a", "pose_a", "robot_b", "pose_b", "measurement", "information", "weight")
ENDS = TRACED[:4]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class LoopClosures:
    """Inter-robot relative-pose measurements, some of which may be false.

    Closure k says that pose `pose_b[k]` of robot `robot_b[k]`, seen from pose `pose_a[k]` of robot
    `robot_a[k]`, is `measurement[k]`, with an error in the right perturbation `z exp(δ)`,
    δ = (translation, rotation) in metres and radians. Robots and poses are indices, not ids.

    NumPy-backed, and a pytree with keys: all fields but `source` are its children. `source` lives
    outside the traced part, as a `PoseGraph`'s ids do, and is lost where JAX rebuilds the object.
    The constructor checks nothing: see `from_arrays` and `from_ids`.

    Attributes:
        robot_a: int32 `[m]`.
        pose_a: int32 `[m]`.
        robot_b: int32 `[m]`.
        pose_b: int32 `[m]`.
        measurement: `jaxlie.SE2` or `jaxlie.SE3` `[m]`.
        information: `[m, d, d]`, inverse covariance of δ.
        weight: float `[m]`, at least 0: how much a front end trusts each closure; 1 by default.
        source: NumPy `[m]` of strings, "file:line" of each closure, or "" where not from a file.
        is_true: bool NumPy `[m]`, the labels of closures whose truth is known; None where it is
            not. Outside the traced part, as `source` is.
    """

    robot_a: Int[np.ndarray | Array, " m"]
    pose_a: Int[np.ndarray | Array, " m"]
    robot_b: Int[np.ndarray | Array, " m"]
    pose_b: Int[np.ndarray | Array, " m"]
    measurement: Any
    information: Float[np.ndarray | Array, "m d d"]
    weight: Float[np.ndarray | Array, " m"] = None  # type: ignore[assignment]
    source: np.ndarray = None  # type: ignore[assignment]
    is_true: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.weight is None:
            object.__setattr__(self, "weight", np.ones(batch_size(self.measurement)))
        if self.source is None:
            object.__setattr__(self, "source", np.full(batch_size(self.measurement), "", object))

    def __repr__(self) -> str:
        return f"LoopClosures({len(self)}, {type(self.measurement).__name__})"

    def __len__(self) -> int:
        return batch_size(self.measurement)

    @property
    def group(self) -> type[Any]:
        """`jaxlie.SE2` or `jaxlie.SE3`."""
        return lie.group_of(self.measurement)

    @property
    def tangent_dim(self) -> int:
        """d: 3 for SE(2), 6 for SE(3)."""
        return lie.tangent_dim(self.measurement)

    @property
    def rank(self) -> Int[np.ndarray, " m"]:
        """Directions that each closure says something of, int64 `[m]`: d, or fewer.

        A planar closure between maps in space has rank 3 of 6. Pairs of such closures are judged
        with the degrees of freedom that both have in common (`freedom_of`).
        """
        return ranks(np.asarray(self.information))

    def __getitem__(self, rows: Any) -> LoopClosures:
        """The closures at integer indices, at one index, in a slice, or where a mask `[m]` is true.

        Raises:
            InputError: for a mask of another length.
        """
        rows = np.asarray(rows) if not isinstance(rows, slice) else rows
        if not isinstance(rows, slice):
            if rows.dtype == bool and rows.shape != (len(self),):
                raise InputError(
                    f"closures[mask]: mask of shape {rows.shape}, expected ({len(self)},)"
                )
            rows = np.atleast_1d(rows) if rows.size else np.zeros(0, np.int64)
        return self.from_checked(
            tuple(np.asarray(getattr(self, name))[rows] for name in ENDS),
            lie.take(lie.as_numpy(self.measurement), rows),
            np.asarray(self.information)[rows],
            self.source[rows],
            np.asarray(self.weight)[rows],
            None if self.is_true is None else self.is_true[rows],
        )

    def between(self, a: int, b: int) -> tuple[LoopClosures, np.ndarray]:
        """The closures that join robots `a` and `b`, oriented from `a` to `b`.

        One stored from b to a is inverted exactly: with z' = z⁻¹, an error z exp(δ) is
        z' exp(δ') for δ' = −Ad(z) δ, so Ω' = Ad(z)⁻ᵀ Ω Ad(z)⁻¹.

        Returns:
            The closures, and their indices (int64) here, ascending.
        """
        robot_a, robot_b = np.asarray(self.robot_a), np.asarray(self.robot_b)
        backward = (robot_a == b) & (robot_b == a)
        indices = np.flatnonzero(((robot_a == a) & (robot_b == b)) | backward)
        return self[indices]._flipped(backward[indices]), indices

    def _flipped(self, rows: np.ndarray) -> LoopClosures:
        """The same closures, with those where `rows` is true stored the other way round."""
        if not rows.any():
            return self
        measurement = lie.as_numpy(self.measurement)
        inverse = lie.inverse(measurement)
        values = np.where(rows[:, None], lie.parameters(inverse), lie.parameters(measurement))
        information = np.array(self.information)
        back = lie.adjoint(lie.take(inverse, rows))  # Ad(z)⁻¹ = Ad(z⁻¹)
        information[rows] = np.swapaxes(back, 1, 2) @ information[rows] @ back
        ends = [np.asarray(getattr(self, name)) for name in ENDS]
        flipped = tuple(np.where(rows, ends[(k + 2) % 4], ends[k]) for k in range(4))
        return self.from_checked(
            flipped, self.group(values), information, self.source, self.weight, self.is_true
        )

    def pairs(self) -> list[tuple[int, int]]:
        """The pairs of robots that closures join, (a, b) with a < b, sorted."""
        robots = np.stack([np.asarray(self.robot_a), np.asarray(self.robot_b)], axis=1)
        unique = np.unique(np.sort(robots, axis=1), axis=0)
        return [(int(a), int(b)) for a, b in unique]

    @classmethod
    def from_arrays(
        cls,
        *,
        robot_a: Any,
        pose_a: Any,
        robot_b: Any,
        pose_b: Any,
        measurement: Any,
        information: Any = None,
        covariance: Any = None,
        tangent_order: str = "translation-rotation",
        weight: Any = None,
        source: Any = None,
    ) -> LoopClosures:
        """Makes validated closures, float64 also where 64-bit types are not enabled.

        Whether the robots and poses exist is checked where the maps are known
        (`MultiRobotGraph`).

        Args:
            robot_a: integers `[m]`, indices of robots.
            pose_a: integers `[m]`, indices of robot a's poses.
            robot_b: integers `[m]`.
            pose_b: integers `[m]`.
            measurement: `jaxlie.SE2` or `jaxlie.SE3` `[m]`, or homogeneous matrices `[m, 3, 3]` or
                `[m, 4, 4]`: pose b seen from pose a.
            information: `[m, d, d]`, symmetric and positive definite, or semidefinite where a
                closure says nothing of some directions (see `rank`); or
            covariance: its inverse. Exactly one of the two.
            tangent_order: "translation-rotation" or "rotation-translation" (GTSAM's `Pose3`).
            weight: numbers `[m]` of at least 0, a front end's score; 1 by default.
            source: strings `[m]`, where each closure was read.

        Raises:
            InputError: for a wrong shape, a number that is not finite, a negative index or weight,
                a closure from a robot to itself, information that is not symmetric and positive
                semidefinite, or says nothing at all.
        """
        edges = checked.as_transforms(measurement, "measurement")
        count = len(lie.parameters(edges))
        given = {"robot_a": robot_a, "pose_a": pose_a, "robot_b": robot_b, "pose_b": pose_b}
        ends = []
        for argument, values in given.items():
            indices = validation.as_indices(values, None, argument, "")
            if len(indices) != count:
                raise InputError(
                    f"{argument}: {len(indices)} entries given,"
                    f" expected {count}, one per measurement"
                )
            ends.append(indices)
        validation.raise_first(
            ends[0] == ends[2],
            argument_fault("robot_b"),
            lambda row: f"closure from robot {ends[0][row]} to itself, expected two robots",
        )
        matrices = checked.as_information(
            information, covariance, edges, tangent_order, singular=True
        )
        names, weights = checked.as_names(source, count), checked.as_weights(weight, count)
        return cls.from_checked(tuple(ends), edges, matrices, names, weights)

    @classmethod
    def from_ids(
        cls,
        maps: Sequence[PoseGraph],
        *,
        robot_a: Any,
        id_a: Any,
        robot_b: Any,
        id_b: Any,
        **measured: Any,
    ) -> LoopClosures:
        """Makes validated closures from the ids of poses.

        Args:
            maps: the robots' maps.
            robot_a: indices or names of robots `[m]`.
            id_a: integers `[m]`: ids of robot a's poses; where they are symbol keys, the symbol's
                index will do.
            robot_b: like `robot_a`.
            id_b: like `id_a`.
            measured: `measurement`, `information` or `covariance`, `tangent_order`, `weight`,
                `source`, as for `from_arrays`.

        Raises:
            InputError: as `from_arrays`, and for a robot or an id that is not there.
        """
        a, b = robot_indices(maps, robot_a, "robot_a"), robot_indices(maps, robot_b, "robot_b")
        return cls.from_arrays(
            robot_a=a,
            pose_a=pose_indices(maps, a, id_a, argument_fault("id_a")),
            robot_b=b,
            pose_b=pose_indices(maps, b, id_b, argument_fault("id_b")),
            **measured,
        )

    @classmethod
    def from_checked(
        cls,
        ends: tuple[np.ndarray, ...],
        measurement: Any,
        information: np.ndarray,
        source: np.ndarray,
        weight: Any = None,
        is_true: np.ndarray | None = None,
    ) -> LoopClosures:
        """Makes closures of NumPy arrays and NumPy-backed transforms validated before.

        Args:
            ends: `robot_a`, `pose_a`, `robot_b`, `pose_b`.
            measurement: as the attribute of that name.
            information: likewise.
            source: likewise.
            weight: likewise; None for ones.
            is_true: likewise.
        """
        a, i, b, k = (np.asarray(end, np.int32) for end in ends)
        measurement = lie.as_numpy(measurement)
        information = np.asarray(information, np.float64)
        weight = np.ones(len(a)) if weight is None else np.asarray(weight, np.float64)
        return cls(a, i, b, k, measurement, information, weight, source, is_true)

    @classmethod
    def concatenate(cls, parts: Sequence[LoopClosures]) -> LoopClosures:
        """Joins closures end to end, in the order given; robots and poses keep their indices.

        Raises:
            InputError: for no parts, or parts of different groups.
        """
        check_class("parts", parts, "a list of LoopClosures", list, tuple)
        for number, part in enumerate(parts):
            check_class(f"parts[{number}]", part, "LoopClosures", LoopClosures)
        groups = {part.group.__name__ for part in parts}
        if len(groups) != 1:
            given = ", ".join(sorted(groups)) or "none"
            raise InputError(f"parts: groups {given} given, expected closures of one group")
        return cls.from_checked(
            tuple(np.concatenate([np.asarray(getattr(p, name)) for p in parts]) for name in ENDS),
            lie.concatenate([lie.as_numpy(part.measurement) for part in parts]),
            np.concatenate([np.asarray(part.information) for part in parts]),
            np.concatenate([part.source for part in parts]),
            np.concatenate([np.asarray(part.weight) for part in parts]),
            _labels(parts),
        )

    @classmethod
    def empty(cls, group: type[Any]) -> LoopClosures:
        """Makes no closures, of a group."""
        d = lie.tangent_dim(group)
        none = np.zeros(0, np.int32)
        return cls.from_checked(
            (none,) * 4, lie.identity(group, (0,)), np.zeros((0, d, d)), np.zeros(0, object)
        )


def _labels(parts: Sequence[LoopClosures]) -> np.ndarray | None:
    """The labels of all parts, where every closure has one."""
    labels = [part.is_true for part in parts if len(part)]
    known = [label for label in labels if label is not None]
    return np.concatenate(known) if known and len(known) == len(labels) else None


def robot_indices(maps: Sequence[PoseGraph], robots: Any, argument: str) -> np.ndarray:
    """int32 `[m]` from indices or names of robots.

    Raises:
        InputError: for a robot that is not there.
    """
    check_class("maps", maps, "PoseGraphs", list, tuple)
    for number, graph in enumerate(maps):
        if not hasattr(graph, "num_poses"):
            check_class(f"maps[{number}]", graph, "a PoseGraph")
    values = as_array(robots, argument)
    if values.ndim != 1:
        raise InputError(f"{argument}: shape {values.shape} given, expected [m]")
    if values.size and values.dtype.kind not in "UO":
        return validation.as_indices(values, len(maps), argument, "robots")
    known = {graph.name: index for index, graph in enumerate(maps)}
    names = [str(name) for name in values]
    missing = np.array([name not in known for name in names], bool)
    validation.raise_first(
        missing,
        argument_fault(argument),
        lambda row: f"there is no robot {names[row]!r}, expected one of {', '.join(known)}",
    )
    return np.array([known[name] for name in names], np.int32)


def pose_indices(
    maps: Sequence[PoseGraph], robots: np.ndarray, ids: Any, fault: validation.Fault
) -> np.ndarray:
    """int32 `[m]`: the index of the pose with each id in its robot's map.

    Raises:
        InputError: through `fault`, for an id that is not there.
    """
    wanted = as_array(ids, "ids")
    if wanted.shape != robots.shape or (wanted.size and wanted.dtype.kind not in "iu"):
        raise fault(0, f"{wanted.dtype} {wanted.shape} given, expected integers {robots.shape}")
    if wanted.size and wanted.dtype.kind == "u" and wanted.max() > np.iinfo(np.int64).max:
        row = int(np.argmax(wanted))
        raise fault(row, f"id {wanted[row]} given, expected integers below 2^63")
    poses, missing = np.zeros(len(robots), np.int32), np.zeros(len(robots), bool)
    for robot in np.unique(robots):
        rows = np.flatnonzero(robots == robot)
        known = maps[robot].ids
        poses[rows], missing[rows] = find(known, _as_keys(known, wanted[rows].astype(np.int64)))
    validation.raise_first(
        missing,
        fault,
        lambda row: f"robot {maps[robots[row]].name!r} has no pose with id {wanted[row]}",
    )
    return poses


def _as_keys(known: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The ids wanted, with indices made keys where a robot's ids are symbol keys."""
    if not (symbols.are_symbols(known) or symbols.are_labelled(known)):
        return wanted
    labelled = symbols.are_labelled(known)
    index = (wanted >= 0) & (wanted < (symbols.LABEL_LIMIT if labelled else symbols.INDEX_LIMIT))
    return np.where(index, symbols.with_indices(int(known[0]), wanted), wanted)


def find(known: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The place in `known` of each of `wanted`, and which of them are not there."""
    order = np.argsort(known)
    slot = np.minimum(np.searchsorted(known, wanted, sorter=order), len(known) - 1)
    found = order[slot]
    return found, known[found] != wanted


def _flatten(closures: LoopClosures) -> tuple[tuple[Any, ...], None]:
    return tuple(getattr(closures, field) for field in TRACED), None


def _flatten_with_keys(closures: LoopClosures) -> tuple[tuple[Any, ...], None]:
    keys = (jax.tree_util.GetAttrKey(field) for field in TRACED)
    return tuple(zip(keys, _flatten(closures)[0], strict=True)), None


jax.tree_util.register_pytree_with_keys(
    LoopClosures, _flatten_with_keys, lambda _, children: LoopClosures(*children), _flatten
)
