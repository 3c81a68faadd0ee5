"""The worth of the right covariance: drift and loops grow, and Q is computed in three ways.

    python -m benchmarks.covariances --worlds 20 --out DIR [--kinds city sessions]

The paper's Q takes the covariance of a relative pose within a map from the joint marginal of its
two poses. Public tools do otherwise, and the paper does not say what that costs. Here every world
is judged three times, with the same optimised maps, closures and gates:

- joint: the joint marginals, cross-covariances included (eq. 4);
- odometry-chain: those of the map without its loop closures, as if the odometry between the two
  poses were all that ties them;
- independent: Σ_ii + Σ_jj, the cross-covariances of different poses left out, first pose held.

Neither can be too small where errors add up along a path, so that right closures pass all the more;
what they let in besides is the question. Only hard outliers ask it.

Worlds are those of `simulate_city` (SE(2)) and `simulate_sessions` (SE(3)), with the odometry's
noise scaled by the drift and a share of the loop closures inside the maps. Candidates: 15 right
ones; the paper's outliers (two aliased groups of 5 with a wrong alignment anywhere, 90 random
ones); and 5 that take one place for the next, `NEXT_PLACE` further along the street, with the
inliers' noise: outliers that only a sharp test tells from the right ones. Measured noise is always
that of the recorded information.

Writes summary.json ({kind: [point]}, the means of each), points.csv, and for each kind pictures of
both sweeps and of the gate's (rates against confidence at one point), and run.json.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.experiments.command import command_parser, run_tasks, write_run
from benchmarks.experiments.drifting import (
    KINDS,
    RIGHT,
    Candidates,
    Kind,
    Point,
    candidates,
    odometry,
    points,
)
from benchmarks.experiments.record import LIBRARY, write_csv
from pcm_jax import (
    MultiRobotGraph,
    PoseGraph,
    chi2_gate,
    consistency_problem,
    joint_marginal_covariance,
    merge,
    select_from,
    squared_mahalanobis,
)
from pcm_jax.arrays import on_host
from pcm_jax.evaluation.metrics import false_positive_rate, pose_error, true_positive_rate
from pcm_jax.store import Store, digest, write_json

COVARIANCES = ("joint", "odometry-chain", "independent")
REFERENCE = "no-outliers"
MERGED = (0.95, 0.99)
SOURCES = (*LIBRARY, Path(__file__), Path(__file__).parent / "experiments" / "drifting.py")
CONFIDENCES = (0.05, 0.2, 0.5, 0.8, 0.9, *MERGED, 0.999, 0.9999)


def main(arguments: Sequence[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    start = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    steps = Store(options.out / "steps", digest((MERGED, CONFIDENCES), files=SOURCES))
    tasks = {
        f"{name}-{point.drift:g}-{point.share:g}-{seed}-{number:03}": partial(
            run_world, KINDS[name], point, seed, number
        )
        for name in options.kinds
        for point in points(KINDS[name])
        for seed in options.seeds
        for number in range(options.worlds)
    }
    results = run_tasks("worlds", tasks, steps, jobs=options.jobs)
    summary = {
        name: [
            _mean_point(point, [r for task, r in results.items() if task.startswith(prefix)])
            for point in points(KINDS[name])
            for prefix in [f"{name}-{point.drift:g}-{point.share:g}-"]
        ]
        for name in options.kinds
    }
    write_json(options.out / "summary.json", summary)
    write_csv(options.out / "points.csv", list(_rows(summary)))
    for name in options.kinds:
        _draw(name, summary[name], options.out)
        print(
            f"{name}, {options.worlds * len(options.seeds)} worlds a point\n{_table(summary[name])}"
        )
    write_run(options.out, options, start)
    print(f"wrote {options.out / 'summary.json'}")
    return 0


@on_host
def run_world(kind: Kind, point: Point, seed: int, number: int) -> dict[str, Any]:
    """Judges one world by the three covariances: figures by row, rates by confidence."""
    world = candidates(kind, point, seed, number)
    errors: dict[bytes, dict[str, float]] = {}
    methods, gates = {REFERENCE: _map_error(world, world.right, errors)}, {}
    for name, squared in squared_distances(world.graph).items():
        for confidence in CONFIDENCES:
            gate = float(chi2_gate(confidence, world.graph.tangent_dim))
            accepted = select_from(squared, gate)
            rates = _rates(world, squared, gate, accepted)
            gates[f"{name}-{confidence:g}"] = rates
            if confidence in MERGED:
                label = f"{name}-{100 * confidence:g}"
                methods[label] = rates | _map_error(world, accepted, errors)
    loops = [np.count_nonzero(~odometry(one)) / one.num_poses for one in world.graph.maps]
    return {"methods": methods, "gates": gates, "loops_per_pose": float(np.mean(loops))}


def squared_distances(graph: MultiRobotGraph) -> dict[str, Float[np.ndarray, "m m"]]:
    """Q, squared, by each of the `COVARIANCES` of the maps."""
    (map_a, map_b), closures = graph.maps, graph.closures
    of_a = _of_map(map_a, np.unique(np.asarray(closures.pose_a)))
    of_b = _of_map(map_b, np.unique(np.asarray(closures.pose_b)))
    problems = {
        name: consistency_problem(map_a, map_b, closures, marginals=(of_a[name], of_b[name]))
        for name in COVARIANCES
    }
    return {name: np.asarray(squared_mahalanobis(each)) for name, each in problems.items()}


def _of_map(one: PoseGraph, touched: np.ndarray) -> dict[str, Float[np.ndarray, "kd kd"]]:
    """Covariances that `consistency_problem` takes as the `marginals` of a map."""
    joint = joint_marginal_covariance(one, touched)
    alone = one.with_edges(odometry(one))  # at the optimised poses: only the covariance differs
    own = np.kron(np.eye(len(touched)), np.ones((one.tangent_dim, one.tangent_dim)))
    chain = joint_marginal_covariance(alone, touched)
    return dict(zip(COVARIANCES, (joint, chain, own * joint), strict=True))


def _rates(world: Candidates, squared: np.ndarray, gate: float, accepted: Any) -> dict[str, float]:
    """`inside`: the share of ordered pairs of right closures within the gate."""
    right: Any = world.right
    pairs = squared[np.ix_(right, right)][~np.eye(RIGHT, dtype=bool)]
    return {
        "inside": float((pairs <= gate).mean()),
        "tpr": float(true_positive_rate(accepted, right)),
        "fpr": float(false_positive_rate(accepted, right)),
        "next_place": float(accepted[world.next_place].mean()),
    }


def _map_error(
    world: Candidates, accepted: np.ndarray, known: dict[bytes, dict[str, float]]
) -> dict[str, float]:
    """Error of the maps merged by these closures, in the frame of the first true pose."""
    key = accepted.tobytes()
    if key not in known:
        merged = merge(world.graph, accepted=accepted, optimized=True)
        error = pose_error([one.poses for one in merged.graph.maps], world.truth)
        mse = float(error.translation_mse)
        known[key] = {"translation_mse": mse, "ate_rmse": mse**0.5}
    return known[key]


def _mean_point(point: Point, runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over the worlds of a point."""
    return {
        **point._asdict(),
        "loops_per_pose": float(np.mean([run["loops_per_pose"] for run in runs])),
        **{part: _means([run[part] for run in runs]) for part in ("methods", "gates")},
    }


def _means(runs: Sequence[Mapping[str, Mapping[str, float]]]) -> dict[str, dict[str, float]]:
    return {
        name: {figure: float(np.mean([run[name][figure] for run in runs])) for figure in figures}
        for name, figures in runs[0].items()
    }


def _rows(summary: Mapping[str, Sequence[Mapping[str, Any]]]) -> Iterable[dict[str, Any]]:
    figures = ("inside", "tpr", "fpr", "next_place", "translation_mse", "ate_rmse")
    for kind, found in summary.items():
        for point in found:
            where = {name: point[name] for name in ("drift", "share", "loops_per_pose")}
            for method, row in point["methods"].items():
                values = {name: row.get(name) for name in figures}
                yield {"kind": kind, **where, "method": method, **values}


def _table(found: Sequence[Mapping[str, Any]]) -> str:
    head = ("inside", "TPR", "FPR", "next place", "ATE m")
    lines = [f"{'':24}" + "".join(f"{name:>12}" for name in head)]
    for point in found:
        lines.append(f"drift {point['drift']:g}, {point['loops_per_pose']:.3f} loops a pose")
        for method, row in point["methods"].items():
            names = ("inside", "tpr", "fpr", "next_place", "ate_rmse")
            cells = (f"{row[name]:12.4f}" if name in row else f"{'':12}" for name in names)
            lines.append(f"  {method:22}" + "".join(cells))
    return "\n".join(lines)


def _draw(name: str, found: Sequence[Mapping[str, Any]], out: Path) -> None:
    """The two sweeps at the 99 % gate, and the gate's own sweep where they cross."""
    kind = KINDS[name]
    drifts = [point for point in found if point["share"] == kind.share]
    loops = sorted(
        (point for point in found if point["drift"] == kind.drift), key=lambda p: p["share"]
    )
    _draw_sweep(
        drifts, "drift", "odometry noise, times the simulation's", out / f"{name}-drift.png"
    )
    _draw_sweep(
        loops, "loops_per_pose", "loop closures inside a map, per pose", out / f"{name}-loops.png"
    )
    (crossing,) = (point for point in drifts if point["drift"] == kind.drift)
    panels = {
        label: {
            covariance: [crossing["gates"][f"{covariance}-{c:g}"][figure] for c in CONFIDENCES]
            for covariance in COVARIANCES
        }
        for label, figure in _RATES.items()
    }
    xlabel = "confidence: probability inside the gate"
    _save_panels(CONFIDENCES, panels, xlabel, out / f"{name}-gates.png")


_RATES = {"inside the gate": "inside", "TPR": "tpr", "FPR": "fpr"}


def _draw_sweep(found: Sequence[Mapping[str, Any]], along: str, xlabel: str, path: Path) -> None:
    def curve(row: str, figure: str) -> list[float]:
        return [point["methods"][row][figure] for point in found]

    panels = {
        label: {covariance: curve(f"{covariance}-99", figure) for covariance in COVARIANCES}
        for label, figure in (_RATES | {"ATE (m)": "ate_rmse"}).items()
    }
    panels["ATE (m)"]["right closures only"] = curve(REFERENCE, "ate_rmse")
    _save_panels([point[along] for point in found], panels, xlabel, path, expected=99.0)


def _save_panels(
    x: Sequence[float],
    panels: Mapping[str, Any],
    xlabel: str,
    path: Path,
    expected: float | None = None,
) -> None:
    """`expected`: percent inside the gate, where the first panel has a line."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    from pcm_jax.plots import plot_threshold_sweeps

    axes = plot_threshold_sweeps(np.array(x), panels, xlabel=xlabel, percent=list(_RATES))
    if expected is not None:
        axes[0].axhline(expected, color="0.4", linestyle=":", linewidth=1.0)
    axes[0].figure.savefig(path, dpi=100, bbox_inches="tight")
    pyplot.close(axes[0].figure)


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("covariances", __doc__)
    parser.add_argument("--worlds", type=int, default=20, help="of each seed, at each point")
    parser.add_argument("--kinds", nargs="+", choices=tuple(KINDS), default=list(KINDS))
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
