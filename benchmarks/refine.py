"""Merges before and after they are refined: what recall brings back, and what is let in.

    python -m benchmarks.refine --out DIR [--studies csail size city places] [--worlds 5]

Rows: PCM alone; PCM, then graduated non-convexity from there (`merge(refine="gnc")` without its
recall, in `csail`); that with recall; PCM with recall alone; graduated non-convexity alone, from
where the medoid of the closures puts the maps; everything accepted; and the true closures alone.

csail    CSAIL cut in three pieces, after "Robust loop closure selection based on inter-robot and
         intra-robot consistency for multi-robot map fusion" (Remote Sens. 2023, 15, 2796), whose
         trajectory errors for PCM alone at three noise levels are .64, 2.10 and 4.21 m, and with
         its refinement .42, .84 and 1.58 m. Its cuts, noise and false closures are not known here.
         Assumed: cuts at poses 300 and 850, so that any two pieces share closures (12, 67, 18) and
         each has loops (13, 16, 2); the truth is the optimum of the file; all measurements are
         drawn anew, with the noise that the file's residuals show (its chi-squared is a tenth of
         what it states); odometry with more, "stated" in its covariance or not ("unstated"); false
         closures between any two pieces: two aliased groups of 5, and 30 random.
size     the share of right closures that the largest clique keeps, and recall after it, against
         how many there are and the gate: closures drawn from all of City10000, calibrated, cut in
         half, with the false ones of the paper's experiment. Each clique search has a minute; of
         more than 1,000 by the 99 % gate alone.
city     Table I's versions (`benchmarks.city`, information taken for its square root).
places   KITTI 00 and Bicocca 25b cut in two, maps of odometry (`benchmarks.place_recognition`).

In `csail` and `city` two closures that agree join two robots, as in the papers; elsewhere the
default rule decides. Errors (ATE, m) are root mean squares, each group of joined robots moved by
the rigid motion that is best for it; `parts` says in how many they are.

Writes summary.json ({cell: {row: means}}), worlds.csv, table.md, recall.png and run.json.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import place_recognition
from benchmarks.experiments.command import command_parser, run_tasks, write_run
from benchmarks.experiments.record import LIBRARY, write_csv
from benchmarks.suite.harness import DATA
from pcm_jax import (
    ConvergenceWarning,
    InputWarning,
    MultiRobotGraph,
    PoseGraph,
    lie,
    merge,
    optimize,
    read_graph,
    select,
    split,
    weigh,
)
from pcm_jax.arrays import on_host
from pcm_jax.evaluation import ate_rmse, comparison_table
from pcm_jax.experiments import drives
from pcm_jax.experiments.cities import NOISE, City, Law, city_of_file, version_of
from pcm_jax.merging import MergeResult
from pcm_jax.merging.merged import Merged
from pcm_jax.merging.refine import refine
from pcm_jax.plots import style
from pcm_jax.simulation import SimulatedWorld, add_clutter
from pcm_jax.store import Store, digest, write_json

BARS = (*style.SERIES[:5], style.GREY, style.BLACK)
LEGEND: dict[str, Any] = {"fontsize": "small", "ncols": 3, "frameon": False}
STUDIES = ("csail", "size", "city", "places")
CUTS = (300, 850)
LEVELS = {"low": (0.02, 0.005), "middle": (0.05, 0.01), "high": (0.1, 0.02)}
"""Standard deviations that odometry's noise has besides: m along x and y, rad, a step."""
SIZES = (30, 100, 300, 1000, 3000, 4826)
GATES = (0.9, 0.99, 0.999)
PLACES = ("kitti_00_alpha_0.00", "B25b_0.000")
LIMIT = 60.0  # seconds of a clique search
COLUMNS = {
    "worlds": "worlds",
    "tpr": "TPR, %",
    "false": "false accepted",
    "loops": "loops dropped",
    "ate": "ATE, m",
    "parts": "parts",
    "seconds": "s",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command."""
    parser = command_parser("refine", __doc__)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of public files")
    parser.add_argument("--studies", nargs="+", choices=STUDIES, default=list(STUDIES))
    parser.add_argument("--worlds", type=int, default=5, help="of each cell that is drawn")
    parser.add_argument("--cuts", type=int, default=7, help="of each trajectory of `places`")
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES), metavar="N")
    options = parser.parse_args(arguments)
    start = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    steps = Store(options.out / "steps", digest(files=[*LIBRARY, Path(__file__)]))
    tasks = {
        name: task
        for study in options.studies
        for seed in options.seeds
        for name, task in TASKS[study](options, seed).items()
    }
    runs = run_tasks("worlds", tasks, steps, jobs=options.jobs)
    write_results(options.out, runs)
    write_run(options.out, options, start)
    print(f"{(options.out / 'table.md').read_text()}\nwrote {options.out / 'summary.json'}")
    return 0


class World(NamedTuple):
    """A world to be merged.

    Attributes:
        graph: maps and candidates.
        is_true: bool `[m]`.
        truth: true poses of each robot.
        minimum: see `merge(minimum_inliers=)`.
        in_steps: whether graduated non-convexity is judged before recall, too.
    """

    graph: MultiRobotGraph
    is_true: np.ndarray
    truth: Sequence[Any]
    minimum: int | str = 2
    in_steps: bool = False


def judge(make: Callable[[], World]) -> dict[str, Any]:
    """Merges a world in every way: figures by row."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        warnings.simplefilter("ignore", InputWarning)
        return {"methods": judged(make())}


@on_host
def judged(world: World) -> dict[str, dict[str, float]]:
    """Figures by row."""
    evidence, rows = weigh(world.graph), {}
    own = MultiRobotGraph(evidence.maps, world.graph.closures)
    how: dict[str, Any] = {"minimum_inliers": world.minimum}

    def row(name: str, made: Callable[[], MergeResult]) -> MergeResult:
        start = time.perf_counter()
        result = made()
        rows[name] = figures(world, result) | {"seconds": time.perf_counter() - start}
        return result

    before = row("PCM", lambda: merge(evidence, **how))
    if world.in_steps:
        start = time.perf_counter()
        there = Merged(before.graph.maps, before.anchors, before.solution, before.groups)
        alone = refine(own, there, before.accepted, mode="gnc", confidence=0.99, recalling=False)
        seconds = rows["PCM"]["seconds"] + time.perf_counter() - start
        maps, lost = alone.graph.maps, alone.refinement.loops_dropped
        rows["PCM + GNC"] = _figures(world, alone.accepted, maps, before.groups, lost)
        rows["PCM + GNC"]["seconds"] = seconds
    row("PCM + GNC + recall", lambda: merge(evidence, refine="gnc", **how))
    row("PCM + recall", lambda: merge(evidence, refine="recall", **how))
    row("GNC alone", lambda: merge(own, method="gnc", initial="closures", optimized=True))
    row("everything", lambda: merge(own, method="all", optimized=True))
    row("true closures", lambda: merge(own, accepted=world.is_true, optimized=True))
    return rows


def figures(world: World, result: MergeResult) -> dict[str, float]:
    """The figures of a merge."""
    lost = result.refinement.loops_dropped if result.refinement else 0
    return _figures(world, result.accepted, result.graph.maps, result.groups, lost)


def _figures(
    world: World, accepted: np.ndarray, maps: Sequence[PoseGraph], groups: Any, lost: int
) -> dict[str, float]:
    squared = 0.0
    for members in groups:
        parts = [maps[robot] for robot in members], [world.truth[robot] for robot in members]
        error = float(ate_rmse(*parts, align="umeyama"))
        squared += error**2 * sum(one.num_poses for one in parts[0])
    right = int(world.is_true.sum())
    return {
        "tpr": 100.0 * float((accepted & world.is_true).sum()) / max(1, right),
        "false": float((accepted & ~world.is_true).sum()),
        "loops": float(lost),
        "ate": math.sqrt(squared / sum(one.num_poses for one in maps)),
        "parts": float(len(groups)),
    }


def csail_tasks(options: Any, seed: int) -> dict[str, Any]:
    """One task a world."""
    return {
        f"csail, {level}, {kind} #{seed}-{number}": partial(
            judge, partial(csail_world, options.data, level, kind == "stated", (seed, number))
        )
        for level in LEVELS
        for kind in ("stated", "unstated")
        for number in range(options.worlds)
    }


def csail_world(data: Path, level: str, stated: bool, seed: tuple[int, int]) -> World:
    """CSAIL in three pieces, all its measurements drawn anew."""
    generator = np.random.default_rng(seed)
    (graph,) = read_graph(data / "classic2d" / "CSAIL.g2o.xz").maps
    best = optimize(graph)
    truth, steps = lie.as_numpy(best.graph.poses), drives.steps(graph)
    freedom = 3 * (graph.num_edges - graph.num_poses + 1)
    known = np.linalg.inv(np.asarray(graph.information)) * 2.0 * best.cost / freedom
    metres, radians = LEVELS[level]
    more = np.diag([metres, metres, radians]) ** 2
    covariance = np.where(steps[:, None, None], known + more, known)
    drawn = np.linalg.cholesky(covariance) @ generator.normal(size=(len(known), 3, 1))
    tangents: Any = drawn[..., 0]
    exact = lie.between(*(lie.take(truth, np.asarray(end)) for end in (graph.tail, graph.head)))
    whole = PoseGraph.from_arrays(
        tail=graph.tail,
        head=graph.head,
        measurement=lie.compose(exact, lie.exp(lie.group_of(truth), tangents)),
        covariance=covariance if stated else known,
        name="csail",
    )
    pieces = split(whole, list(CUTS))
    closures = pieces.closures
    ends = np.cumsum([0, *(one.num_poses for one in pieces.maps)])
    poses = ends[closures.robot_a] + closures.pose_a, ends[closures.robot_b] + closures.pose_b
    loops = MultiRobotGraph(pieces.maps, closures[np.abs(poses[0] - poses[1]) > 1])
    parts = [lie.take(truth, slice(a, b)) for a, b in pairwise(ends)]
    usual = np.median(np.linalg.inv(known[~steps]), axis=0)
    world = add_clutter(loops, parts, seed=generator, inliers=None, random=30, information=usual)
    return World(world.graph, world.is_true, parts, in_steps=True)


def city_tasks(options: Any, seed: int) -> dict[str, Any]:
    """One task a version of Table I."""
    portion = (options.data / "city10000", 2_000)
    return {
        f"city, Table I #{seed}-{number}": partial(judge, partial(version, *portion, seed, number))
        for number in range(options.worlds)
    }


def version(folder: Path, poses: int, seed: int, number: int) -> World:
    """A version of Table I."""
    world = version_of(city(folder, poses), Law(), seed, number)
    return World(world.graph, world.is_true, world.truth)


@lru_cache(maxsize=1)
def city(folder: Path, poses: int | None) -> City:
    """City10000's halves, calibrated; the last one is kept."""
    data = folder / "city10000.g2o.xz"
    truth = folder / "city10000_groundtruth.isam.txt.xz"
    return city_of_file(data, truth, slice(0, poses), "sqrt")


def places_tasks(options: Any, seed: int) -> dict[str, Any]:
    """One task a cut of each trajectory."""
    if seed != options.seeds[0]:
        return {}
    return {
        f"places, {name} #{number}": partial(
            judge, partial(sessions, options.data, name, number + 1, options.cuts + 1)
        )
        for name in PLACES
        for number in range(options.cuts)
    }


def sessions(data: Path, name: str, number: int, of: int) -> World:
    """Two sessions of a drive, maps of odometry."""
    candidates = place_recognition.load(data, name)
    cut = candidates.graph.num_poses * number // of
    right = candidates.is_true[place_recognition.across(candidates.graph, cut)]
    graph = place_recognition.sessions(candidates.graph, cut, "odometry")
    return World(graph, right, place_recognition.sessions_truth(candidates, cut), "chance")


def size_tasks(options: Any, seed: int) -> dict[str, Any]:
    """One task a size and gate."""
    folder = options.data / "city10000"
    return {
        f"size, {size} right, gate {gate:g} #{seed}": partial(kept, folder, size, gate, seed)
        for size in options.sizes
        for gate in GATES
        if size <= 1000 or gate == 0.99
    }


def kept(folder: Path, size: int, gate: float, seed: int) -> dict[str, Any]:
    """Figures of the clique and of recall among so many right closures."""
    whole = city(folder, None)
    world: SimulatedWorld = add_clutter(
        whole.graph, whole.truth, seed=seed, inliers=size, covariance=NOISE
    )
    evidence, rows = weigh(world.graph, optimized=True), {}
    start = time.perf_counter()
    found = select(evidence, confidence=gate, minimum_inliers=2, time_limit=LIMIT)
    seconds = time.perf_counter() - start
    here = World(world.graph, world.is_true, world.truth)
    graph = MultiRobotGraph(evidence.maps, world.graph.closures)
    for name, mode in {"PCM": None, "PCM + recall": "recall"}.items():
        how: dict[str, Any] = {"refine": mode, "confidence": gate} if mode else {}
        start = time.perf_counter()
        result = merge(graph, accepted=found.accepted, optimized=True, **how)
        rows[name] = figures(here, result)
        rows[name]["seconds"] = time.perf_counter() - start + seconds
        seconds = 0.0 if mode is None else seconds
    return {"methods": rows}


TASKS: dict[str, Callable[[Any, int], dict[str, Any]]] = {
    "csail": csail_tasks,
    "size": size_tasks,
    "city": city_tasks,
    "places": places_tasks,
}


def write_results(out: Path, runs: Mapping[str, Mapping[str, Any]]) -> None:
    """summary.json, worlds.csv, table.md and recall.png."""
    cells: dict[str, list[Mapping[str, Any]]] = {}
    for name, run in runs.items():
        cells.setdefault(name.partition(" #")[0], []).append(run["methods"])
    summary = {
        cell: {
            row: {"worlds": float(len(worlds))}
            | {key: float(np.mean([one[row][key] for one in worlds])) for key in worlds[0][row]}
            for row in worlds[0]
        }
        for cell, worlds in cells.items()
    }
    write_json(out / "summary.json", summary)
    rows = [
        {"cell": name.partition(" #")[0], "world": name.partition(" #")[2], "row": row, **each}
        for name, run in runs.items()
        for row, each in run["methods"].items()
    ]
    write_csv(out / "worlds.csv", rows)
    table = {
        f"{cell}: {row}": own for cell, all_rows in summary.items() for row, own in all_rows.items()
    }
    (out / "table.md").write_text(comparison_table(table, COLUMNS) + "\n")
    draw(out / "recall.png", summary)


def draw(path: Path, summary: Mapping[str, Mapping[str, Mapping[str, float]]]) -> None:
    """Recall against the number of right closures, and errors against noise."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    colors = style.BLUE, style.ORANGE, style.GREEN
    for color, gate in zip(colors, GATES, strict=True):
        for name, look in {"PCM": "o-", "PCM + recall": "s--"}.items():
            points = [
                (int(cell.split()[1]), rows[name]["tpr"])
                for cell, rows in summary.items()
                if cell.startswith("size") and cell.endswith(f"gate {gate:g}")
            ]
            if points:
                label = f"{name}, {gate:g}"
                left.plot(*zip(*points, strict=True), look, color=color, label=label)
    left.set(
        xscale="log", xlabel="right closures", ylabel="accepted, %", title="City10000, calibrated"
    )
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower left", **LEGEND)
    cells = [f"csail, {level}, unstated" for level in LEVELS]
    cells = [cell for cell in cells if cell in summary]
    for k, name in enumerate(summary[cells[0]] if cells else ()):
        values = [summary[cell][name]["ate"] for cell in cells]
        right.bar(
            np.arange(len(cells)) + 0.11 * k, values, 0.1, label=name, color=BARS[k % len(BARS)]
        )
    right.set_xticks(np.arange(len(cells)) + 0.33, [cell.split(", ")[1] for cell in cells])
    right.set(xlabel="noise of odometry besides", ylabel="ATE, m", yscale="log")
    right.set_title("CSAIL in three pieces, noise not stated")
    figure.legend(*right.get_legend_handles_labels(), loc="outside lower right", **LEGEND)
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    raise SystemExit(main())
