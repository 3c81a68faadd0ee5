"""Pose graphs by mrob (C++), in a process and, where need be, by an interpreter of its own.

    PYTHON mrob_peer.py GRAPH.npz POSES.npy [ROUNDS]

GRAPH.npz holds the arrays of `benchmarks.suite.gtsam_peer.PlainGraph`; POSES.npy gets the poses as
matrices `[n, k + 1, k + 1]`; printed is a JSON list of seconds. Imports NumPy and mrob alone: the
wheel of mrob 0.0.17 was built for NumPy 1, with NumPy 2 its poses in space end the process.

Residuals are mrob's own: in the plane differences of coordinates (ours are logarithms), in space
logarithms in another frame. Gauss-Newton until chi-squared falls by less than 1e-9 of itself, or
rises.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from typing import Any

import numpy as np

mrob: Any = importlib.import_module("mrob")

TOLERANCE = 1e-9
MOST_STEPS = 100


def main() -> None:
    source, target, *rounds = sys.argv[1:]
    with np.load(source) as file:
        graph = {name: file[name] for name in file.files}
    seconds = []
    for _ in range(int(rounds[0]) if rounds else 3):
        problem = built(graph)
        start = time.perf_counter()
        solve(problem)
        seconds.append(time.perf_counter() - start)
        np.save(target, poses_of(problem, graph["poses"].shape))
    print(json.dumps(seconds))


def built(graph: dict[str, np.ndarray]) -> Any:
    """The factor graph; its first pose is held."""
    problem: Any = mrob.FGraph()
    planar = graph["poses"].shape[-1] == 3
    make = coordinates if planar else mrob.SE3
    add_pose = problem.add_node_pose_2d if planar else problem.add_node_pose_3d
    add_edge = problem.add_factor_2poses_2d if planar else problem.add_factor_2poses_3d
    for index, matrix in enumerate(graph["poses"]):
        add_pose(make(matrix), *(() if index else (mrob.NODE_ANCHOR,)))
    order = np.arange(3) if planar else np.array([3, 4, 5, 0, 1, 2])  # rotation first
    information = graph["information"][:, order[:, None], order]
    ends = graph["tail"].tolist(), graph["head"].tolist()
    for tail, head, matrix, weight in zip(*ends, graph["measurement"], information, strict=True):
        add_edge(make(matrix), tail, head, weight)
    return problem


def solve(problem: Any) -> None:
    """Steps of Gauss-Newton until they change nothing."""
    before = problem.chi2()
    for _ in range(MOST_STEPS):
        problem.solve(mrob.GN)
        after = problem.chi2()
        if before - after <= TOLERANCE * before:
            return
        before = after


def coordinates(matrix: np.ndarray) -> np.ndarray:
    """(x, y, θ) of a homogeneous matrix."""
    return np.array([matrix[0, 2], matrix[1, 2], np.arctan2(matrix[1, 0], matrix[0, 0])])


def poses_of(problem: Any, shape: tuple[int, ...]) -> np.ndarray:
    """The poses found, as matrices."""
    found = np.asarray(problem.get_estimated_state())
    if shape[-1] == 4:
        return found.reshape(shape)
    x, y, angle = found.reshape(-1, 3).T
    poses = np.tile(np.eye(3), (len(x), 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(angle)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(angle), -np.sin(angle)
    poses[:, 0, 2], poses[:, 1, 2] = x, y
    return poses


if __name__ == "__main__":
    main()
