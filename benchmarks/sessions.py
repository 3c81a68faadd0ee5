"""The paper's NCLT experiment (Figs 6 and 7, Table II) on a substitute for its data.

    python -m benchmarks.sessions --data DIR --sessions 2012-08-04 2012-10-28 --out DIR

The paper's pose graphs and GICP registrations are not public. Here odometry and ground truth are
NCLT's own (`benchmarks.experiments.nclt`), and registrations are simulated on that truth
(`benchmarks.experiments.registrations`): whatever is measured here is a figure of the substitute.

The first third of the first session and the last third of the second are left out. Each version
draws anew what is simulated: the loop closures inside the two maps, and 10 right closures and 98
wrong ones between them. The paper has one draw, which says little about its rows.

Table II's two kinds of error are `map_...` (where the second map's first pose stands, seen from the
first map's) and `step_...` (each pose seen from the one before), both against ground truth.

Where NCLT's files are absent, odometry and truth of two simulated sessions stand in
(`pcm_jax.simulation.simulate_sessions`), and sessions.json, table and figures say so.

Writes summary.json ({method: means over the versions}), versions.csv, sessions.json (what was read,
the odometry's noise, how well squared distances are calibrated), table.md, fig6.png, fig7.png and
run.json.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.experiments.command import command_parser, run_tasks, write_run
from benchmarks.experiments.nclt import (
    HORIZON,
    Session,
    drift_sigmas,
    excess,
    find,
    portion,
    read_session,
)
from benchmarks.experiments.record import (
    LIBRARY,
    means_by_method,
    rows_by_method,
    write_csv,
)
from benchmarks.experiments.registrations import (
    Version,
    counts_by_kind,
    draw_version,
    neighbours,
    number_of_candidates,
)
from benchmarks.suite.harness import DATA
from pcm_jax import InputError, MultiRobotGraph, chi2_gate, lie, select
from pcm_jax.evaluation import ate_rmse, comparison_table
from pcm_jax.experiments import Compared, compare_methods
from pcm_jax.experiments.comparison import BEYOND_THE_PAPER, CALIBRATED, PAPER, REFERENCE
from pcm_jax.simulation import simulate_sessions
from pcm_jax.store import Store, digest, write_json

NCLT = DATA / "nclt"
SESSIONS = ("2012-08-04", "2012-10-28")
METHODS = PAPER | CALIBRATED | BEYOND_THE_PAPER

GATES = (0.11, 0.5, 0.95, 0.99)
WINDOWS = (1, 5, 20, 50, 100)  # keyframes
SHOWN = (
    REFERENCE,
    "pcm-exact-99",
    "pcm-exact-11",
    "ransac-1",
    "ransac-3.5",
    "scgp",
    "dcs",
)  # Fig. 7
COLUMNS = {
    "tpr": "TPR",
    "fpr": "FPR",
    "accepted_true": "right accepted",
    "accepted_poor": "poor accepted",
    "accepted_false": "false accepted",
    "map_translation_mse": "map: transl. MSE (m²)",
    "map_translation_rmse": "RMSE (m)",
    "map_rotation_mse": "map: rot. MSE (rad)",
    "step_translation_mse": "trajectory: transl. MSE (m²)",
    "step_translation_rmse": "RMSE (m) ",
    "step_rotation_mse": "trajectory: rot. MSE (rad)",
    "ate_median": "median ATE (m)",
    "residual": "residual",
    "chi2": "norm. χ²",
    "seconds": "time (s)",
}
KINDS_EXPLAINED = (
    "Poor: the right place, beyond the threshold that makes a closure wrong; false: all other "
    "wrong ones; FPR counts both."
)


class Source(NamedTuple):
    """The origin of the sessions: all that the results depend on, but for the versions.

    Attributes:
        data: NCLT's folder; None: simulated.
        names: of the sessions.
        horizon: keyframes, see `nclt.drift_sigmas`.
        poses: of each simulated session.
    """

    data: Path | None
    names: tuple[str, ...]
    horizon: int
    poses: int


def main(arguments: Sequence[str] | None = None) -> int:
    parser = _parser()
    options = parser.parse_args(arguments)
    start, source = time.perf_counter(), _source(parser, options)
    methods = tuple(options.methods or METHODS)
    options.out.mkdir(parents=True, exist_ok=True)
    try:
        about = _about(source)
    except InputError as error:
        parser.error(str(error))
    steps = Store(options.out / "steps", digest((source, methods, METHODS), files=_sources()))
    tasks = {
        f"{seed}-{number:04}": partial(run_version, source, methods, seed, number)
        for seed in options.seeds
        for number in range(options.versions)
    }
    versions = run_tasks("versions", tasks, steps, jobs=options.jobs)
    table = write_results(options.out, source, about, versions)
    draw_figures(options.out, source, options.seeds[0])
    write_run(options.out, options, start)
    print(f"{table}\nwrote {options.out / 'summary.json'}")
    return 0


def write_results(
    out: Path, source: Source, about: Mapping[str, Any], versions: Mapping[str, Mapping[str, Any]]
) -> str:
    """Writes everything but the figures, and returns the table."""
    summary = summarised(versions.values())
    write_json(out / "summary.json", summary)
    write_csv(out / "versions.csv", rows_by_method(versions))
    write_json(out / "sessions.json", {**about, **_mean_calibration(versions.values())})
    caption = f"{_caption(source, len(versions))} {KINDS_EXPLAINED}"
    table = f"{caption}\n\n{comparison_table(summary, COLUMNS)}\n"
    (out / "table.md").write_text(table)
    return table


def run_version(source: Source, methods: Sequence[str], seed: int, number: int) -> dict[str, Any]:
    """Runs methods on one version: figures by method, and how the maps and Q turned out."""
    version = draw(source, seed, number)
    graph, squared = _optimised(version.graph)
    results = _compared(graph, version, methods)
    kinds = {name: counts_by_kind(version.kinds, each.accepted) for name, each in results.items()}
    return {
        "methods": {
            name: _finite(each.figures) | _counts(kinds[name]) for name, each in results.items()
        },
        "calibration": _inside(squared, version.is_true),
        "maps": {
            one.name: {
                "loops": one.num_edges - one.num_poses + 1,
                "odometry_ate": float(ate_rmse(raw, truth, align="umeyama")),
                "optimised_ate": float(ate_rmse(one, truth, align="umeyama")),
            }
            for raw, one, truth in zip(version.graph.maps, graph.maps, version.truth, strict=True)
        },
    }


def draw(source: Source, seed: int, number: int) -> Version:
    """The version of a number."""
    generator = np.random.default_rng([seed, number])
    return draw_version(generator, load(source))


@lru_cache(maxsize=1)
def load(source: Source) -> tuple[Session, Session]:
    """The first session without its first third, the second without its last; kept."""
    if source.data is None:
        first, second = _simulated(source)
    else:
        first, second = (read_session(source.data, name, source.horizon) for name in source.names)
    cuts = [len(lie.parameters(session.truth)) // 3 for session in (first, second)]
    return portion(first, slice(cuts[0], None)), portion(second, slice(0, -cuts[1]))


def _simulated(source: Source) -> list[Session]:
    """Sessions of which only odometry and truth are taken, as of NCLT's."""
    world = simulate_sessions(poses=source.poses, inliers=0, aliased_groups=0, random=0)
    sessions = []
    for name, one, truth in zip(source.names, world.graph.maps, world.truth, strict=True):
        odometry = lie.as_numpy(one.poses)
        sigmas = drift_sigmas(odometry, truth, source.horizon)
        covariance = np.repeat(np.diag(sigmas**2)[None], source.poses - 1, axis=0)
        sessions.append(Session(name, odometry, truth, covariance, sigmas, {}))
    return sessions


def summarised(versions: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Means over the versions, their roots, and the median ATE: wrong merges decide the means."""
    many = list(versions)
    summary = means_by_method(many)
    for name, row in summary.items():
        for kind in ("map", "step"):
            row[f"{kind}_translation_rmse"] = row[f"{kind}_translation_mse"] ** 0.5
        errors = [each["methods"][name]["ate_rmse"] for each in many]
        row["ate_median"] = float(np.median(errors))
    return summary


def draw_figures(out: Path, source: Source, seed: int) -> None:
    """Fig. 6 (candidates where they truly are) and Fig. 7 (maps by method), both of version 0."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    from pcm_jax.plots import plot_comparison, plot_trajectories_with_closures

    version = draw(source, seed, 0)
    graph, _ = _optimised(version.graph)
    results = _compared(graph, version, SHOWN)
    closures, names = graph.closures, source.names
    chosen: Any = {"accepted": results["pcm-exact-99"].accepted, "is_true": version.is_true}
    figure, ax = pyplot.subplots(figsize=(7.0, 6.4), dpi=110, layout="constrained")
    plot_trajectories_with_closures(version.truth, closures, names=names, **chosen, ax=ax)
    ax.set_title(f"Candidates, and what PCM (99 %) accepts\n{_credit(source)}", fontsize="medium")
    figure.savefig(out / "fig6.png")
    panels = {"ground truth": (version.truth, None)}
    panels |= {name: (each.maps, each.accepted) for name, each in results.items()}
    figure = pyplot.figure(figsize=(12.0, 8.6), dpi=66, layout="constrained")
    axes = list(figure.subplots(2, 4).ravel())
    plot_comparison(panels, closures, is_true=version.is_true, names=names, axes=axes)
    axes[4].set_ylabel(axes[0].get_ylabel())
    axes[4].tick_params(labelleft=True)
    figure.suptitle(_credit(source), fontsize="medium")
    figure.savefig(out / "fig7.png")
    pyplot.close("all")


def _optimised(graph: MultiRobotGraph) -> tuple[MultiRobotGraph, Any]:
    """The graph with its maps at their optima, and Q squared."""
    selection = select(graph, method="ransac")  # any method computes both; this is the cheapest
    (pair,) = selection.pairs
    return MultiRobotGraph(selection.maps, graph.closures), np.asarray(pair.squared)


def _compared(
    graph: MultiRobotGraph, version: Version, methods: Iterable[str]
) -> dict[str, Compared]:
    rows = {name: METHODS[name] for name in methods}
    return compare_methods(graph, version.is_true, version.truth, methods=rows, optimized=True)


def _finite(figures: Mapping[str, float]) -> dict[str, float]:
    """Without NaN: the normalised chi-squared of maps that nothing can contradict is 0."""
    return {name: 0.0 if np.isnan(value) else value for name, value in figures.items()}


def _counts(kinds: Mapping[str, int]) -> dict[str, float]:
    accepted = {f"accepted_{kind}": float(count) for kind, count in kinds.items()}
    wrong = sum(accepted.values()) - accepted["accepted_true"] - accepted["accepted_poor"]
    return accepted | {"accepted_false": wrong}


def _inside(squared: np.ndarray, is_true: np.ndarray) -> dict[str, float]:
    """Fraction of the pairs of right closures inside gates: the gate's own where calibrated."""
    right = np.maximum(squared, squared.T)[np.ix_(is_true, is_true)]
    pairs = right[np.triu_indices(len(right), 1)]
    return {
        f"{confidence:g}": float(np.mean(pairs <= float(chi2_gate(confidence, 6))))
        for confidence in GATES
    }


def _about(source: Source) -> dict[str, Any]:
    """Facts about what was read, and the noise of its odometry."""
    stand_in = None if source.data else "simulated sessions: NCLT's files are absent"
    entries: dict[str, Any] = {"stand_in": stand_in, "horizon": source.horizon}
    for name, session in zip(source.names, load(source), strict=True):
        poses = session.odometry, session.truth
        entries[name] = session.about | {
            "keyframes kept": len(lie.parameters(session.truth)),
            "sigmas": dict(zip(("x", "y", "z", "rx", "ry", "rz"), session.sigmas, strict=True)),
            "median squared distance over its expectation, by keyframes": {
                f"{count}": excess(*poses, session.sigmas, count) for count in WINDOWS
            },
        }
    first, second = (session.truth for session in load(source))
    apart = lie.translation(lie.take(first, 0)) - lie.translation(lie.take(second, 0))
    return entries | {
        "metres between the first poses": float(np.linalg.norm(apart)),
        "candidates": number_of_candidates(first),
        "candidates near the other session": len(neighbours(first, second)[0]),
    }


def _mean_calibration(versions: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    many = list(versions)
    inside, maps = ([each[key] for each in many] for key in ("calibration", "maps"))
    return {
        "pairs of right closures inside the gate": {
            gate: float(np.mean([each[gate] for each in inside])) for gate in inside[0]
        },
        "maps": {
            name: {key: float(np.mean([each[name][key] for each in maps])) for key in first}
            for name, first in maps[0].items()
        },
    }


def _caption(source: Source, versions: int) -> str:
    if source.data is None:
        return (
            "Table II on two **simulated sessions** that stand in for NCLT's; means over "
            f"{versions} versions."
        )
    return (
        "Table II on a **substitute** for the paper's data: odometry and ground truth of NCLT's "
        f"{' and '.join(source.names)} (ODbL 1.0, DbCL 1.0), simulated registrations; means over "
        f"{versions} versions."
    )


def _credit(source: Source) -> str:
    if source.data is None:
        return "simulated sessions"
    return "substitute: odometry and truth NCLT (ODbL 1.0, DbCL 1.0), registrations simulated"


def _source(parser: argparse.ArgumentParser, options: argparse.Namespace) -> Source:
    names = tuple(options.sessions)
    if options.simulated or (options.data is None and not NCLT.is_dir()):
        return Source(None, ("a", "b"), options.horizon, options.poses)
    data = options.data or NCLT
    try:
        for name in names:
            for kind in ("gt", "odom"):
                find(data, name, kind)
    except InputError as error:
        parser.error(f"--data: {error}")
    return Source(data, names, options.horizon, 0)


def _sources() -> list[Path]:
    here = Path(__file__)
    return [*LIBRARY, here, here.parent / "experiments"]


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("sessions", __doc__)
    parser.add_argument(
        "--data", type=Path, help="NCLT's folder (default: beside the checkout, else simulated)"
    )
    parser.add_argument(
        "--sessions", nargs=2, default=list(SESSIONS), metavar="NAME", help="of NCLT's files"
    )
    parser.add_argument("--simulated", action="store_true", help="sessions that need no file")
    parser.add_argument("--poses", type=int, default=750, help="of each simulated session")
    parser.add_argument("--versions", type=int, default=10, help="of each seed")
    parser.add_argument("--methods", nargs="+", choices=METHODS, metavar="NAME", help="rows")
    parser.add_argument(
        "--horizon", type=int, default=HORIZON, help="keyframes, for the odometry's noise"
    )
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
