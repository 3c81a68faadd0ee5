"""NEES of the answer, anchors and merged poses, as maps drift more: is its covariance honest?

    python -m benchmarks.answers --out DIR [--worlds 500] [--groups SE2 SE3] [--drifts 1 2 4 8 16]

Two simulated robots, maps of odometry whose noise is that of the simulator times the drift, and
right closures alone. Of the merged map, against the truth and relative to the first pose of the
first robot:

    anchor    the anchor of the second robot, `MergeResult.anchor_covariance`
    middle    the same about the middle of its map, `anchor_covariance_at_middle`
    poses     three poses of the second robot jointly, `marginals`

NEES is the squared Mahalanobis length of the error (Bar-Shalom), over its degrees of freedom: 1 in
the mean if the covariance is honest. `low` and `high` are the bounds that the mean of so many
worlds keeps in 99 % of runs, by chi-squared. Covariances are propagated to first order, which holds
while the heading is known well: `heading` is the median, over worlds, of the largest standard
deviation of any merged pose's rotation, degrees; *warned* are worlds in which `marginals` does.

Writes summary.json ({cell: figures}), table.md and run.json.
"""

from __future__ import annotations

import itertools
import time
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from benchmarks.experiments.command import command_parser, finish, run_tasks
from benchmarks.experiments.record import LIBRARY
from pcm_jax import ConvergenceWarning, InputWarning, MergeResult, MultiRobotGraph, lie, merge
from pcm_jax.arrays import on_host
from pcm_jax.simulation import SimulatedWorld, simulate_city, simulate_sessions
from pcm_jax.store import Store, digest

SOURCES = (*LIBRARY, Path(__file__))
POSES, RIGHT = 120, 8
ASKED = (10, 60, 110)
NOISE = {
    "SE2": {"sigma_translation": 0.02, "sigma_rotation": 0.004},
    "SE3": {"sigma_translation": 0.05, "sigma_rotation": 0.005},
}
COLUMNS = {
    "anchor": "anchor, NEES over d",
    "middle": "about the middle",
    "poses": "three poses",
    "low": "99 % from",
    "high": "to",
    "poses_low": "of poses from",
    "poses_high": "to (poses)",
    "heading": "heading sigma, °",
    "warned": "warned, %",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command."""
    parser = command_parser("answers", __doc__)
    parser.add_argument("--worlds", type=int, default=500, metavar="N", help="in a cell")
    parser.add_argument("--groups", nargs="+", default=["SE2", "SE3"], choices=["SE2", "SE3"])
    parser.add_argument("--drifts", type=float, nargs="+", default=[1.0, 2.0, 4.0, 8.0, 16.0])
    options = parser.parse_args(arguments)
    start = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    steps = Store(options.out / "steps", digest(options.worlds, options.seeds, files=SOURCES))
    tasks = {
        f"{group}, drift {drift:g}": partial(
            nees_of, group, drift, worlds=options.worlds, seed=options.seeds[0]
        )
        for group, drift in itertools.product(options.groups, options.drifts)
    }
    found = run_tasks("cells", tasks, steps, jobs=options.jobs)
    return finish(options, start, found, found, COLUMNS)


class Nees(NamedTuple):
    """Squared Mahalanobis lengths of one world's errors, and how well headings are known."""

    anchor: float
    middle: float
    poses: float
    heading: float
    warned: bool


def nees_of(group: str, drift: float, *, worlds: int, seed: int) -> dict[str, float]:
    """Means over worlds, with the bounds that they keep where covariances are honest."""
    own = [world_nees(world_of(group, drift, (seed, number))) for number in range(worlds)]
    d = 3 if group == "SE2" else 6
    means = {
        name: float(np.mean([getattr(one, name) for one in own])) / dof
        for name, dof in (("anchor", d), ("middle", d), ("poses", d * len(ASKED)))
    }
    bounds = {
        f"{prefix}{name}": float(chi2.ppf(mass, worlds * dof) / (worlds * dof))
        for prefix, dof in (("", d), ("poses_", d * len(ASKED)))
        for name, mass in (("low", 0.005), ("high", 0.995))
    }
    heading = np.degrees(float(np.median([one.heading for one in own])))
    warned = 100.0 * float(np.mean([one.warned for one in own]))
    return means | bounds | {"heading": heading, "warned": warned}


def world_of(group: str, drift: float, seed: tuple[int, int]) -> SimulatedWorld:
    """Two robots with right closures alone."""
    simulate: Any = simulate_city if group == "SE2" else simulate_sessions
    noise = {kind: drift * sigma for kind, sigma in NOISE[group].items()}
    number = seed[0] * 1_000_000 + seed[1]
    law = {"poses": POSES, "inliers": RIGHT, "aliased_groups": 0, "random": 0}
    return simulate(seed=number, **law, **noise)


@on_host
def world_nees(world: SimulatedWorld) -> Nees:
    """Merges a world's maps of odometry by all its closures, and weighs the errors."""
    maps = [one.with_edges(np.asarray(one.head) - one.tail == 1) for one in world.graph.maps]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # headings of which nothing is known
        result = merge(MultiRobotGraph(tuple(maps), world.graph.closures), method="all")
    first = lie.take(lie.as_numpy(result.graph.maps[0].poses), 0)
    frame = lie.compose(first, lie.inverse(lie.take(world.truth[0], 0)))
    truth = lie.compose(frame, world.truth[1])
    asked = np.asarray(ASKED)
    merged = lie.take(lie.as_numpy(result.graph.maps[1].poses), asked)
    error = lie.log(lie.between(lie.take(truth, asked), merged)).reshape(-1)
    own = lie.as_numpy(result.maps[1].poses)
    true_anchor = lie.compose(lie.take(truth, 0), lie.inverse(lie.take(own, 0)))
    anchor = lie.take(result.anchors, 1)
    shift = _translation_by(lie.translation(own).mean(axis=0), result)
    off = lie.log(lie.between(true_anchor, anchor))
    off_middle = lie.log(lie.between(lie.compose(true_anchor, shift), lie.compose(anchor, shift)))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", InputWarning)
        of_poses = result.marginals(1, asked)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        heading = _largest_heading(result)
    return Nees(
        anchor=_squared(off, result.anchor_covariance[1]),
        middle=_squared(off_middle, result.anchor_covariance_at_middle[1]),
        poses=_squared(error, of_poses),
        heading=heading,
        warned=bool(told),
    )


def _squared(error: Any, covariance: np.ndarray) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def _translation_by(metres: np.ndarray, result: MergeResult) -> Any:
    matrix: Any = np.eye(len(metres) + 1)
    matrix[:-1, -1] = metres
    return lie.as_numpy(lie.from_matrix(matrix))


def _largest_heading(result: MergeResult) -> float:
    d = result.graph.tangent_dim
    space, largest = (2 if d == 3 else 3), 0.0
    for robot in range(2):
        blocks = result.marginals(robot).reshape(POSES, d, POSES, d)
        own = blocks[np.arange(POSES), :, np.arange(POSES)][:, space:, space:]
        largest = max(largest, float(np.linalg.eigvalsh(own).max()))
    return np.sqrt(largest)


if __name__ == "__main__":
    raise SystemExit(main())
