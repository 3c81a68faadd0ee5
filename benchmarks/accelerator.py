"""Q, cliques, sweeps and a merge on the default device, beside the same on this machine's CPU.

    python -m benchmarks.accelerator --out DIR [--minutes 10] [--sizes 1000 3000 10000 20000]

One script for a machine with a GPU lent for minutes. Without one it measures the CPU against
itself. Every answer on the device is checked against the CPU's, by the tolerance below.

    Q          all ordered pairs of m closures in space that touch 1,000 poses of either map, by the
               compiled closed form, in float64 and float32
    definition vmap and jacfwd over 192² pairs
    cliques    2,048 graphs of 60 nodes, dense enough to be searched, in one program
    sweep      worlds of the default law, Q and three methods, to Parquet
    merge      two robots of a simulated campus with that device as JAX's default: nothing of it
               need run there, all of it must work

A part that the time left does not suffice for, or that needs more memory than the device has, is
left out and said so. Writes summary.json ({part: figures}), table.md and run.json, which names the
device.
"""

from __future__ import annotations

import functools
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks.experiments.command import command_parser, finish
from benchmarks.suite.measure import Patience, timing_of
from benchmarks.suite.random_worlds import between_chains
from pcm_jax import (
    ConsistencyProblem,
    InputWarning,
    PoseGraph,
    consistency_problem,
    lie,
    maximum_clique_batched,
    merge,
    squared_mahalanobis,
    sweep,
)
from pcm_jax.simulation import simulate_sessions

SIZES = (1_000, 3_000, 10_000, 20_000)
POSES = 1_000
DEFINITION = 192
GRAPHS, NODES, DENSITY = 2_048, 60, 0.7
PATIENCE = Patience(3, 1.0, 20.0)
AGREE = {"float64": 1e-9, "float32": 2e-3}
"""Of squared distances, relative to themselves or to 6."""
COLUMNS = {
    "device": "device, s",
    "cpu": "CPU, s",
    "speedup": "CPU over device",
    "each": "device, µs each",
    "difference": "largest difference",
    "left_out": "left out",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command."""
    parser = command_parser("accelerator", __doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="none is begun after these")
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES), metavar="M")
    parser.add_argument("--poses", type=int, default=POSES, help="of either map")
    parser.add_argument("--graphs", type=int, default=GRAPHS, help="for cliques")
    parser.add_argument("--worlds", type=int, default=4_096, help="of the sweep; 0: none")
    options = parser.parse_args(arguments)
    start = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    devices = Devices(jax.devices()[0], jax.devices("cpu")[0])
    with jax.enable_x64(True):
        found = dict(_measured(options, devices, start))
    options.device = f"{devices.fast.device_kind} ({devices.fast.platform})"
    return finish(options, start, found, found, COLUMNS)


class Devices(NamedTuple):
    """The default device, and the CPU."""

    fast: Any
    cpu: Any


def _measured(options: Any, devices: Devices, start: float) -> Iterator[tuple[str, dict[str, Any]]]:
    """The parts and their figures, or why there are none."""
    for name, part in _parts(options, devices):
        spent = time.perf_counter() - start
        if spent > 60.0 * options.minutes:
            figures: dict[str, Any] = {"left_out": f"after {spent / 60:.1f} minutes"}
        else:
            try:
                figures = part()
            except (MemoryError, jax.errors.JaxRuntimeError) as reason:
                if "RESOURCE_EXHAUSTED" not in str(reason) and not isinstance(reason, MemoryError):
                    raise
                figures = {"left_out": "more memory than there is"}
        print(name, figures, flush=True)
        yield name, figures


def _parts(options: Any, devices: Devices) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    yield "merge", functools.partial(merging, devices, options.poses)
    yield "definition, float64", functools.partial(definition, devices, options.poses)
    yield f"cliques, {options.graphs:,} graphs", functools.partial(cliques, devices, options.graphs)
    for size in options.sizes:
        for dtype in ("float64", "float32"):
            part = functools.partial(distances, devices, size, options.poses, dtype)
            yield f"Q, m = {size:,}, {dtype}", part
    if options.worlds:
        part = functools.partial(sweeping, devices, options.worlds)
        yield f"sweep, {options.worlds:,} worlds", part


def distances(devices: Devices, size: int, poses: int, dtype: str) -> dict[str, Any]:
    """Q of `size` closures by the closed form."""
    problem = _problem(size, poses)
    return _weighed(devices, problem, "closed-form", size**2, dtype)


def definition(devices: Devices, poses: int) -> dict[str, Any]:
    """Q by automatic differentiation."""
    problem = _problem(DEFINITION, poses)
    return _weighed(devices, problem, "jacfwd", DEFINITION**2, "float64")


def _weighed(
    devices: Devices, problem: ConsistencyProblem, kernel: str, pairs: int, dtype: str
) -> dict[str, Any]:
    compiled = jax.jit(functools.partial(squared_mahalanobis, kernel=kernel))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)  # what rounding moves is looked at below
        problem = problem.astype(np.dtype(dtype))
    figures, answers, count = {}, [], round(pairs**0.5)
    for name, device in devices._asdict().items():
        placed = jax.device_put(problem, device)
        answers.append(np.asarray(compiled(placed))[:count, :count])  # without the padding
        figures[name] = _seconds(lambda placed=placed: compiled(placed))
    found, exact = answers
    worst = 0.0
    for some in np.array_split(np.arange(len(exact)), max(1, len(exact) // 500)):
        scale = np.maximum(np.abs(exact[some].astype(float)), 6.0)
        worst = max(worst, float(np.max(np.abs(found[some] - exact[some].astype(float)) / scale)))
    return _figures(figures, pairs, worst, AGREE[dtype])


def cliques(devices: Devices, count: int) -> dict[str, Any]:
    """Maximum cliques of many random graphs in one program."""
    generator = np.random.default_rng(0)
    upper = np.triu(generator.random((count, NODES, NODES)) < DENSITY, 1)
    graphs = upper | upper.swapaxes(1, 2)
    compiled = jax.jit(maximum_clique_batched)
    figures, answers = {}, []
    for name, device in devices._asdict().items():
        placed = jax.device_put(graphs, device)
        answers.append(np.asarray(compiled(placed).members))
        figures[name] = _seconds(lambda placed=placed: compiled(placed))
    return _figures(figures, count, float((answers[0] != answers[1]).sum()), 0.0)


def sweeping(devices: Devices, worlds: int) -> dict[str, Any]:
    """A sweep to Parquet, its first batch apart, which compiles."""
    import pyarrow.parquet

    figures, tables = {}, []
    for name, device in devices._asdict().items():
        mesh = jax.sharding.Mesh(np.array([device]), ("devices",))
        with tempfile.TemporaryDirectory() as folder:
            sweep(folder, worlds=worlds // 2, batch=worlds // 2, mesh=mesh)
            start = time.perf_counter()
            sweep(folder, worlds=2 * (worlds // 2), batch=worlds // 2, mesh=mesh)
            figures[name] = time.perf_counter() - start
            tables.append(pyarrow.parquet.read_table(folder))
    accepted = [np.array(table["accepted_inliers"]) for table in tables]
    # A squared distance at the gate may fall on either side of it.
    different = float(np.mean(accepted[0] != accepted[1]))
    return _figures(figures, worlds // 2, different, 1e-3)


def merging(devices: Devices, poses: int) -> dict[str, Any]:
    """The same merge with either as the default device."""
    graph = simulate_sessions(seed=0, poses=poses).graph
    figures, results = {}, []
    for name, device in devices._asdict().items():
        with jax.default_device(device):
            results.append(merge(graph))
            figures[name] = timing_of(lambda: merge(graph), PATIENCE).median
    if not np.array_equal(results[0].accepted, results[1].accepted):
        raise RuntimeError("merge: other closures are accepted with another default device")
    places = [np.concatenate([_places(one) for one in result.graph.maps]) for result in results]
    return _figures(figures, 1, float(np.abs(places[0] - places[1]).max()), 1e-6)


def _places(one: PoseGraph) -> np.ndarray:
    return np.asarray(lie.translation(lie.as_numpy(one.poses)))


def _figures(seconds: dict[str, float], count: int, difference: float, most: float) -> Any:
    if not difference <= most:
        raise RuntimeError(f"the device's answer differs by {difference}, expected at most {most}")
    return {
        "device": seconds["fast"],
        "cpu": seconds["cpu"],
        "speedup": seconds["cpu"] / seconds["fast"],
        "each": 1e6 * seconds["fast"] / count,
        "difference": difference,
    }


def _seconds(call: Callable[[], Any]) -> float:
    return timing_of(lambda: jax.block_until_ready(call()), PATIENCE).median


@functools.lru_cache(maxsize=1)
def _problem(count: int, poses: int) -> ConsistencyProblem:
    """Closures in space between random poses of two chains, whose covariances are of low rank."""
    return consistency_problem(**between_chains(count, poses))


if __name__ == "__main__":
    raise SystemExit(main())
