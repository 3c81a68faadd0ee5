"""The whole way: merges, the sets whose answer is known, the demo, and importing the package."""

from __future__ import annotations

import compileall
import functools
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import pcm_jax
from benchmarks.suite import maps
from benchmarks.suite.harness import ENVIRONMENT, Case, Measured, Metric, Settings
from benchmarks.suite.measure import alone, in_words, seconds_of, timing_of
from pcm_jax import merge, select
from pcm_jax.simulation import simulate_city, simulate_sessions

SPOILED = "multirobot_rdm/pairwise_consistency_maximization/spoiled"
SPOILED_SETS = ("simulation/example_4robots", "simulation_not_in_order/example_2robots")
CONFIDENCE = 0.99
IMPORTS = 5
MERGE = "import pcm_jax; pcm_jax.read_graph, pcm_jax.merge"
FOUNDATIONS = "import jax, numpy, scipy"
WORLDS = {"SE2": simulate_city, "SE3": functools.partial(simulate_sessions, poses=1_000)}
FIRST = {"SE2": 1.0, "SE3": 2.0}
"""Seconds of the first merge of two maps of 1,000 poses in a process."""
IMPORTED = "a quarter of it is SciPy's special functions, the rest jaxtyping and our own modules"
REASONS = {
    "merge": "",
    "merge_again": "nothing is compiled the first time either, so that there is nothing to be found"
    " again: importing takes two thirds, the rest is the interpreter on 84 poses",
    "demo": "the solve with every closure does not converge: a hundred steps of"
    " Levenberg-Marquardt over the rounds of the rebuild; then Matplotlib",
}
COMMANDS = {"merge": 4.0, "merge_again": 2.5, "demo": 5.0}
"""Times `FOUNDATIONS`, whole processes: of four robots' maps with nothing cached, and again."""
OTHER_SIZE = {"SE2": 950, "SE3": 1_100}
"""Poses a map of a second problem, which pads to the sizes of the first."""


def spoiled(settings: Settings) -> dict[str, Measured]:
    """Sets in which each robot pair's largest consistent group is half of its measurements."""
    exact, pairs = 0, 0
    for name in SPOILED_SETS:
        folder = maps.required(f"{SPOILED}/{name}", settings)
        graph = maps.read_quietly(*sorted(folder.iterdir()))
        for pair in select(graph, confidence=CONFIDENCE).pairs:
            pairs += 1
            exact += 2 * int(pair.accepted.sum()) == len(pair.accepted)
    note = f"{exact} of {pairs} robot pairs accept exactly half"
    return {"pairs_half_accepted": Measured(100.0 * exact / pairs, note)}


def two_maps(group: str, settings: Settings) -> dict[str, Measured]:
    """Two maps of 1,000 poses, from raw odometry to one merged map; nothing was compiled before."""
    world = WORLDS[group]()
    other = WORLDS[group](seed=1, poses=OTHER_SIZE[group])
    first = seconds_of(lambda: merge(world.graph))
    compiled = merge(other.graph).seconds["compile"]
    timing = timing_of(lambda: merge(world.graph), settings.patience)
    accepted = merge(world.graph).accepted
    true, false = (int((accepted & each).sum()) for each in (world.is_true, ~world.is_true))
    note = f"{true} of {world.is_true.sum()} true closures and {false} false ones accepted"
    return {
        "first": Measured(first, "plans and compilation included"),
        "other_size_compiles": Measured(compiled, f"{OTHER_SIZE[group]:,} poses a map"),
        "again": Measured(timing.median, f"{alone(timing)}; {note}"),
    }


def commands(settings: Settings) -> dict[str, Measured]:
    """`pcm-jax` as in a shell of its own, against what importing JAX takes, in turn."""
    folder = maps.required(f"{SPOILED}/{SPOILED_SETS[0]}", settings)
    compileall.compile_dir(Path(pcm_jax.__file__).parent, quiet=1)  # as pip does
    files = [str(path) for path in sorted(folder.iterdir())]
    cli = "-m", "pcm_jax"
    seconds: dict[str, list[float]] = {name: [] for name in (*COMMANDS, "help", "import")}
    for _ in range(IMPORTS):
        with tempfile.TemporaryDirectory() as empty:
            asked = {
                "merge": (*cli, "merge", *files),
                "merge_again": (*cli, "merge", *files),
                "demo": (*cli, "demo"),
                "help": (*cli, "--help"),
                "import": ("-c", FOUNDATIONS),
            }
            for name, arguments in asked.items():
                run = functools.partial(_python, *arguments, folder=empty, cache=empty)
                seconds[name].append(seconds_of(run))
    medians = {name: statistics.median(each) for name, each in seconds.items()}
    base = medians["import"]
    found = {"help": Measured(medians["help"], "without JAX")}
    for name in COMMANDS:
        note = f"{in_words(medians[name])} against {in_words(base)}, {IMPORTS} rounds"
        found[f"{name}_over_import"] = Measured(medians[name] / base, note)
    return found


def imports(settings: Settings) -> dict[str, Measured]:
    """Times imports, each in a fresh process: of the package, and of all that a merge needs."""
    compileall.compile_dir(Path(pcm_jax.__file__).parent, quiet=1)  # as pip does
    package = [_seconds("import pcm_jax", after="import jax") for _ in range(IMPORTS)]
    # In turn, so that a busy machine slows both alike.
    rounds = [(_seconds(MERGE), _seconds(FOUNDATIONS)) for _ in range(IMPORTS)]
    ours, theirs = map(statistics.median, zip(*rounds, strict=True))
    note = f"{in_words(ours)} against {in_words(theirs)}, {IMPORTS} rounds"
    return {
        "pcm_jax": Measured(statistics.median(package), f"median of {IMPORTS} processes"),
        "merge_over_foundations": Measured(ours / theirs, note),
    }


def _seconds(code: str, *, after: str = "pass") -> float:
    """The seconds that a fresh process takes for some code, what comes before it left out."""
    clock = "from time import perf_counter as now"
    program = f"{clock}; {after}; start = now(); {code}; print(now() - start)"
    return float(_python("-c", program))


def _python(*arguments: str, folder: str | None = None, cache: str | None = None) -> str:
    """Runs a fresh Python with the user's own environment, not the benchmarks': what it prints.

    Args:
        arguments: of the interpreter.
        folder: where it runs.
        cache: folder of compiled programs.
    """
    environment = {key: value for key, value in os.environ.items() if key not in ENVIRONMENT}
    if cache is not None:
        environment["PCM_JAX_CACHE"] = cache
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment,
        check=True,
        capture_output=True,
        text=True,
    )
    return done.stdout


CASES = [
    Case(
        "end_to_end/spoiled",
        (Metric("pairs_half_accepted", "%", "higher", figure=100.0, tolerance=0.0, digits=4),),
        spoiled,
    ),
    *(
        Case(
            f"end_to_end/merge-{group}",
            (
                Metric("first", "s", figure=FIRST[group]),
                Metric("again", "s"),
                Metric("other_size_compiles", "s", figure=0.0, tolerance=None),
            ),
            functools.partial(two_maps, group),
        )
        for group in WORLDS
    ),
    Case(
        "end_to_end/commands",
        (
            *(
                Metric(f"{name}_over_import", "×", figure=most, reason=REASONS[name])
                for name, most in COMMANDS.items()
            ),
            Metric("help", "s", figure=0.4),
        ),
        commands,
    ),
    Case(
        "end_to_end/import",
        (
            Metric("pcm_jax", "s after JAX", figure=0.3, tolerance=None, digits=2),
            Metric("merge_over_foundations", "×", figure=2.0, reason=IMPORTED),
        ),
        imports,
    ),
]
