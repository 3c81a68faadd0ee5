"""Coverage of the intervals of `calibrate`, on simulated maps whose factors are known.

    python -m benchmarks.calibration_coverage --worlds 200 --out DIR

Each world is a city of its own seed; `calibrate` is told nothing of it. Kinds:

one map     one robot's odometry and loops, as they state.
misstated   two robots, 40 right closures between them and 25 false; errors of odometry stated
            twice too large, of closures three times: factors 4 and 9.
too sure    the same, stated twice and three times too small: factors 1/4 and 1/9.
chains      two robots without loops of their own, 60 right closures between them and 25 false.

Writes summary.json: of each kind and each of the four factors how often its 90 % interval holds
the true one, the mean and the standard deviation of the logarithm of found by true, and how many
numbers it rests on in the mean; and how many of the closures between robots it went by were false.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcm_jax import MultiRobotGraph, PoseGraph, calibrate
from pcm_jax.integrity.calibration import closing_edges, scaled_graph
from pcm_jax.simulation import SimulatedWorld, simulate_city

NAMES = ("odometry translation", "odometry rotation", "closures translation", "closures rotation")


class Kind(NamedTuple):
    """A kind of world.

    Attributes:
        odometry, closures: the factors by which information is stated too small.
        right: closures between the robots; 0: one robot alone.
        loops: whether robots have loops of their own.
        poses: of each robot.
    """

    odometry: float = 1.0
    closures: float = 1.0
    right: int = 40
    loops: bool = True
    poses: int = 80

    @property
    def factors(self) -> np.ndarray:
        """All four."""
        return np.repeat([self.odometry, self.closures], 2)


KINDS = {
    "one map": Kind(right=0, poses=100),
    "misstated": Kind(4.0, 9.0),
    "too sure": Kind(1.0 / 4.0, 1.0 / 9.0),
    "chains": Kind(right=60, loops=False, poses=60),
}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="benchmarks.calibration_coverage", description=__doc__)
    parser.add_argument("--worlds", type=int, default=200, metavar="N", help="of each kind")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS), metavar="KIND")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    written = options.out / "summary.json"
    summary = json.loads(written.read_text()) if written.is_file() else {}
    for name in options.kinds:
        if name in summary and summary[name]["all"]["worlds"] == options.worlds:
            continue  # of a run that was stopped
        summary[name] = coverage(KINDS[name], range(options.worlds))
        written.write_text(json.dumps(summary, indent=2) + "\n")
        print(name, json.dumps(summary[name], indent=2), flush=True)
    return 0


def coverage(kind: Kind, seeds: range) -> dict[str, Any]:
    """The rows of one kind."""
    start, found, false = time.perf_counter(), [], 0
    for seed in seeds:
        graph, right = world(kind, seed)
        calibration = calibrate(graph, seed=seed)
        false += int((calibration.accepted & ~right).sum())
        found.append(calibration)
    ends = np.array([[factor.interval for factor in each.factors] for each in found])
    covered = ((ends[..., 0] <= kind.factors) & (ends[..., 1] >= kind.factors)).mean(axis=0)
    log = np.log([each.factors for each in found]) - np.log(kind.factors)
    rests = np.mean([each.components.redundancy for each in found], axis=0)
    rows: dict[str, Any] = {
        name: {
            "covered": float(covered[row]),
            "mean_log": float(log[:, row].mean()),
            "deviation_log": float(log[:, row].std()),
            "redundancy": float(rests[row]),
        }
        for row, name in enumerate(NAMES)
    }
    used = np.mean([each.accepted.sum() for each in found])
    rows["all"] = {
        "worlds": len(seeds),
        "covered": float(covered.mean()),
        "between": float(used),
        "false": false,
        "uneven": float(np.mean([each.growth.uneven for each in found])),
        "seconds": time.perf_counter() - start,
    }
    return rows


def world(kind: Kind, seed: int) -> tuple[PoseGraph | MultiRobotGraph, np.ndarray]:
    """A graph that misstates its information by the factors of its kind, and its labels."""
    if not kind.right:
        one = simulate_city(seed=seed, poses=kind.poses).graph.maps[0]
        return one, np.zeros(0, bool)
    made: SimulatedWorld = simulate_city(
        seed=seed, poses=kind.poses, inliers=kind.right, aliased_groups=1, random=20
    )
    graph = scaled_graph(made.graph, 1.0 / kind.factors)
    if not kind.loops:
        maps = tuple(one.with_edges(~closing_edges(one)) for one in graph.maps)
        graph = MultiRobotGraph(maps, graph.closures)
    return graph, made.is_true


if __name__ == "__main__":
    raise SystemExit(main())
