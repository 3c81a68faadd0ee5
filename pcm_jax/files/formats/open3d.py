"""Open3D's pose graphs as JSON.

`nodes` are poses, `edges` transforms from a source's to a target's points: T_target⁻¹ T_source, the
pose of the source seen from the target. Matrices stand column by column; information is over
(rotation, translation). Edges that are `uncertain` are the candidates: where the certain ones
leave the graph in parts, each part is a robot.
"""

from __future__ import annotations

import dataclasses
import json
from os import PathLike
from typing import Any

import jaxlie
import numpy as np

from pcm_jax import lie
from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files._components import by_components
from pcm_jax.files._json import Member, begins_object, load
from pcm_jax.files._scope import made_scope
from pcm_jax.files.formats._registry import Format, register
from pcm_jax.files.names import stem_of
from pcm_jax.files.output import write_text
from pcm_jax.files.pose_file import Lines, PoseFile, Reading, checked
from pcm_jax.files.source import Source
from pcm_jax.files.text import line_fault
from pcm_jax.graph.checked import as_transforms
from pcm_jax.graph.multi_robot import MultiRobotGraph

_ORDER = np.array([3, 4, 5, 0, 1, 2])  # of our directions in theirs; its own inverse


def _recognise(source: Source) -> float:
    return 0.9 * (
        begins_object(source) and '"nodes"' in source.text and '"source_node_id"' in source.text
    )


def read_open3d(source: Source, reading: Reading) -> PoseFile:
    """Reads nodes and edges.

    Raises:
        FileFormatError: naming the place in the file, what is wrong and what was expected.
    """
    whole = load(source)
    nodes = [node.at("pose") for node in whole.at("nodes").list()]
    edges = whole.at("edges").list()
    if not nodes or not edges:
        raise FileFormatError(source.path, None, "no nodes or no edges, expected a pose graph")
    place = np.arange(len(nodes))
    poses = Lines(
        place[:, None], _transforms(nodes, source.path), np.zeros((len(nodes), 6, 6)), place
    )
    ends = np.array(
        [[e.at("target_node_id").integer(), e.at("source_node_id").integer()] for e in edges],
        np.int64,
    )
    for edge, pair in zip(edges, ends.tolist(), strict=True):
        if not all(0 <= one < len(nodes) for one in pair):
            raise edge.fault(f"nodes {pair} given, expected 0 … {len(nodes) - 1}")
    information = np.array([e.at("information").numbers(36) for e in edges]).reshape(-1, 6, 6)
    lines = Lines(
        ends,
        _transforms([edge.at("transformation") for edge in edges], source.path),
        np.ascontiguousarray(information[:, _ORDER[:, None], _ORDER]),
        np.arange(len(edges)),
        weight=np.array([e.at("confidence").number() if e.has("confidence") else 1 for e in edges]),
    )
    uncertain = np.array([bool(e.at("uncertain").value) for e in edges])
    empty = uncertain & (information == 0.0).all(axis=(1, 2))  # of clouds that do not overlap
    lines, uncertain = lines[~empty], uncertain[~empty]
    measured, clipped = checked(source.path, lines, reading.repair)
    file = PoseFile(
        source.path,
        jaxlie.SE3,
        poses,
        measured,
        clipped=clipped,
        format="open3d",
        how="as written, rotation first",
        left_out={"edge without information": int(empty.sum())} if empty.any() else {},
    )
    scope = made_scope(["file"], [stem_of(source.path)], kind="one", rule="the file's own")
    certain = dataclasses.replace(file, edges=measured[np.flatnonzero(~uncertain)])
    parts = by_components(certain, scope, only_apart=True)
    return file if parts is scope else dataclasses.replace(file, scope=parts)


def _transforms(members: list[Member], path: str) -> np.ndarray:
    rows = np.array([member.numbers(16) for member in members]).reshape(-1, 4, 4)
    matrices = np.swapaxes(rows, 1, 2)  # column by column
    fault = line_fault(path, np.arange(len(members)))
    return np.asarray(lie.parameters(as_transforms(matrices, "pose", fault)))


def write_open3d(path: str | PathLike[str], graph: MultiRobotGraph) -> None:
    """Writes maps and closures as one Open3D pose graph, nodes numbered robot by robot.

    Closures are uncertain edges, and so are a map's own loops. Names, ids and times are lost.

    Args:
        path: the file.
        graph: SE(3).

    Raises:
        FileFormatError: for a folder that does not exist or cannot be written to.
        InputError: for another group.
    """
    if graph.group is not jaxlie.SE3:
        raise InputError(f"graph: {graph.group.__name__} given, expected SE3")
    start = np.cumsum([0, *(one.num_poses for one in graph.maps)])
    nodes = [
        {"class_name": "PoseGraphNode", **_version(), "pose": row}
        for one in graph.maps
        for row in _columns(one.poses)
    ]
    edges = []
    for first, one in zip(start, graph.maps, strict=False):
        far = np.abs(np.asarray(one.tail) - np.asarray(one.head)) != 1
        edges += _edges(first + np.asarray(one.tail), first + np.asarray(one.head), one, far)
    closures = graph.closures
    tail = start[np.asarray(closures.robot_a)] + np.asarray(closures.pose_a)
    head = start[np.asarray(closures.robot_b)] + np.asarray(closures.pose_b)
    edges += _edges(tail, head, closures, np.ones(len(closures), bool))
    whole = {"class_name": "PoseGraph", **_version(), "nodes": nodes, "edges": edges}
    write_text(path, json.dumps(whole))


def _version() -> dict[str, int]:
    return {"version_major": 1, "version_minor": 0}


def _columns(transforms: Any) -> list[list[float]]:
    matrices = np.asarray(lie.as_matrix(lie.as_numpy(transforms)))
    return np.swapaxes(matrices, 1, 2).reshape(len(matrices), 16).tolist()


def _edges(tail: np.ndarray, head: np.ndarray, measured: Any, far: np.ndarray) -> list[Any]:
    information = np.asarray(measured.information)[:, _ORDER[:, None], _ORDER]
    weight = getattr(measured, "weight", np.ones(len(tail)))
    return [
        {
            "class_name": "PoseGraphEdge",
            **_version(),
            "source_node_id": int(source),
            "target_node_id": int(target),
            "transformation": transform,
            "information": rows,
            "uncertain": bool(uncertain),
            "confidence": float(confidence),
        }
        for source, target, transform, rows, uncertain, confidence in zip(
            head,
            tail,
            _columns(measured.measurement),
            information.reshape(len(tail), 36).tolist(),
            far,
            weight,
            strict=True,
        )
    ]


OPEN3D = register(
    Format(
        name="open3d",
        about="Open3D's pose graph, uncertain edges as candidates",
        recognise=_recognise,
        read=read_open3d,
        write=write_open3d,
        suffixes=(".json",),
        information="kept",
    )
)
