"""Peak memory of a solve, ours and GTSAM's, each in a fresh process.

Both solve one graph from the same poses by Gauss-Newton. Two ratios are told:

    solving  above what the process held before: imports, and on our side compiled kernels, which
             the next solve needs again and which do not grow with the graph. The library's form of
             the graph, plans, factors and all temporary arrays count.
    process  of the whole processes, with imports and compilation.
"""

from __future__ import annotations

import functools
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.suite import gtsam_peer, maps
from benchmarks.suite.harness import ROOT, Case, Measured, Metric, Settings
from benchmarks.suite.optimization import ENGINES, at_chordal_poses

FIGURE = 1.5
RUNTIME = (
    "Python with JAX, SciPy, optimistix and what XLA compiled holds over 300 MB before the first"
    " solve, GTSAM's process 85 MB"
)
STORED = (
    "of cubicle's 220 MB the fronts take 55 and the factor 50, the plan 24, what factorising forms"
    " on the way 23, the edges' products 15; slots for fronts that are used again would change it"
)
REASONS = {"solving": STORED, "process": RUNTIME}


def solving(name: str, settings: Settings) -> dict[str, Measured]:
    """Memory of one solve of a graph, against GTSAM's."""
    gtsam_peer.require()
    start = at_chordal_poses(maps.read_map(name, settings))
    with tempfile.TemporaryDirectory() as folder:
        graph = Path(folder) / "graph.npz"
        np.savez(graph, **gtsam_peer.plain(start)._asdict())
        megabytes = {solver: one_solve(solver, graph) for solver in (*ENGINES, "gtsam")}
    theirs = megabytes["gtsam"]
    found = {}
    for engine in ENGINES:
        ours = megabytes[engine]
        used, peer = (each["solving"] - each["before"] for each in (ours, theirs))
        found[f"{engine}_solving"] = Measured(used / peer, f"{used:.0f} against {peer:.0f} MB")
        note = (
            f"{ours['whole']:.0f} against {theirs['whole']:.0f} MB, of which"
            f" {ours['before']:.0f} and {theirs['before']:.0f} before the solve"
        )
        found[f"{engine}_process"] = Measured(ours["whole"] / theirs["whole"], note)
    return found


def one_solve(solver: str, graph: Path) -> dict[str, float]:
    """Runs `benchmarks.suite.one_solve` by an engine of ours or by "gtsam": what it prints."""
    command = [sys.executable, "-m", "benchmarks.suite.one_solve", solver, str(graph)]
    done = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    return json.loads(done.stdout)


def _case(name: str) -> Case:
    metrics = [
        Metric(f"{engine}_{what}", "×", figure=FIGURE, reason=REASONS[what])
        for engine in ENGINES
        for what in REASONS
    ]
    return Case(f"memory/{name}", metrics, functools.partial(solving, name))


CASES = [*map(_case, maps.FILES)]
