"""Coverage of the intervals of `calibrate`, on simulated maps whose information is honest.

    python -m benchmarks.calibration_coverage --worlds 200 --out DIR

Each world is one city map of its own seed, odometry and loops, whose factors are 1. Writes
summary.json: of each of the four factors how often its 90 % interval holds 1, the mean and the
standard deviation of its logarithm, and how many numbers it rests on in the mean.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pcm_jax import calibrate
from pcm_jax.simulation import simulate_city

NAMES = ("odometry translation", "odometry rotation", "closures translation", "closures rotation")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="benchmarks.calibration_coverage", description=__doc__)
    parser.add_argument("--worlds", type=int, default=200, metavar="N")
    parser.add_argument("--poses", type=int, default=100, metavar="N")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    options = parser.parse_args(arguments)
    start = time.perf_counter()
    found = [
        calibrate(simulate_city(seed=seed, poses=options.poses).graph.maps[0], seed=seed)
        for seed in range(options.worlds)
    ]
    factors = np.array([each.factors for each in found])
    ends = np.array([[factor.interval for factor in each.factors] for each in found])
    covered = ((ends[..., 0] <= 1.0) & (ends[..., 1] >= 1.0)).mean(axis=0)
    rests = np.mean([each.components.redundancy for each in found], axis=0)
    summary = {
        name: {
            "covered": float(covered[row]),
            "mean_log": float(np.log(factors[:, row]).mean()),
            "deviation_log": float(np.log(factors[:, row]).std()),
            "redundancy": float(rests[row]),
        }
        for row, name in enumerate(NAMES)
    }
    summary["all"] = {"covered": float(covered.mean()), "seconds": time.perf_counter() - start}
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    print(json.dumps(summary, indent=2))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
