"""Candidates of real place recognition: between two sessions, and inside one robot's map.

    python -m benchmarks.place_recognition [--data DIR] --out DIR [--datasets NAME...] [--cuts 7]

The paper's false closures are drawn or come from registration between two sessions of which one is
not public. Here a place-recognition front end made them (`benchmarks.experiments.real_candidates`):
KITTI 00, whose false candidates say "the same pose", and Bicocca 25b, whose false ones are
registrations of look-alike corridors, several of which agree with each other.

Two robots: the trajectory is cut in two at evenly spaced poses, one version for each; candidates
across the cut are the closures between the two, and each map is put into the frame of its own first
pose, so that nothing is left of their alignment. Arms of the comparison:
    two-robots                       maps of odometry alone, information as the file says
    two-robots-rescaled              covariances times factors that need no truth
    two-robots-rescaled-by-truth     times factors against the truth, an upper bound
    two-robots-cleaned               candidates inside either session kept if `select_within` does
    two-robots-cleaned-rescaled      both
    two-robots-as-found              candidates inside either session all kept
where a threshold is not its collection's loosest, the first and the fourth only, fewer methods.
One robot: the whole trajectory with all its candidates, before and after `select_within`.

Errors of a trajectory are ATE after the best rigid motion (Umeyama): the start of either data set
says little of the heading. Versions whose maps a method did not join have none, and count in
`merged`. Rates are pooled over versions, whose candidates differ in number.

Writes summary.json ({data set/arm: {method: figures}}), noise.json (how honest the information and
the labels are), versions.csv, sets.csv (the largest sets of right and of false candidates that
agree), sweep.csv (rates against a factor on all covariances), table.md, figures and run.json.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.experiments import real_candidates as real
from benchmarks.experiments.command import command_parser, run_tasks, write_run
from benchmarks.experiments.real_candidate_report import (
    Picture,
    is_version,
    pooled,
    write_figures,
    write_results,
)
from benchmarks.experiments.real_candidates import Factors
from benchmarks.experiments.record import LIBRARY
from benchmarks.suite.harness import DATA
from pcm_jax import (
    InputWarning,
    MultiRobotGraph,
    lie,
    optimize,
    select,
    select_from,
    select_within,
)
from pcm_jax.evaluation import ate_rmse
from pcm_jax.experiments import Compared, Method, compare_methods, drives
from pcm_jax.experiments.comparison import BEYOND_THE_PAPER, CALIBRATED, PAPER, REFERENCE
from pcm_jax.experiments.drives import Candidates, across, sessions, sessions_truth
from pcm_jax.store import Store, digest

ALL_METHODS = PAPER | CALIBRATED | BEYOND_THE_PAPER
SOME_METHODS = {
    name: ALL_METHODS[name]
    for name in (REFERENCE, "scgp", "pcm-exact-11", "pcm-exact-99", "ransac-99", "clipper")
}
TWO_METHODS = {name: ALL_METHODS[name] for name in (REFERENCE, "pcm-exact-99")}

SCALES = np.logspace(-2.0, 2.0, 17)
SWEPT = ("pcm-exact", "ransac")


class Arm(NamedTuple):
    """The edges that the two robots' maps are made of.

    Attributes:
        maps: "odometry", "cleaned" or "as-found".
        factors: "as-written", "data" or "truth".
        methods: the rows.
    """

    maps: str
    factors: str
    methods: Mapping[str, Method]


ARMS = {
    "two-robots": Arm("odometry", "as-written", ALL_METHODS),
    "two-robots-rescaled": Arm("odometry", "data", SOME_METHODS),
    "two-robots-rescaled-by-truth": Arm("odometry", "truth", SOME_METHODS),
    "two-robots-cleaned": Arm("cleaned", "as-written", SOME_METHODS),
    "two-robots-cleaned-rescaled": Arm("cleaned", "data", SOME_METHODS),
    "two-robots-as-found": Arm("as-found", "as-written", TWO_METHODS),
}
"""Of the loosest threshold of each collection."""

FEWER_ARMS = {
    "two-robots": Arm("odometry", "as-written", SOME_METHODS),
    "two-robots-cleaned": Arm("cleaned", "as-written", SOME_METHODS),
}
"""Of stricter thresholds, which have fewer false candidates."""

WITHIN: dict[str, tuple[str, dict[str, Any]]] = {
    "within-pcm-11": ("as-written", {"confidence": 0.11}),
    "within-pcm-99": ("as-written", {}),
    "within-pcm-99-rescaled": ("data", {}),
    "within-pcm-99-rescaled-by-truth": ("truth", {}),
    "within-pcm-99-pairs-only": ("as-written", {"own_loop": False}),
    "within-ransac-99": ("as-written", {"method": "ransac"}),
    "within-pcm-99-sure-2": ("sure-2", {}),
    "within-pcm-99-sure-5": ("sure-5", {}),
    "within-pcm-99-sure-15": ("sure-15", {}),
    "within-pcm-99-sure-5-as-stated": ("sure-5", {"odometry_scale": 1.0, "minimum_inliers": 2}),
}
"""What `select_within` is asked of the whole trajectory: factors and options.

"sure-5": odometry states its errors 5 times smaller than the file does; as stated: without asking
the closures by how much."""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = _parser()
    options = parser.parse_args(arguments)
    start, names = time.perf_counter(), _names(parser, options)
    options.out.mkdir(parents=True, exist_ok=True)
    sources = [*LIBRARY, Path(__file__), Path(real.__file__)]
    steps = Store(options.out / "steps", digest((options.data.name, options.cuts), files=sources))
    loosest = {name.rpartition("_")[0]: name for name in reversed(names)}.values()
    single = {name: partial(run_one_robot, options.data, name) for name in names}
    double = {
        f"{name}-{number + 1}-of-{options.cuts}": partial(
            run_two_robots, options.data, name, number, options.cuts, name in loosest
        )
        for name in names
        for number in range(options.cuts)
    }
    trajectories = run_tasks("trajectories", single, steps, jobs=options.jobs)
    versions = run_tasks("versions", double, steps, jobs=options.jobs)
    write_results(options.out, trajectories, versions)
    write_run(options.out, options, start)
    pictures = {
        name: picture(options.data, name, versions)
        for name in loosest
        if any(is_version(run, name) for run in versions.values())
    }
    write_figures(options.out, versions, pictures)
    print(f"{(options.out / 'table.md').read_text()}\nwrote {options.out / 'summary.json'}")
    return 0


def run_one_robot(data: Path, name: str) -> dict[str, Any]:
    """Judges one trajectory with all its candidates: figures by method, and the noise."""
    candidates = load(data, name)
    graph, right, odometry = candidates.graph, candidates.is_true, drives.steps(candidates.graph)
    written = selection_of(data, name)
    alone = odometry.copy()
    alone[written.closures] = written.own_squared <= written.gate
    kept = {"odometry": odometry, "everything": odometry | True, REFERENCE: odometry | right}
    kept["own-loops-99"] = alone  # each candidate against odometry, none against another
    methods = {row: _trajectory(candidates, mask, 0.0) for row, mask in kept.items()}
    for row, (factors, options) in WITHIN.items():
        scaled = real.rescaled(graph, factors_of(data, name, factors))
        start = time.perf_counter()
        kept = select_within(scaled, **options).kept
        methods[row] = _trajectory(candidates, kept, time.perf_counter() - start)
    noise = real.noise(candidates, written) | _agreement(candidates, written)
    return {"methods": methods, "noise": noise, "labels": _by_tolerance(candidates, written)}


def run_two_robots(data: Path, name: str, number: int, cuts: int, loosest: bool) -> dict[str, Any]:
    """Runs methods on two sessions, in all arms; nothing where none is right."""
    candidates = load(data, name)
    cut = candidates.graph.num_poses * (number + 1) // (cuts + 1)
    right = candidates.is_true[across(candidates.graph, cut)]
    about = {"data": name, "cut": cut, "candidates": len(right), "right": int(right.sum())}
    if right.sum() < 2:
        return about | {"arms": {}}
    arms, truth = {}, sessions_truth(candidates, cut)
    for label, arm in (ARMS if loosest else FEWER_ARMS).items():
        factors = factors_of(data, name, arm.factors)
        graph = sessions(real.rescaled(candidates.graph, factors), cut, arm.maps)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)
            results = compare_methods(graph, right, truth, methods=arm.methods)
        arms[label] = {row: _figures(each, right, truth) for row, each in results.items()}
    return (
        about | _sets_and_sweep(sessions(candidates.graph, cut, "odometry"), right) | {"arms": arms}
    )


def picture(data: Path, name: str, versions: Mapping[str, Any]) -> Picture:
    """The maps before and after, of one robot and of two.

    The version shown is the one in which the largest false set is largest against the right one.
    """
    candidates = load(data, name)
    graph, odometry = candidates.graph, drives.steps(candidates.graph)
    accepted = select_within(graph).kept
    solved = {
        "candidates all accepted": optimize(graph).graph,
        "select_within": optimize(graph.with_edges(accepted)).graph,
    }
    runs = [run for run in versions.values() if is_version(run, name)]
    hardest = max(runs, key=lambda run: run["largest_false_set"] / run["largest_right_set"])
    cut = hardest["cut"]
    both, truth = sessions(graph, cut, "cleaned"), sessions_truth(candidates, cut)
    right = candidates.is_true[across(graph, cut)]
    rows = {row: ALL_METHODS[row] for row in ("ransac-99", "pcm-exact-99")}
    results = compare_methods(both, right, methods=rows)
    return Picture(
        {"truth": candidates.truth, "odometry": drives.chained(graph)}
        | {title: lie.as_numpy(each.poses) for title, each in solved.items()},
        np.stack([np.asarray(graph.tail), np.asarray(graph.head)])[:, ~odometry],
        accepted[~odometry],
        candidates.is_true[~odometry],
        {"truth": (truth, None)}
        | {row: (each.maps, each.accepted) for row, each in results.items()},
        both.closures,
        right,
        cut,
    )


@lru_cache(maxsize=1)
def load(data: Path, name: str) -> Candidates:
    """The candidates of a file; the last one is kept."""
    return drives.load(data, name)


@lru_cache(maxsize=1)
def selection_of(data: Path, name: str) -> Any:
    """The selection of `select_within` on the whole trajectory, information as written."""
    return select_within(load(data, name).graph)


def factors_of(data: Path, name: str, kind: str) -> Factors:
    """The factors of an arm."""
    if kind == "as-written":
        return Factors()
    if kind.startswith("sure-"):
        return Factors(odometry=float(kind.removeprefix("sure-")) ** -2)
    candidates, selection = load(data, name), selection_of(data, name)
    if kind == "data":
        return real.factors_of_data(selection, candidates.graph)
    return real.factors_of_truth(selection, candidates)


def _trajectory(candidates: Candidates, kept: np.ndarray, seconds: float) -> dict[str, Any]:
    """Figures of the trajectory with some of its candidates, information as written."""
    graph, right, odometry = candidates.graph, candidates.is_true, drives.steps(candidates.graph)
    solution = optimize(graph.with_edges(kept))
    accepted = kept & ~odometry
    freedom = graph.tangent_dim * max(1, int(accepted.sum()))
    return {
        **_counts(accepted[~odometry], right[~odometry]),
        "ate_rmse": float(ate_rmse(solution.graph, candidates.truth, align="umeyama")),
        "chi2": 2.0 * solution.cost / freedom if accepted.any() else None,
        "converged": float(solution.converged),
        "seconds": seconds,
    }


def _figures(compared: Compared, right: np.ndarray, truth: Any) -> dict[str, Any]:
    joined = bool(compared.accepted.any())
    error = float(ate_rmse(compared.maps, truth, align="umeyama")) if joined else None
    return {
        **_counts(compared.accepted, right),
        "ate_rmse": error,
        "chi2": compared.figures["chi2"] if joined else None,
        "converged": compared.figures["converged"],
        "seconds": compared.figures["seconds"],
    }


def _counts(accepted: np.ndarray, right: np.ndarray) -> dict[str, int]:
    return {
        "candidates": len(right),
        "right": int(right.sum()),
        "accepted": int(accepted.sum()),
        "accepted_right": int((accepted & right).sum()),
    }


def _sets_and_sweep(graph: MultiRobotGraph, right: np.ndarray) -> dict[str, Any]:
    """The largest sets that agree among right and among false candidates; a sweep of the gate."""
    (pair,) = select(graph, method="ransac").pairs
    sweep = {
        method: [
            [float(scale), int(accepted.sum()), int((accepted & right).sum())]
            for scale, accepted in (
                (each, np.asarray(select_from(pair.squared, each * pair.gate, method=method)))
                for each in SCALES
            )
        ]
        for method in SWEPT
    }
    largest = {
        f"largest_{kind}_set": _largest(pair.squared, pair.gate, np.flatnonzero(rows))
        for kind, rows in {"right": right, "false": ~right}.items()
    }
    return {"sweep": sweep, **largest}


def _agreement(candidates: Candidates, selection: Any) -> dict[str, float]:
    """Measures whether false candidates inside one map agree with each other."""
    false = np.flatnonzero(~candidates.is_true[selection.closures])
    squared = np.maximum(selection.squared, selection.squared.T)[np.ix_(false, false)]
    pairs = squared[np.triu_indices(len(false), 1)] <= selection.gate
    return {
        "false_pairs_consistent": float(pairs.mean()) if len(pairs) else 0.0,
        "largest_false_set": float(_largest(selection.squared, selection.gate, false)),
    }


def _largest(squared: np.ndarray, gate: float, rows: np.ndarray) -> int:
    return int(np.sum(select_from(squared[np.ix_(rows, rows)], gate))) if len(rows) else 0


def _by_tolerance(candidates: Candidates, selection: Any) -> dict[str, dict[str, Any]]:
    """The accepted set's worth where "right" means within another tolerance."""
    rates = {}
    for metres, degrees in real.TOLERANCES:
        right = drives.within_tolerance(candidates.graph, candidates.truth, (metres, degrees))
        counts = _counts(selection.accepted, right[selection.closures])
        rate = pooled([counts | dict.fromkeys(("ate_rmse", "chi2", "converged", "seconds"))])
        relabelled = int((right != candidates.is_true).sum())
        chosen = {name: rate[name] for name in ("right", "precision", "recall")}
        rates[f"{metres:g} m, {degrees:g} degrees"] = chosen | {"labels_that_differ": relabelled}
    return rates


def _names(parser: argparse.ArgumentParser, options: argparse.Namespace) -> list[str]:
    names = drives.found(options.data)
    if not names:
        parser.error(f"--data: {options.data} has no kitti_robust or rrr, expected one of them")
    unknown = set(options.datasets or ()) - set(names)
    if unknown:
        parser.error(f"--datasets: {min(unknown)!r} given, expected some of {', '.join(names)}")
    return options.datasets or drives.spread(names)


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("place_recognition", __doc__)
    parser.add_argument(
        "--data", type=Path, default=DATA, help="folder with kitti_robust and rrr in it"
    )
    parser.add_argument(
        "--datasets",
        nargs="+",
        metavar="NAME",
        help="files by name (default: loosest, middle and strictest threshold of each collection)",
    )
    parser.add_argument("--cuts", type=int, default=7, help="versions of each, evenly spaced cuts")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
