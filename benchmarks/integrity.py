"""Merges of robots that never met, and of robots that did, by the rule that says when to believe.

    python -m benchmarks.integrity --out DIR [--worlds 300] [--groups SE2 SE3] [--closures 20 100]

Two simulated robots; of m candidates t are right, the others false by one of three laws: "uniform",
the other robot stands anywhere in the common bounding box; "near", within 10 m of the first;
"identity", both at the same spot, to the closures' noise. Odometry drifts as the simulator's or
some times as much; maps are closed by loops of their own, or odometry alone. With `--aliased G`
one group of G of the false closures agrees within itself (`simulation.outliers`): anywhere the two
maps meet by their alignment, or with `--where "one place"` within eight poses of each other.

Rules: "2", "3", "5": so many closures suffice; "chance": the set has to stand out from chance
(`integrity.chance`), every closure a witness; "places": closures beside each other are one witness
(`integrity.places`); "default": and must have no rival about as good (`integrity.rivals`).
A world counts as *merged wrongly* if most of the accepted closures are false, as *found* if most
are right. Bounds are Clopper and Pearson's, one-sided, 99 %.

Writes summary.json ({cell: {rule: figures}}), cells.csv, table.md, rates.png (means over groups,
laws, drifts and loops) and run.json.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import beta

from benchmarks.experiments.command import command_parser, finish, run_tasks
from benchmarks.experiments.record import LIBRARY, write_csv
from pcm_jax import MultiRobotGraph, PoseGraph, lie, select, weigh
from pcm_jax.arrays import on_host
from pcm_jax.integrity import Verdict
from pcm_jax.plots import style
from pcm_jax.simulation import simulate_city, simulate_sessions
from pcm_jax.simulation.measurements import measure
from pcm_jax.store import Store, digest

SOURCES = (*LIBRARY, Path(__file__))
LAWS = ("uniform", "near", "identity")
WHERE = ("spread", "one place")
FIXED = (2, 3, 5)
STRETCH = 8
"""Poses of either robot among which an aliased group in one place lies."""
BARS = (style.GREY, style.SKY, style.PINK, style.ORANGE, style.GREEN, style.BLUE)
POSES = 200
NEAR = 10.0
NOISE = {
    "SE2": {"sigma_translation": 0.02, "sigma_rotation": 0.002},
    "SE3": {"sigma_translation": 0.05, "sigma_rotation": 0.005},
}
COLUMNS = {
    "worlds": "worlds",
    "wrong": "merged wrongly, %",
    "wrong_bound": "at most, %",
    "right": "found, %",
    "milliseconds": "ms a world",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command."""
    parser = command_parser("integrity", __doc__)
    parser.add_argument("--worlds", type=int, default=300, metavar="N", help="in a cell")
    parser.add_argument("--groups", nargs="+", default=["SE2", "SE3"], choices=["SE2", "SE3"])
    parser.add_argument("--closures", type=int, nargs="+", default=[20, 50, 100, 200, 500])
    parser.add_argument("--right", type=int, nargs="+", default=[0, 3, 5], metavar="T")
    parser.add_argument("--aliased", type=int, nargs="+", default=[0], metavar="G")
    parser.add_argument("--where", nargs="+", default=["spread"], choices=WHERE)
    parser.add_argument("--laws", nargs="+", default=list(LAWS), choices=LAWS)
    parser.add_argument("--drifts", type=float, nargs="+", default=[1.0, 4.0], metavar="X")
    parser.add_argument("--loops", nargs="+", default=["loops", "odometry"])
    options = parser.parse_args(arguments)
    start = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    steps = Store(options.out / "steps", digest(options.worlds, options.seeds, files=SOURCES))
    cells = itertools.starmap(
        Cell,
        itertools.product(
            options.groups,
            options.closures,
            options.right,
            options.aliased,
            options.where,
            options.laws,
            options.drifts,
            options.loops,
        ),
    )
    tasks = {
        cell.name: partial(rates_of, cell, worlds=options.worlds, seed=options.seeds[0])
        for cell in cells
        if cell.count >= cell.right + cell.aliased
    }
    found = run_tasks("cells", tasks, steps, jobs=options.jobs)
    rows = {f"{cell}, {rule}": own for cell, rules in found.items() for rule, own in rules.items()}
    write_tables(options.out, found)
    return finish(options, start, found, rows, COLUMNS)


class Cell(NamedTuple):
    """One law of worlds.

    Attributes:
        group: "SE2" or "SE3".
        count: candidates.
        right: right ones among them.
        aliased: false ones that agree within themselves.
        where: "spread", or "one place".
        law: of the other false ones.
        drift: times the simulator's odometry noise.
        loops: "loops", or "odometry": maps without loops.
    """

    group: str
    count: int
    right: int
    aliased: int
    where: str
    law: str
    drift: float
    loops: str

    @property
    def name(self) -> str:
        """The cell in words."""
        groups = f", {self.aliased} aliased {self.where}" if self.aliased else ""
        return (
            f"{self.group}, {self.right} of {self.count} right{groups}, {self.law}, "
            f"drift {self.drift:g}, {self.loops}"
        )


def rates_of(cell: Cell, *, worlds: int, seed: int) -> dict[str, dict[str, float]]:
    """The rates of every rule over many worlds of one law."""
    outcomes: dict[str, list[tuple[bool, bool, float]]] = {}
    for number in range(worlds):
        graph, is_true = world_of(cell, (seed, number))
        for rule, (accepted, seconds) in decisions(graph).items():
            kept = int(accepted.sum())
            true = int((accepted & is_true).sum())
            outcome = (kept > 0 and 2 * true < kept, 2 * true >= max(1, kept), seconds)
            outcomes.setdefault(rule, []).append(outcome)
    return {rule: rates(np.array(own, float)) for rule, own in outcomes.items()}


@on_host
def decisions(graph: MultiRobotGraph) -> dict[str, tuple[np.ndarray, float]]:
    """Decides by every rule: masks, and the seconds that the last three take besides."""
    evidence = weigh(graph)
    nothing = np.zeros(len(graph.closures), bool)
    by_number = select(evidence, minimum_inliers=2)
    most = by_number.pairs[0].found
    found = {str(k): (by_number.accepted if most >= k else nothing, 0.0) for k in FIXED}
    for rule, separation in (("chance", 0.0), ("places", None)):
        start = time.perf_counter()
        judged = select(evidence, separation=separation, on_ambiguous="largest", prefer="closures")
        found[rule] = judged.accepted, time.perf_counter() - start
    verdict: Verdict = judged.pairs[0].verdict
    found["default"] = (nothing if verdict.ambiguous else judged.accepted), found["places"][1]
    return found


def world_of(cell: Cell, seed: tuple[int, int]) -> tuple[MultiRobotGraph, np.ndarray]:
    """Two robots and their candidates, and which of these are right."""
    simulate: Any = simulate_city if cell.group == "SE2" else simulate_sessions
    world = simulate(
        seed=seed[0] * 1_000_000 + seed[1],
        poses=POSES,
        inliers=cell.right,
        aliased_groups=1 if cell.aliased else 0,
        aliased_size=max(1, cell.aliased),
        random=cell.count - cell.right - cell.aliased,
        random_range=NEAR if cell.law == "near" else None,
        **{kind: cell.drift * sigma for kind, sigma in NOISE[cell.group].items()},
    )
    closures = world.graph.closures
    if cell.law == "identity":
        closures = _at_the_same_spot(closures, world.labels < 0, np.random.default_rng(seed))
    if cell.aliased and cell.where == "one place":
        aliased = np.flatnonzero(world.labels > 0)
        closures = _in_one_place(closures, aliased, world.truth, np.random.default_rng(seed))
    maps = world.graph.maps
    if cell.loops == "odometry":
        maps = tuple(_odometry(one) for one in maps)
    return MultiRobotGraph(maps, closures), world.is_true


def _at_the_same_spot(closures: Any, false: np.ndarray, generator: np.random.Generator) -> Any:
    """False closures that say that both robots stand at the same spot."""
    root = np.linalg.cholesky(np.linalg.inv(np.asarray(closures.information)))
    drawn = generator.normal(size=(len(closures), root.shape[-1], 1))
    tangents: Any = (root @ drawn)[..., 0]
    here = lie.exp(closures.group, tangents)
    values = np.where(
        false[:, None],
        lie.parameters(lie.as_numpy(here)),
        lie.parameters(lie.as_numpy(closures.measurement)),
    )
    return dataclasses.replace(closures, measurement=closures.group(values))


def _in_one_place(
    closures: Any, aliased: np.ndarray, truth: Any, generator: np.random.Generator
) -> Any:
    """The aliased closures moved to poses near those of the first of them.

    Each says of its poses what the first one's alignment does, with noise as stated.
    """
    first = np.full(len(aliased), aliased[0])
    pose_a, pose_b = np.array(closures.pose_a), np.array(closures.pose_b)
    values = np.array(lie.parameters(lie.as_numpy(closures.measurement)))
    truth_a, truth_b = (lie.as_numpy(one) for one in truth)
    alignment = lie.compose(
        lie.compose(lie.take(truth_a, pose_a[first]), closures.group(values[first])),
        lie.inverse(lie.take(truth_b, pose_b[first])),
    )
    for poses in (pose_a, pose_b):
        low = np.clip(poses[first[0]] - STRETCH // 2, 0, POSES - STRETCH)
        poses[aliased] = low + generator.permutation(STRETCH)[: len(aliased)]
    exact = lie.between(
        lie.take(truth_a, pose_a[aliased]),
        lie.compose(alignment, lie.take(truth_b, pose_b[aliased])),
    )
    covariance = np.linalg.inv(np.asarray(closures.information))[aliased]
    values[aliased] = lie.parameters(lie.as_numpy(measure(generator, exact, covariance)))
    return dataclasses.replace(
        closures, pose_a=pose_a, pose_b=pose_b, measurement=closures.group(values)
    )


def _odometry(one: PoseGraph) -> PoseGraph:
    return one.with_edges(np.asarray(one.head) - np.asarray(one.tail) == 1)


def write_tables(out: Path, found: Mapping[str, Mapping[str, Mapping[str, float]]]) -> None:
    """cells.csv and rates.png, of {cell: {rule: figures}}."""
    rows = [
        {"cell": cell, "rule": rule, **own}
        for cell, rules in found.items()
        for rule, own in rules.items()
    ]
    write_csv(out / "cells.csv", rows)
    draw(out / "rates.png", found)


def draw(path: Path, found: Mapping[str, Mapping[str, Mapping[str, float]]]) -> None:
    """Bars by rule: how often worlds are merged wrongly, and found where closures are right."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    kinds: dict[str, list[Mapping[str, Mapping[str, float]]]] = {}
    for cell, rules in found.items():
        kinds.setdefault(_kind(cell), []).append(rules)
    panels = {"wrong": "merged wrongly, %"}
    if any(not kind.startswith("0 of") for kind in kinds):
        panels["right"] = "found, %"
    size = 1.2 + max(len(kinds), 4) * len(panels), 3.8
    figure, axes = plt.subplots(1, len(panels), figsize=size, layout="constrained", squeeze=False)
    names = list(next(iter(found.values())))
    for ax, (figure_name, label) in zip(axes[0], panels.items(), strict=True):
        for k, rule in enumerate(names):
            means = [
                np.mean([rules[rule][figure_name] for rules in cells]) for cells in kinds.values()
            ]
            place = np.arange(len(kinds)) + 0.14 * (k - 0.5 * (len(names) - 1))
            ax.bar(place, means, 0.13, color=BARS[k], label=rule)
        ax.set_xticks(np.arange(len(kinds)), list(kinds), fontsize="small")
        ax.set_ylabel(label)
    handles = axes[0, 0].get_legend_handles_labels()
    look: dict[str, Any] = {"ncols": 3 * len(panels), "frameon": False, "fontsize": "small"}
    figure.legend(*handles, loc="outside lower center", title="rule", **look)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _kind(cell: str) -> str:
    """The closures of a cell, by its name: right ones of how many, and aliased ones; on lines."""
    _, right, aliased, *_ = cell.split(", ")
    if "aliased" not in aliased:
        return right
    return "\n".join([right, *aliased.replace("aliased ", "aliased,").split(",")])


def rates(outcomes: np.ndarray) -> dict[str, float]:
    """Percentages of worlds (wrong, found, seconds)."""
    worlds = len(outcomes)
    wrong, right = outcomes[:, :2].sum(axis=0)
    bound = 1.0 if wrong == worlds else float(beta.ppf(0.99, wrong + 1, worlds - wrong))
    return {
        "worlds": worlds,
        "wrong": 100.0 * wrong / worlds,
        "wrong_bound": 100.0 * bound,
        "right": 100.0 * right / worlds,
        "milliseconds": 1e3 * float(np.median(outcomes[:, 2])),
    }


if __name__ == "__main__":
    raise SystemExit(main())
