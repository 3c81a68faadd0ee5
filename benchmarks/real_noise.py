"""Real noise: what `calibrate` says of real files, and what the truth says of the same edges.

    python -m benchmarks.real_noise --out DIR [--data DIR] [--only city kitti bicocca argos]

city      City10000, whole as one map, and its first 2,000 poses cut in halves. Its file states the
          square roots 50 and 100 as information: these are the factors to be found. Beside them
          `realised`: what the errors of these very edges against the noise-free ones come to.
kitti     KITTI 00 and Bicocca 25b with the candidates of real front ends (`pcm_jax.experiments.
bicocca   drives`), of which `calibrate` has to find the right ones. `labelled`: the same with the
          right candidates alone. `by_loops`: information by the medians of the report, from loops
          of accepted candidates with odometry, and of two near each other.
          `against_truth`: odometry over so many poses (overlapping by half), its squared errors
          against the truth over what independent steps add up to, the lever arm between the two
          taken out: 1 where steps are as stated and independent, at every length.
argos     two robots of `multirobot_rdm` without loops of their own, of whose 34 right closures a
          gate of 99 % keeps 4: how many a merge keeps as stated, and calibrated.

Writes summary.json; what is not there is left out. Takes about three minutes.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.experiments import real_candidates as real
from benchmarks.suite.harness import DATA
from pcm_jax import MultiRobotGraph, PoseGraph, calibrate, lie, merge, read_graph, select_within
from pcm_jax.experiments import cities, drives
from pcm_jax.integrity import Calibration
from pcm_jax.integrity.calibration import closing_edges

LENGTHS = (1, 10, 100, 1_000, 2_000)
"""Poses."""
FILES = {"kitti": "kitti_00_alpha_0.00", "bicocca": "B25b_0.000"}
ARGOS = "multirobot_rdm/argos_simulation/clean/example_2robots"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="benchmarks.real_noise", description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA, metavar="DIR")
    parser.add_argument("--only", nargs="+", choices=STUDIES, default=list(STUDIES))
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    written = options.out / "summary.json"
    summary = json.loads(written.read_text()) if written.is_file() else {}
    for name in options.only:
        start = time.perf_counter()
        summary |= STUDIES[name](options.data)
        written.write_text(json.dumps(summary, indent=2) + "\n")
        print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
    print(written.read_text())
    return 0


def city(data: Path) -> dict[str, Any]:
    """City10000, whole and in part."""
    folder = data / "city10000"
    path = folder / "city10000.g2o.xz"
    if not path.is_file():
        return {}
    (whole,) = read_graph(path).maps
    (exact,) = read_graph(folder / "city10000_groundtruth.isam.txt.xz").maps
    truth = lie.as_numpy(exact.poses)
    halves = cities.city10000(folder).graph
    first = (np.asarray(whole.tail) < 2_000) & (np.asarray(whole.head) < 2_000)
    return {
        "city10000": told(calibrate(whole)) | {"realised": realised(whole, truth)},
        "city10000, 2,000 poses in halves": told(calibrate(halves))
        | {"realised": realised(whole.with_edges(first), truth)},
    }


def candidates(name: str, data: Path) -> dict[str, Any]:
    """A drive with real candidates."""
    if FILES[name] not in drives.found(data):
        return {}
    drive = drives.load(data, FILES[name])
    selection = select_within(drive.graph)
    medians = real.factors_of_data(selection, drive.graph)
    labelled = drive.graph.with_edges(drives.steps(drive.graph) | drive.is_true)
    found = told(calibrate(drive.graph))
    found["labelled"] = told(calibrate(labelled))
    found["by_loops"] = {key: 1.0 / value for key, value in medians._asdict().items()}
    found["against_truth"] = {str(poses): along(drive, poses) for poses in LENGTHS}
    return {FILES[name]: found}


def argos(data: Path) -> dict[str, Any]:
    """Two robots whose closures contradict each other as stated."""
    files = sorted((data / ARGOS).glob("*.g2o*"))
    if not files:
        return {}
    graph = read_graph(*files)
    found = calibrate(graph)
    kept = (int(merge(one).accepted.sum()) for one in (graph, found.apply(graph)))
    counts = dict(zip(("accepted_as_stated", "accepted_calibrated"), kept, strict=True))
    return {ARGOS: told(found) | counts | {"of": len(graph.closures)}}


STUDIES: dict[str, Callable[[Path], dict[str, Any]]] = {
    "city": city,
    "kitti": lambda data: candidates("kitti", data),
    "bicocca": lambda data: candidates("bicocca", data),
    "argos": argos,
}


def told(found: Calibration) -> dict[str, Any]:
    """A calibration without its quantiles, which are long."""
    plain = found.as_dict()
    del plain["quantiles"]
    return plain | {
        "left_out": found.left_out,
        "redundancy": found.components.redundancy.tolist(),
        "tails": found.components.tails.tolist(),
    }


def realised(graph: PoseGraph | MultiRobotGraph, truth: Any) -> dict[str, dict[str, float]]:
    """The factors on information that make errors against the truth as large as it says."""
    assert isinstance(graph, PoseGraph)
    error, closing = drives.errors(graph, truth), closing_edges(graph)
    information = np.diagonal(np.asarray(graph.information), axis1=1, axis2=2)
    squared = error**2 * information
    return {
        kind: {
            "translation": float(1.0 / squared[rows, :2].mean()),
            "rotation": float(1.0 / squared[rows, 2].mean()),
        }
        for kind, rows in (("odometry", ~closing), ("closures", closing))
    }


def along(drive: drives.Candidates, poses: int) -> dict[str, float]:
    """Odometry's squared errors over so many poses, by what independent steps add up to."""
    graph = drive.graph
    odometry = graph.with_edges(np.flatnonzero(drives.steps(graph)))
    chain, truth = drives.chained(graph), real.without_lever_arm(drive)
    at = np.asarray(lie.adjoint(lie.take(chain, np.asarray(odometry.head))))
    added = at @ np.linalg.inv(np.asarray(odometry.information)) @ at.swapaxes(1, 2)
    total = np.zeros((graph.num_poses, 3, 3))
    total[np.asarray(odometry.head)] = added
    total = np.cumsum(total, axis=0)
    start = np.arange(0, graph.num_poses - poses, max(1, poses // 2))
    ends = (lie.take(each, rows) for each in (chain, truth) for rows in (start, start + poses))
    first, last, true_first, true_last = ends
    error = np.asarray(
        lie.log(lie.between(lie.between(first, last), lie.between(true_first, true_last)))
    )
    back = np.asarray(lie.adjoint(lie.inverse(last)))
    covariance = back @ (total[start + poses] - total[start]) @ back.swapaxes(1, 2)
    weighed = np.linalg.solve(covariance, error[..., None])[..., 0]
    return {
        "segments": float(len(start)),
        "both": float((error * weighed).sum(axis=1).mean() / 3.0),
        "rotation": float((error[:, 2] ** 2 / covariance[:, 2, 2]).mean()),
        "mean_heading_error_in_sigmas": float((error[:, 2] / covariance[:, 2, 2] ** 0.5).mean()),
    }


if __name__ == "__main__":
    raise SystemExit(main())
