"""Pose graphs by every library that PyPI has: gtsam, symforce, pyceres and mrob, against ours.

    python -m benchmarks.peers --out DIR [--graphs NAME...] [--peers NAME...] [--mrob PYTHON]

Each of the eight public graphs is solved from the same poses, our chordal ones, to a relative
change of 1e-9, warm: the libraries' own forms of the graph are built, ours is compiled. What each
library can be told is in `benchmarks.experiments`: `symforce_peer` (all edges one factor,
linearised by our kernel, as fast as Python gets it), `ceres_peer` (in the plane, a residual in
Python), `mrob_peer` (its own residuals; with `--mrob`, an interpreter that has mrob and NumPy 1, in
space too); `benchmarks.suite.gtsam_peer`. All but mrob are timed in turn, round by round; mrob in a
process of its own, just after.

A graph's row: our seconds, each library's time over ours (blank: it cannot do it), and by how much
our cost at its poses exceeds ours, relatively. `fastest`: our time over that of the fastest other
library that comes to our cost, to 1e-6.

Writes summary.json ({graph: figures}), table.md and run.json.
"""

from __future__ import annotations

import functools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.experiments import ceres_peer, symforce_peer
from benchmarks.experiments.command import command_parser, finish, run_tasks
from benchmarks.experiments.record import LIBRARY
from benchmarks.suite import gtsam_peer, maps
from benchmarks.suite.harness import DATA, Settings
from benchmarks.suite.measure import Patience, geometric_mean, race
from benchmarks.suite.optimization import at_chordal_poses
from pcm_jax import PoseGraph, lie, optimize
from pcm_jax.mapping.optimization import problem_of
from pcm_jax.store import Store, digest

PEERS = ("gtsam", "symforce", "ceres", "mrob")
SCRIPT = Path(__file__).parent / "experiments" / "mrob_peer.py"
SOURCES = (*LIBRARY, Path(__file__), *SCRIPT.parent.glob("*_peer.py"))
SAME = 1e-6
"""Relative difference of costs up to which two solutions are one."""
PATIENCE = Patience(5, 3.0, 60.0)
Contestant = Callable[[], Callable[[], Callable[[], np.ndarray]]]
"""Gets ready and returns the solve, which returns what reads the poses off, as matrices."""
COLUMNS = {
    "seconds": "ours, s",
    **{name: f"{name} ×" for name in PEERS},
    "fastest": "ours over the fastest",
    **{f"{name}_cost": f"cost by {name}, relative" for name in PEERS},
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command."""
    parser = command_parser("peers", __doc__)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of public pose graphs")
    parser.add_argument("--graphs", nargs="+", default=list(maps.FILES), choices=list(maps.FILES))
    parser.add_argument("--peers", nargs="+", default=list(PEERS), choices=PEERS)
    parser.add_argument("--mrob", default=sys.executable, metavar="PYTHON", help="of mrob")
    options = parser.parse_args(arguments)
    start = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    steps = Store(options.out / "steps", digest(options.peers, files=SOURCES))
    tasks = {
        name: functools.partial(raced, name, options.data, options.peers, options.mrob)
        for name in options.graphs
    }
    found = run_tasks("graphs", tasks, steps)
    known = [own["fastest"] for own in found.values() if "fastest" in own]
    rows: dict[str, dict[str, Any]] = dict(found)
    if known:
        rows["geometric mean"] = {"fastest": geometric_mean(known)}
    options.mrob = Path(options.mrob).name
    return finish(options, start, rows, rows, COLUMNS)


def raced(name: str, data: Path, peers: Sequence[str], mrob: str) -> dict[str, float]:
    """The figures of one graph."""
    graph = at_chordal_poses(maps.read_map(name, Settings(data=data)))
    contestants = {peer: ready for peer in peers if (ready := _contestant(peer, graph))}
    ours = functools.partial(optimize, graph, initial="given")
    best = ours().cost
    costs = {peer: cost_at(graph, ready()()()) for peer, ready in contestants.items()}
    timings = race({"ours": lambda: ours, **contestants}, PATIENCE)
    medians = {peer: timing.median for peer, timing in timings.items()}
    if "mrob" in peers and (by_mrob := _by_mrob(graph, mrob)) is not None:
        medians["mrob"], costs["mrob"] = by_mrob[0], cost_at(graph, by_mrob[1])
    seconds = medians.pop("ours")
    figures = {"seconds": seconds} | {peer: each / seconds for peer, each in medians.items()}
    figures |= {f"{peer}_cost": cost / best - 1.0 for peer, cost in costs.items()}
    same = [medians[peer] for peer in medians if abs(figures[f"{peer}_cost"]) <= SAME]
    return figures | ({"fastest": seconds / min(same)} if same else {})


def cost_at(graph: PoseGraph, poses: np.ndarray) -> float:
    """0.5 Σ rᵀΩr at poses given as matrices `[n, k + 1, k + 1]`."""
    matrices: Any = poses
    return problem_of(graph).cost(lie.as_numpy(lie.from_matrix(matrices)))


def _contestant(peer: str, graph: PoseGraph) -> Contestant | None:
    """A library's solve of a graph; None where it is not installed or cannot do it."""
    if peer == "gtsam" and gtsam_peer.gtsam is not None:
        return _by_gtsam(graph)
    if peer == "symforce" and symforce_peer.cc_sym is not None:
        return symforce_peer.contestant(graph)
    if peer == "ceres" and ceres_peer.pyceres is not None and graph.tangent_dim == 3:
        return ceres_peer.contestant(gtsam_peer.plain(graph))
    return None


def _by_gtsam(graph: PoseGraph) -> Contestant:
    factors, start = gtsam_peer.factors_and_values(graph, "solve")

    def ready() -> Callable[[], Callable[[], np.ndarray]]:
        peer = gtsam_peer.gauss_newton(factors, start)

        def solve() -> Callable[[], np.ndarray]:
            found = peer.optimize()
            at = found.atPose2 if graph.tangent_dim == 3 else found.atPose3
            return lambda: np.array([at(pose).matrix() for pose in range(graph.num_poses)])

        return solve

    return ready


def _by_mrob(graph: PoseGraph, interpreter: str) -> tuple[float, np.ndarray] | None:
    """Seconds and poses by mrob; None where it is not installed or its process ends."""
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "graph.npz", Path(folder) / "poses.npy"
        np.savez(source, **gtsam_peer.plain(graph)._asdict())
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        command = [interpreter, str(SCRIPT), str(source), str(target), str(PATIENCE.least)]
        run = subprocess.run(
            command, capture_output=True, text=True, check=False, env=environment, timeout=600
        )
        if run.returncode:
            return None
        return statistics.median(json.loads(run.stdout)), np.load(target)


if __name__ == "__main__":
    raise SystemExit(main())
