"""Graphs of different sizes filled up to one, so that they can be stacked and mapped over."""

from __future__ import annotations

from typing import Any

import numpy as np

from pcm_jax import lie
from pcm_jax.errors import InputError, check_class, check_number
from pcm_jax.graph.loop_closures import LoopClosures
from pcm_jax.graph.multi_robot import MultiRobotGraph
from pcm_jax.graph.pose_graph import PoseGraph


def pad_graph(graph: MultiRobotGraph, *, poses: int, edges: int, closures: int) -> MultiRobotGraph:
    """Fills every map and the closures up with what `merge_differentiable` takes for nothing.

    For stacking worlds of different sizes, which `jax.vmap` then maps over:

        sizes = dict(poses=200, edges=260, closures=64)
        stack = jax.tree.map(lambda *x: jnp.stack(x), *(pad_graph(w, **sizes) for w in worlds))

    Added poses repeat the map's last one. Added edges and closures join the first pose to itself,
    with no information. Ids, sources and names are lost.

    Args:
        graph: maps of n poses and e edges, m closures.
        poses: of each map, at least n.
        edges: of each map, at least e.
        closures: at least m.

    Raises:
        InputError: for more poses, edges or closures than there shall be, and for a map with
            priors, which the padded arrays do not hold.
    """
    check_class("graph", graph, "a MultiRobotGraph", MultiRobotGraph)
    for name, size in (("poses", poses), ("edges", edges), ("closures", closures)):
        check_number(name, size, least=0, most=np.iinfo(np.int32).max, integer=True)
    for robot, one in enumerate(graph.maps):
        if one.priors is not None:
            raise InputError(
                f"priors: robot {robot} has {len(one.priors)}, which padded maps do not hold;"
                " expected none (PoseGraph.without_priors)"
            )
        _require(one.num_poses, poses, f"poses: robot {robot}")
        _require(one.num_edges, edges, f"edges: robot {robot}")
    _require(len(graph.closures), closures, "closures: the graph")
    maps = tuple(_padded_map(one, poses, edges) for one in graph.maps)
    own = graph.closures
    robot_a, pose_a, robot_b, pose_b = (
        _padded_indices(each, closures)
        for each in (own.robot_a, own.pose_a, own.robot_b, own.pose_b)
    )
    measurement, information = _measured(own, closures)
    weight = np.pad(np.asarray(own.weight), (0, closures - len(own)))
    return MultiRobotGraph(
        maps, LoopClosures(robot_a, pose_a, robot_b, pose_b, measurement, information, weight)
    )


def _padded_map(own: PoseGraph, poses: int, edges: int) -> PoseGraph:
    measurement, information = _measured(own, edges)
    return PoseGraph(
        lie.pad_leading(lie.as_numpy(own.poses), poses),
        _padded_indices(own.tail, edges),
        _padded_indices(own.head, edges),
        measurement,
        information,
    )


def _require(count: int, most: int, what: str) -> None:
    if count > most:
        raise InputError(f"{what} has {count}, expected at most the {most} given")


def _padded_indices(values: Any, size: int) -> Any:
    """int32 `[size]`, zeros at the end."""
    return np.pad(np.asarray(values, np.int32), (0, size - len(values)))


def _measured(edges: PoseGraph | LoopClosures, size: int) -> tuple[Any, Any]:
    """Measurement and information `[size]`, identities without information at the end."""
    group, missing = lie.group_of(edges.measurement), size - len(edges.information)
    none = lie.identity(group, (missing,))
    measurement = lie.concatenate([lie.as_numpy(edges.measurement), none])
    information = np.pad(np.asarray(edges.information), ((0, missing), (0, 0), (0, 0)))
    return measurement, information
