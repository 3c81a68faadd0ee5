"""Several robots' maps and the loop closures between them."""

from __future__ import annotations

import dataclasses
import itertools
import string
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from pcm_jax.errors import InputError, check_class
from pcm_jax.graph.loop_closures import LoopClosures
from pcm_jax.graph.pose_graph import PoseGraph
from pcm_jax.graph.validation import argument_fault, raise_first


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class MultiRobotGraph:
    """Maps, each in its own frame, and the measurements that may join them.

    A pytree of the maps and the closures. Robots without a name are called a, b, c, … in order;
    a name that is taken gets a number: "car", "car-2".

    Attributes:
        maps: one `PoseGraph` per robot.
        closures: their `LoopClosures`; None stands for none.
        truth: each robot's true poses, NumPy-backed Lie `[n]` of one frame, None for a robot whose
            are not known; None for all. Outside the traced part.

    Raises:
        InputError: for no map, maps or closures of different groups, and a closure to a robot or a
            pose that is not there; of traced closures only the group is looked at.
    """

    maps: tuple[PoseGraph, ...]
    closures: LoopClosures = None  # type: ignore[assignment]
    truth: tuple[Any, ...] | None = None

    def __post_init__(self) -> None:
        check_class("maps", self.maps, "PoseGraphs", tuple, list)
        maps = tuple(self.maps)
        for number, graph in enumerate(maps):
            check_class(f"maps[{number}]", graph, "a PoseGraph", PoseGraph)
        if self.closures is not None:
            check_class("closures", self.closures, "LoopClosures", LoopClosures)
        if not maps:
            raise InputError("maps: none given, expected at least one")
        groups = [graph.group.__name__ for graph in maps]
        if len(set(groups)) > 1:
            raise InputError(f"maps: groups {', '.join(groups)} given, expected one for all")
        named = zip(maps, unique_names([graph.name for graph in maps]), strict=True)
        renamed = (
            graph if graph.name == name else dataclasses.replace(graph, name=name)
            for graph, name in named
        )
        object.__setattr__(self, "maps", tuple(renamed))
        if self.closures is None:
            object.__setattr__(self, "closures", LoopClosures.empty(maps[0].group))
        check_closures(self.maps, self.closures)

    def __repr__(self) -> str:
        return f"MultiRobotGraph({', '.join(map(repr, self.maps))}, {self.closures!r})"

    @property
    def group(self) -> type[Any]:
        """`jaxlie.SE2` or `jaxlie.SE3`."""
        return self.maps[0].group

    @property
    def tangent_dim(self) -> int:
        """d: 3 for SE(2), 6 for SE(3)."""
        return self.maps[0].tangent_dim

    @property
    def names(self) -> tuple[str, ...]:
        """The robots' names."""
        return tuple(graph.name for graph in self.maps)


def check_closures(maps: Sequence[PoseGraph], closures: LoopClosures) -> None:
    """Raises `InputError` unless every closure joins poses that `maps` have."""
    if closures.group is not maps[0].group:
        raise InputError(
            f"closures: {closures.group.__name__} given,"
            f" expected {maps[0].group.__name__} like the maps"
        )
    sizes = np.array([graph.num_poses for graph in maps])
    ends = (closures.robot_a, closures.pose_a, closures.robot_b, closures.pose_b)
    if any(isinstance(index, Tracer) for index in ends):
        return
    for end in "ab":
        robot = np.asarray(getattr(closures, f"robot_{end}"))
        pose = np.asarray(getattr(closures, f"pose_{end}"))
        raise_first(
            (robot < 0) | (robot >= len(maps)),
            argument_fault(f"closures.robot_{end}"),
            lambda row, robot=robot: f"robot {robot[row]} of {len(maps)} does not exist",
        )
        raise_first(
            (pose < 0) | (pose >= sizes[robot]),
            argument_fault(f"closures.pose_{end}"),
            lambda row, robot=robot, pose=pose: (
                f"pose {pose[row]} does not exist: robot {maps[robot[row]].name!r} has"
                f" {sizes[robot[row]]} poses"
            ),
        )


def letter_names() -> Iterator[str]:
    """The names a, b, …, z, aa, ab, and so on."""
    for length in itertools.count(1):
        for letters in itertools.product(string.ascii_lowercase, repeat=length):
            yield "".join(letters)


def unique_names(names: Iterable[str]) -> list[str]:
    """The same names, empty ones replaced by free letters, repeated ones numbered."""
    names = list(names)
    taken = set(names)
    free = (letter for letter in letter_names() if letter not in taken)
    unique: list[str] = []
    for name in names:
        chosen = name or next(free)
        if chosen in unique:
            numbered = (f"{name}-{k}" for k in itertools.count(2))
            chosen = next(n for n in numbered if n not in taken and n not in unique)
        unique.append(chosen)
    return unique


def _unflatten(_: None, children: Any) -> MultiRobotGraph:
    graph = object.__new__(MultiRobotGraph)  # leaves may be tracers: nothing to check
    object.__setattr__(graph, "maps", children[0])
    object.__setattr__(graph, "closures", children[1])
    object.__setattr__(graph, "truth", None)
    return graph


jax.tree_util.register_pytree_with_keys(
    MultiRobotGraph,
    lambda graph: (
        (
            (jax.tree_util.GetAttrKey("maps"), graph.maps),
            (jax.tree_util.GetAttrKey("closures"), graph.closures),
        ),
        None,
    ),
    _unflatten,
    lambda graph: ((graph.maps, graph.closures), None),
)
