"""Labelled multi-robot sets in JRL, as COSMO-Bench publishes them: what is believed, and the error.

    python -m benchmarks.cosmo --data DIR --out DIR [--methods NAME...]

Every `.jrl` (`.gz` and `.xz` too) below the folder is read with its labels and true poses, and
merged by each method from the same optimised maps. Rates are over the closures between robots; a
set without labels has none. The error of the trajectories (ATE) is the root mean square distance in
metres, every group of joined robots moved by the rigid motion that is best for it (Umeyama): read
it together with `parts`, in how many frames the robots end.

Writes summary.json ({set: {method: figures}}), sets.csv, table.md and run.json.
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.experiments.command import command_parser, run_tasks, write_run
from benchmarks.experiments.record import LIBRARY, write_csv
from pcm_jax import ConvergenceWarning, InputWarning, MultiRobotGraph, merge, read_graph, weigh
from pcm_jax.evaluation import ate_rmse, false_positive_rate, true_positive_rate
from pcm_jax.merging import MergeResult
from pcm_jax.store import Store, digest, write_json
from pcm_jax.tables import markdown

METHODS: dict[str, dict[str, Any]] = {
    "pcm-exact-99": {"method": "pcm-exact"},
    "gnc": {"method": "gnc", "initial": "closures"},
    "everything": {"method": "all"},
}
"""Rows, and what `merge` is asked for each."""
ROBUST = ("gnc",)
SUFFIXES = (".jrl", ".jrl.gz", ".jrl.xz")
FIGURES = ("tpr", "fpr", "ate_rmse", "parts", "accepted", "closures", "converged", "seconds")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = _parser()
    options = parser.parse_args(arguments)
    start, files = time.perf_counter(), found(options.data)
    if not files:
        parser.error(f"--data: no .jrl file in {options.data}, expected at least one")
    options.out.mkdir(parents=True, exist_ok=True)
    sources = [*LIBRARY, Path(__file__)]
    steps = Store(options.out / "steps", digest(sorted(options.methods), files=sources))
    tasks = {
        f"{name}-{digest(files=[path])}": partial(judge, path, options.methods)
        for name, path in files.items()
    }
    runs = run_tasks("sets", tasks, steps, jobs=options.jobs)
    results = dict(zip(files, (runs[task] for task in tasks), strict=True))
    write_results(options.out, results)
    write_run(options.out, options, start)
    print(f"{(options.out / 'table.md').read_text()}\nwrote {options.out / 'summary.json'}")
    return 0


def found(folder: Path) -> dict[str, Path]:
    """The sets below a folder, by their names: paths from the folder, a dash for every slash."""
    paths = (each for each in folder.rglob("*") if each.name.endswith(SUFFIXES))
    return {"-".join(each.relative_to(folder).parts): each for each in sorted(paths)}


def judge(path: Path, methods: Sequence[str]) -> dict[str, Any]:
    """Merges one set by each method: figures by method."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        warnings.simplefilter("ignore", ConvergenceWarning)  # it is a figure
        graph = read_graph(str(path))
        begun = time.perf_counter()
        evidence = weigh(graph)
        weighed = time.perf_counter() - begun
        at_optimum = MultiRobotGraph(evidence.maps, graph.closures)
        rows = {}
        for name in methods:
            start = time.perf_counter()
            if name in ROBUST:
                result, before = merge(at_optimum, optimized=True, **METHODS[name]), 0.0
            else:
                before = weighed if name.startswith("pcm") else 0.0
                result = merge(evidence, **METHODS[name])
            seconds = before + time.perf_counter() - start
            rows[name] = figures(graph, result) | {"seconds": seconds}
    return {"methods": rows}


def figures(graph: MultiRobotGraph, result: MergeResult) -> dict[str, Any]:
    """Rates and error of a merge: None where labels or true poses are not known."""
    accepted: Any = np.asarray(result.accepted)
    labels: Any = graph.closures.is_true
    rates: dict[str, Any] = {"tpr": None, "fpr": None}
    if labels is not None:
        rates = {
            "tpr": _number(true_positive_rate(accepted, labels)),
            "fpr": _number(false_positive_rate(accepted, labels)),
        }
    return {
        **rates,
        "ate_rmse": _error(graph, result),
        "parts": len(result.groups),
        "accepted": int(accepted.sum()),
        "closures": len(accepted),
        "converged": bool(result.solution.converged),
    }


def _error(graph: MultiRobotGraph, result: MergeResult) -> float | None:
    """Root mean square over the poses of robots whose true ones are known, group by group."""
    squared, count, truth = 0.0, 0, graph.truth or (None,) * len(graph.maps)
    for members in result.groups:
        known = [robot for robot in members if truth[robot] is not None]
        if known:
            maps = [result.graph.maps[robot] for robot in known]
            poses = sum(one.num_poses for one in maps)
            error = float(ate_rmse(maps, [truth[robot] for robot in known], align="umeyama"))
            squared, count = squared + poses * error**2, count + poses
    return math.sqrt(squared / count) if count else None


def _number(rate: Any) -> float | None:
    return None if math.isnan(float(rate)) else float(rate)


def write_results(out: Path, results: dict[str, dict[str, Any]]) -> None:
    """summary.json, sets.csv and table.md."""
    write_json(out / "summary.json", {name: run["methods"] for name, run in results.items()})
    rows = [
        {"set": name, "method": method, **{figure: each[figure] for figure in FIGURES}}
        for name, run in results.items()
        for method, each in run["methods"].items()
    ]
    write_csv(out / "sets.csv", rows)
    cells = [[_text(row[column]) for column in ("set", "method", *FIGURES)] for row in rows]
    numeric = [False, False] + [True] * len(FIGURES)
    head = ["set", "method", "TPR", "FPR", "ATE (m)", *FIGURES[3:-1], "seconds"]
    (out / "table.md").write_text(markdown(head, cells, numeric=numeric, aligned=True) + "\n")


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "–" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("cosmo", __doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with .jrl files in it")
    parser.add_argument(
        "--methods", nargs="+", choices=METHODS, default=list(METHODS), help="rows of the table"
    )
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
