"""The maps that are measured on: public files, or simulated ones where those are absent."""

from __future__ import annotations

import warnings
from pathlib import Path

from benchmarks.suite.harness import NotMeasuredError, Settings
from pcm_jax import InputWarning, MultiRobotGraph, PoseGraph, read_graph
from pcm_jax.simulation import simulate_city, simulate_sessions

FILES = {
    "city10000": "city10000/city10000.g2o.xz",
    "M3500": "classic2d/manhattan.g2o.xz",
    "intel": "classic2d/intel.g2o.xz",
    "kitti_00": "kitti_robust/00/kitti_00_odom_GT_LC.g2o.xz",
    "sphere2500": "classic3d/sphere2500.g2o.xz",
    "torus3D": "classic3d/torus3D.g2o.xz",
    "parking-garage": "classic3d/parking-garage.g2o.xz",
    "cubicle": "classic3d/cubicle.g2o.xz",
}
SIMULATED = ("simulated-city", "simulated-campus")


def stand_ins_needed(settings: Settings) -> bool:
    """Says whether `SIMULATED` maps stand in for public ones: where City10000 is absent."""
    return not (settings.data / FILES["city10000"]).exists()


def required(relative: str, settings: Settings) -> Path:
    """A file or folder of the data; raises where it is absent."""
    path = settings.data / relative
    if not path.exists():
        raise NotMeasuredError(f"{relative} is not in the folder of public data (--data)")
    return path


def read_quietly(*paths: Path) -> MultiRobotGraph:
    """Files read with indefinite information clipped, which cubicle needs."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        return read_graph(*paths, repair="clip")


def read_map(name: str, settings: Settings) -> PoseGraph:
    """One of `FILES`, or of `SIMULATED`."""
    if name == "simulated-city":
        return _only(simulate_city(poses=10_000, robots=1, inliers=0).graph)
    if name == "simulated-campus":
        return _only(simulate_sessions(poses=2_500, sessions=1, inliers=0).graph)
    return _only(read_quietly(required(FILES[name], settings)))


def _only(graph: MultiRobotGraph) -> PoseGraph:
    (only,) = graph.maps
    return only
