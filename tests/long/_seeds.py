"""Small valid inputs of every format and every file that the package writes, to be mutated."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ._rtabmap_tables import INSERT_LINK, INSERT_NODE, blob, make_tables

KEYS = [ord("a") << 56, ord("b") << 56]
UNIT3, UNIT6 = "1 0 0 1 0 1", "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"


@dataclass(frozen=True)
class Seed:
    """A valid file: its name, its bytes, and what reads it."""

    name: str
    data: bytes
    reader: str = "graph"


def texts() -> list[Seed]:
    """The formats that are text."""
    a, b = KEYS
    steps = "".join(f"EDGE_SE2 {k} {k + 1} 1 0 0.5 {UNIT3}\n" for k in range(3))
    flat = "".join(f"VERTEX_SE2 {k} {k} 0 0.5\n" for k in range(4)) + steps
    solid = "".join(
        f"VERTEX_SE3:QUAT {key + k} {k} 0 0 0 0 0 1\n" for key in KEYS for k in range(2)
    ) + "".join(
        f"EDGE_SE3:QUAT {i} {k} 1 2 3 0 0 0.6 0.8 {UNIT6}\n"
        for i, k in ((a, a + 1), (b, b + 1), (a, b), (b + 1, a + 1))
    )
    pose = "0.6 0 0 0.8"
    return [
        Seed("flat.g2o", (flat + f"EDGE_SE2 0 3 2 1 0.1 {UNIT3}\n").encode()),
        Seed("solid.g2o", solid.encode()),
        Seed("named.g2o", f"# pcm_jax robot a index rover\n{solid}FIX {a}\n".encode()),
        Seed("prior.g2o", f"{flat}EDGE_PRIOR_SE2 1 1 0 0.5 {UNIT3}\n".encode()),
        Seed(
            "toro.graph",
            (
                b"VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0\nEDGE2 0 1 1 0 0.5 1 0 1 1 0 0\n"
                b"EDGE2 1 0 -1 0 -0.5 1 0 1 1 0 0\n"
            ),
        ),
        Seed(
            "toro3.graph",
            f"VERTEX3 0 0 0 0 0 0 0\nVERTEX3 1 1 2 3 0 0 0\nEDGE3 0 1 1 2 3 .1 .2 .3 {UNIT6}\n"
            "".encode(),
        ),
        Seed("isam.txt", f"ODOMETRY 0 1 1 0 0.5 {UNIT3}\nEDGE2 0 1 1 0 0.5 {UNIT3}\n".encode()),
        Seed("tum.txt", "".join(f"{k}.5 {k} 2 3 {pose}\n" for k in range(4)).encode(), "steps"),
        Seed(
            "kitti.txt", "".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(4)).encode(), "steps"
        ),
        Seed(
            "euroc.csv",
            (
                "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],"
                "q_RS_y [],q_RS_z []\n"
                + "".join(f"{10**18 + k},{k},2,3,0.8,0.6,0,0\n" for k in range(4))
            ).encode(),
            "steps",
        ),
        Seed(
            "poses.csv",
            b"timestamp,robot,x,y,theta\n0,a,0,0,0\n1,a,1,0,0.5\n2,a,2,0,0\n",
            "steps",
        ),
        Seed("table.csv", b"a,0,b,2,1,2,3,4,0,0,5,0,6\na,1,b,3,1,2,3,4,0,0,5,0,6\n", "closures"),
        Seed(
            "named.csv",
            b"robot_a,id_a,robot_b,id_b,x,y,theta,sigma_x,sigma_y,sigma_theta,weight\n"
            b"a,0,b,2,1,2,0.5,0.1,0.1,0.01,0.9\n",
            "closures",
        ),
        Seed("two.jrl", json.dumps(_jrl()).encode()),
        Seed("open3d.json", json.dumps(_open3d()).encode()),
    ]


def _pose3(x: float) -> dict:
    return {"type": "Pose3", "translation": [x, 0, 0], "rotation": [1, 0, 0, 0]}


def _jrl() -> dict:
    a, b = KEYS
    covariance = np.diag([0.01] * 3 + [1.0] * 3).ravel().tolist()

    def between(first: int, second: int, x: float) -> dict:
        ends = {"type": "BetweenFactorPose3", "key1": first, "key2": second}
        return {**ends, "measurement": _pose3(x), "covariance": covariance}

    prior = {"type": "PriorFactorPose3", "key": a, "prior": _pose3(0), "covariance": covariance}
    entries = [prior, between(a, a + 1, 1.0), between(a + 1, b, 5.0)]
    poses = {
        name: [{**_pose3(float(k)), "key": key + k} for k in range(2)]
        for name, key in zip("ab", KEYS, strict=True)
    }
    return {
        "name": "two",
        "robots": ["a", "b"],
        "measurements": {
            "a": [{"stamp": 10**18, "measurements": entries}],
            "b": [{"stamp": 10**18, "measurements": [between(b, b + 1, 2.0)]}],
        },
        "groundtruth": poses,
        "initialization": poses,
        "potential_outlier_factors": {"a": [[0, 2]], "b": []},
        "outlier_factors": {"a": [[0, 2]], "b": []},
    }


def _open3d() -> dict:
    matrix = [np.eye(4) for _ in range(4)]
    for k, pose in enumerate(matrix):
        pose[0, 3] = k
    nodes = [{"class_name": "PoseGraphNode", "pose": m.T.ravel().tolist()} for m in matrix]
    edges = [
        {
            "class_name": "PoseGraphEdge",
            "source_node_id": k,
            "target_node_id": k + 1,
            "transformation": np.linalg.inv(matrix[1]).T.ravel().tolist(),
            "information": np.eye(6).ravel().tolist(),
            "uncertain": k == 1,
            "confidence": 0.5,
        }
        for k in range(3)
    ]
    return {"class_name": "PoseGraph", "nodes": nodes, "edges": edges}


def binaries(folder: Path) -> list[Seed]:
    """The formats that are not: databases, bags, states; a report is text, but made by a merge."""
    found = [Seed("base.db", _rtabmap(folder / "base.db")), *_states(folder)]
    with contextlib.suppress(ImportError):
        found += _bags(folder)
    return found


def _rtabmap(path: Path) -> bytes:
    with contextlib.closing(sqlite3.connect(path)) as made, made:
        made.execute("PRAGMA page_size=512")
        make_tables(made)
        for node in range(1, 5):
            row = (node, int(node > 2), 1000.0 + node, blob(node), blob(2.0 * node))
            made.execute(INSERT_NODE, row)
        for first, second, kind in ((1, 2, 0), (3, 4, 0), (3, 1, 1), (4, 2, 1)):
            row = (first, second, kind, np.eye(6).tobytes(), blob(1.0))
            made.execute(INSERT_LINK, row)
    return path.read_bytes()


def _bags(folder: Path) -> Iterator[Seed]:
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from pcm_jax.files.formats.ros_bag import definitions

    package = "pose_graph_tools_msgs"
    for version, kind in ((1, Stores.ROS1_NOETIC), (2, Stores.ROS2_HUMBLE)):
        store = get_typestore(kind)
        for name, text in definitions(package).items():
            store.register(get_types_from_msg(text, name))
        graph = f"{package}/msg/PoseGraph"
        message = _message(store.types, package, [0] if version == 1 else [])
        path = folder / f"bag{version}"
        if version == 1:
            with Writer1(path) as bag:
                connection = bag.add_connection("/graph", graph, typestore=store)
                bag.write(connection, 1, store.serialize_ros1(message, graph))
            yield Seed("one.bag", path.read_bytes())
        else:
            with Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
                connection = bag.add_connection("/graph", graph, typestore=store)
                bag.write(connection, 1, store.serialize_cdr(message, graph))
            (file,) = path.glob("*.mcap")
            yield Seed("two.mcap", file.read_bytes())


def _message(types: Any, package: str, number: list[int]) -> Any:
    def header() -> Any:
        return types["std_msgs/msg/Header"](
            *number, types["builtin_interfaces/msg/Time"](1, 5), "w"
        )

    def pose(x: float) -> Any:
        point = types["geometry_msgs/msg/Point"](x, 0.0, 0.0)
        turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        return types["geometry_msgs/msg/Pose"](point, turn)

    node, edge = (types[f"{package}/msg/PoseGraph{part}"] for part in ("Node", "Edge"))
    nodes = [node(header(), robot, key, pose(key)) for robot in (0, 2) for key in range(3)]
    ends = [(r, k, r, k + 1, 0) for r in (0, 2) for k in range(2)] + [(0, 1, 2, 2, 1)]
    edges = [
        edge(header(), i, k, a, b, kind, pose(1.0), np.eye(6).ravel()) for a, i, b, k, kind in ends
    ]
    return types[f"{package}/msg/PoseGraph"](header(), nodes, edges)


def _states(folder: Path) -> list[Seed]:
    """A saved online state and a report, of two robots of four poses and three closures."""
    import pcm_jax as pcm
    from pcm_jax.cli import main

    write_team(folder)
    graph = pcm.read_graph(folder / "a.g2o", folder / "b.g2o", closures=folder / "c.csv")
    state = pcm.IncrementalPcm(graph)
    state.add(graph.closures)
    state.save(folder / "state.npz")
    command = ["merge", *(str(folder / name) for name in ("a.g2o", "b.g2o"))]
    command += ["--closures", str(folder / "c.csv"), "--minimum-inliers", "2"]
    with contextlib.redirect_stdout(None):
        main([*command, "--report", str(folder / "report.json")])
    return [
        Seed("state.npz", (folder / "state.npz").read_bytes(), "state"),
        Seed("report.json", (folder / "report.json").read_bytes(), "report"),
    ]


def write_team(folder: Path, poses: int = 4, closures: int = 3) -> list[str]:
    """Two robots side by side, and closures between them; gives the options that name them."""
    for number, name in enumerate("ab"):
        lines = [f"VERTEX_SE2 {k} {k} {number} 0" for k in range(poses)]
        lines += [f"EDGE_SE2 {k} {k + 1} 1 0 0 100 0 0 100 0 1000" for k in range(poses - 1)]
        ends = [(0, poses - 1), *((k, k + 2) for k in range(0, poses - 2, 3))]
        lines += [f"EDGE_SE2 {i} {k} {k - i} 0 0 90 0 0 90 0 900" for i, k in ends]
        (folder / f"{name}.g2o").write_text("\n".join(lines) + "\n")
    every = max(1, poses // closures)
    rows = [f"a,{k},b,{k},0,1,0,100,0,0,100,0,1000" for k in range(0, poses, every)]
    (folder / "c.csv").write_text("\n".join(rows) + "\n")
    return [*(str(folder / f"{name}.g2o") for name in "ab"), "--closures", str(folder / "c.csv")]


Reader = Callable[[Path], Any]
