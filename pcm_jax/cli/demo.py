"""`pcm-jax demo`: what PCM is for, in one table and one picture."""

from __future__ import annotations

import dataclasses
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from pcm_jax.cli import _outputs as outputs
from pcm_jax.cli._arguments import DEMO_PAGE, DEMO_PICTURE
from pcm_jax.cli._progress import Progress
from pcm_jax.errors import InputWarning
from pcm_jax.evaluation import ate_rmse
from pcm_jax.files.output import check_target
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.mapping import optimize
from pcm_jax.merging import MergeResult
from pcm_jax.pipeline import merge
from pcm_jax.simulation import SimulatedWorld, simulate_city
from pcm_jax.tables import columns_of_text

HEAD = "method", "accepted", "true", "false", "ATE RMSE (m)", "seconds", "compiling", "solver"
EVERYTHING, PCM = "everything accepted", "PCM"


@dataclasses.dataclass(frozen=True)
class Outcome:
    """One way of merging the optimised maps, and its wall-clock seconds."""

    result: MergeResult
    seconds: float


def run(options: Any) -> None:
    """Prints the table and saves the picture in the current folder."""
    for path in (DEMO_PICTURE, DEMO_PAGE):
        check_target(path)
    outputs.check_picture(DEMO_PICTURE)
    with Progress("simulating") as progress:
        world = simulate_city(seed=options.seed)
        outcomes = merged_both_ways(world, progress)
        progress("drawing")
        draw(world, outcomes, DEMO_PICTURE)
        outcomes[PCM].result.to_html(DEMO_PAGE)
    print(f"{description(world)}\n\n{comparison(world, outcomes)}\n\nwrote {DEMO_PICTURE}")
    print(f"wrote {DEMO_PAGE}, which says of every closure why: open it in a browser")


def merged_both_ways(world: SimulatedWorld, progress: Any = None) -> dict[str, Outcome]:
    """The world's maps merged by PCM, and by all closures; each map is optimised once."""
    maps = tuple(optimize(one).graph for one in world.graph.maps)
    graph = MultiRobotGraph(maps, world.graph.closures)
    outcomes = {}
    for name, method in ((PCM, "pcm-exact"), (EVERYTHING, "all")):
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)  # the table says it
            result = merge(graph, method=method, optimized=True, progress=progress)
        outcomes[name] = Outcome(result, time.perf_counter() - start)
    return outcomes


def description(world: SimulatedWorld) -> str:
    """Says in two lines what was simulated."""
    robots = " and ".join(f"{one.name} ({one.num_poses} poses)" for one in world.graph.maps)
    groups = [int((world.labels == k).sum()) for k in range(1, world.labels.max() + 1)]
    return (
        f"Simulated city, robots {robots}.\n{len(world.labels)} candidate closures between them:"
        f" {int(world.is_true.sum())} true, {' + '.join(map(str, groups))} false that agree among"
        f" themselves, {int((world.labels < 0).sum())} at random."
    )


def comparison(world: SimulatedWorld, outcomes: dict[str, Outcome]) -> str:
    """The table of both ways to merge."""
    rows = []
    for name, outcome in outcomes.items():
        accepted, solution = outcome.result.accepted, outcome.result.solution
        error = float(ate_rmse(outcome.result.graph.maps, world.truth, align="umeyama"))
        rows.append(
            [
                name,
                int(accepted.sum()),
                int((accepted & world.is_true).sum()),
                int((accepted & ~world.is_true).sum()),
                f"{error:.3f}",
                f"{outcome.seconds:.1f}",
                f"{outcome.result.seconds['compile']:.1f}",
                "converged" if solution.converged else "did not converge",
            ]
        )
    return columns_of_text(HEAD, rows)


def draw(world: SimulatedWorld, outcomes: dict[str, Outcome], path: Path) -> None:
    """Saves the true maps, and both merged ones, side by side."""
    from pcm_jax.plots import plot_comparison

    panels: dict[str, Any] = {"Ground truth": (world.truth, None)}
    for name in (EVERYTHING, PCM):
        result = outcomes[name].result
        panels[name[0].upper() + name[1:]] = (result.graph.maps, np.asarray(result.accepted))
    axes = plot_comparison(
        panels, world.graph.closures, is_true=world.is_true, names=world.graph.names
    )
    outputs.save_picture(path, axes[0])
