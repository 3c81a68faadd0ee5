"""ROS 1 and ROS 2 bags with `pose_graph_tools_msgs/PoseGraph` messages, as Kimera-Multi records.

Nodes and odometry edges of all messages make the maps, later messages prevailing; loop closures
between robots are candidates. Covariances are row by row, rotation first, as the programs that
publish them fill them from GTSAM. Bags are read by the package rosbags (`pip install rosbags`).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jaxlie
import numpy as np

from pcm_jax.errors import FileFormatError
from pcm_jax.files._scope import Scope, made_scope
from pcm_jax.files.coordinates import inverted, parameters
from pcm_jax.files.formats._registry import Format, register
from pcm_jax.files.pose_file import Lines, PoseFile, Reading, checked, no_lines
from pcm_jax.files.source import Source
from pcm_jax.files.text import line_fault
from pcm_jax.graph import symbols
from pcm_jax.graph.validation import check_information

MAGICS = (b"#ROSBAG V2.0", b"\x89MCAP")
PACKAGES = ("pose_graph_tools_msgs", "pose_graph_tools")
ODOMETRY, CLOSURE = 0, 1
KINDS = {2: "landmark", 3: "rejected closure", 4: "mesh", 5: "mesh of a pose", 6: "pose of a mesh"}
MOST = 1_000_000  # messages
_NUMBER_BITS, _ROBOT_BITS = 62, 40  # ids of several robots' poses side by side
_ORDER = np.array([3, 4, 5, 0, 1, 2])  # of our directions in GTSAM's

# The fields of the messages, for bags that do not carry their definitions.
_EDGE = """std_msgs/Header header
uint64 key_from
uint64 key_to
int32 robot_from
int32 robot_to
int32 type
geometry_msgs/Pose pose
float64[36] covariance
"""
_NODE = """std_msgs/Header header
int32 robot_id
uint64 key
geometry_msgs/Pose pose
"""


def _recognise(source: Source) -> float:
    if source.is_folder:
        return 1.0 * (Path(source.path) / "metadata.yaml").is_file()
    return 1.0 * source.magic.startswith(MAGICS)


def definitions(package: str) -> dict[str, str]:
    """The messages' definitions by their type's name."""
    lists = "".join(f"{package}/PoseGraph{what}[] {what.lower()}s\n" for what in ("Node", "Edge"))
    return {
        f"{package}/msg/PoseGraphEdge": _EDGE,
        f"{package}/msg/PoseGraphNode": _NODE,
        f"{package}/msg/PoseGraph": f"std_msgs/Header header\n{lists}",
    }


def read_bag(source: Source, reading: Reading) -> PoseFile:
    """Reads all pose graphs in a bag.

    Raises:
        FileFormatError: without rosbags, for a damaged bag, one without such messages, and naming
            the edge that holds something else.
    """
    nodes: dict[int, Any] = {}
    edges: dict[tuple[Any, ...], Any] = {}
    left_out: dict[str, int] = {}
    for message in _messages(source):
        for node in message.nodes:
            nodes[_id(source.path, node.robot_id, node.key)] = node
        for edge in message.edges:
            kind = int(edge.type)
            if kind not in (ODOMETRY, CLOSURE):
                name = KINDS.get(kind, f"edge of type {kind}")
                left_out[name] = left_out.get(name, 0) + 1
                continue
            ends = (edge.robot_from, edge.key_from, edge.robot_to, edge.key_to)
            place = edge.pose.position if kind == CLOSURE else None
            which = None if place is None else (place.x, place.y, place.z)
            edges[*map(int, ends), kind, which] = edge
    if not edges:
        raise FileFormatError(source.path, None, "no edges, expected a pose graph")
    chosen = list(edges.values())
    lines = _edges(source.path, chosen, reading)
    measured, clipped = checked(source.path, lines, reading.repair)
    ids = np.array(list(nodes), np.int64)
    return PoseFile(
        source.path,
        jaxlie.SE3,
        _vertices(source.path, ids, list(nodes.values())),
        measured,
        clipped=clipped,
        format="rosbag",
        scope=_scope(np.unique(np.concatenate([ids, measured.ids.ravel()]))),
        left_out=left_out,
        stamps=(ids, np.array([_seconds(node.header.stamp) for node in nodes.values()])),
        how="covariances, rotation first",
    )


def _messages(source: Source) -> Iterator[Any]:
    try:
        from rosbags.highlevel import (  # pyright: ignore[reportMissingImports]
            AnyReader,
        )
        from rosbags.typesys import (  # pyright: ignore[reportMissingImports]
            Stores,
            get_types_from_msg,
            get_typestore,
        )
    except ImportError:
        raise FileFormatError(
            source.path, None, "a ROS bag, for which rosbags is needed: pip install rosbags"
        ) from None
    store = get_typestore(Stores.ROS2_HUMBLE)
    for package in PACKAGES:
        for name, text in definitions(package).items():
            store.register(get_types_from_msg(text, name))
    count = 0
    try:
        with AnyReader([Path(source.path)], default_typestore=store) as bag:
            own = [c for c in bag.connections if c.msgtype.endswith("/PoseGraph")]
            for connection, _, raw in bag.messages(connections=own) if own else ():
                count += 1
                if count > MOST:
                    raise FileFormatError(source.path, None, f"more than {MOST} pose graphs")
                message = bag.deserialize(raw, connection.msgtype)
                check_fields(source.path, connection.msgtype, message)
                yield message
    except FileFormatError:
        raise
    except Exception as error:  # whatever rosbags finds wrong with a bag
        told = " ".join(str(error).split())[:120]
        raise FileFormatError(source.path, None, f"cannot be read as a bag: {told}") from None
    if not count:
        raise FileFormatError(
            source.path, None, "no messages of pose_graph_tools_msgs/PoseGraph, expected some"
        )


def check_fields(path: str, kind: str, message: Any) -> None:
    """Raises `FileFormatError` for another package's message of that name (LAMP has one)."""
    for what, names in (
        ("nodes", ("robot_id", "key", "pose")),
        ("edges", ("robot_from", "key_from", "robot_to", "key_to", "type", "pose", "covariance")),
    ):
        members = getattr(message, what, None)
        lost = [name for name in names if members and not hasattr(members[0], name)]
        if members is None or lost:
            raise FileFormatError(
                path,
                None,
                f"{kind} without {what if members is None else lost[0]}, expected messages of"
                f" {PACKAGES[0]}/PoseGraph",
            )


def _id(path: str, robot: Any, key: Any) -> int:
    """One number of a robot's pose, whose key is a symbol or the pose's number itself."""
    index = int(symbols.indices_of(np.array([key], np.uint64).astype(np.int64))[0])
    if not 0 <= robot < 1 << _NUMBER_BITS - _ROBOT_BITS:
        expected = f"expected 0 … {(1 << _NUMBER_BITS - _ROBOT_BITS) - 1}"
        raise FileFormatError(path, None, f"robot {robot} given, {expected}")
    if not 0 <= index < 1 << _ROBOT_BITS:
        expected = f"expected a symbol, or 0 … {(1 << _ROBOT_BITS) - 1}"
        raise FileFormatError(path, None, f"key {key} given, {expected}")
    return (int(robot) << _ROBOT_BITS) + index


def _seconds(stamp: Any) -> float:
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def _scope(ids: np.ndarray) -> Scope:
    robots = np.unique(ids >> _ROBOT_BITS)
    names = [f"robot{number}" for number in robots.tolist()]
    return made_scope(
        names,
        names,
        kind="table",
        rule=f"the messages' robots ({', '.join(map(str, robots.tolist()))})",
        codes=ids,
        robots=np.searchsorted(robots, ids >> _ROBOT_BITS),
        ids=ids & ((1 << _ROBOT_BITS) - 1),
    )


def _transforms(path: str, members: list[Any]) -> np.ndarray:
    rows = [
        (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
        for p, q in ((one.pose.position, one.pose.orientation) for one in members)
    ]
    fault = line_fault(path, np.arange(len(members)))
    return parameters("quaternion", np.array(rows, np.float64).reshape(-1, 7), fault)


def _vertices(path: str, ids: np.ndarray, nodes: list[Any]) -> Lines:
    if not nodes:
        return no_lines(jaxlie.SE3, 1)
    line = np.arange(len(ids))
    return Lines(ids[:, None], _transforms(path, nodes), np.zeros((len(ids), 6, 6)), line)


def _edges(path: str, edges: list[Any], reading: Reading) -> Lines:
    ends = np.array(
        [
            [_id(path, one.robot_from, one.key_from), _id(path, one.robot_to, one.key_to)]
            for one in edges
        ],
        np.int64,
    )
    line = np.arange(len(edges))
    fault = line_fault(path, line)
    covariance = np.array([one.covariance for one in edges], np.float64).reshape(-1, 6, 6)
    covariance = covariance[:, _ORDER[:, None], _ORDER]
    none = (covariance == 0.0).all(axis=(1, 2))
    if none.any():
        default = reading.default_information(jaxlie.SE3)
        if default is None:
            raise fault(
                int(np.argmax(none)),
                "an edge without a covariance; give default_sigmas=(metres, radians)"
                " (--default-sigmas M RAD)",
            )
        covariance[none] = np.linalg.inv(default)
    information = inverted(check_information(covariance, fault, "covariance"))
    return Lines(ends, _transforms(path, edges), information, line)


ROSBAG = register(
    Format(
        name="rosbag",
        about="ROS bags of pose_graph_tools_msgs/PoseGraph",
        recognise=_recognise,
        read=read_bag,
        information="kept (covariances)",
        stamps="kept",
        binary=True,
    )
)
