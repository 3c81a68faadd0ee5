"""`pcm-jax evaluate`: absolute and relative errors of trajectories against the truth."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pcm_jax.cli._outputs import json_text
from pcm_jax.cli._progress import Progress
from pcm_jax.errors import InputWarning
from pcm_jax.evaluation import Errors, TrajectoryErrors, trajectory_errors
from pcm_jax.files.pose_file import Reading
from pcm_jax.files.read import read_with_account
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.tables import NOTHING, columns_of_text

UNITS = ("m", "deg")
HEAD = [f"{name} ({unit})" for unit in UNITS for name in ("rmse", "mean", "median", "max")]
FRAMES = {
    "joint": "after one rigid motion of all robots, without scale",
    "each": "after a rigid motion of each robot, without scale",
    None: "in the frames given",
}


def run(options: Any) -> None:
    """Prints what was matched with what, and the errors of each robot and of all."""
    with Progress("reading") as progress:
        estimate = _read(options.files, options.ids)
        truth = _read(options.truth, options.ids)
        progress("comparing")
        errors = trajectory_errors(
            estimate,
            truth,
            align=None if options.align == "none" else options.align,
            delta=options.delta,
            delta_metres=options.delta_metres,
            max_difference=options.max_difference,
        )
    print(json_text(errors.as_dict()) if options.json else f"{_text(errors)}\n", end="")


def _read(paths: Sequence[Path], ids: str) -> MultiRobotGraph:
    """Reads poses; how certain they are does not matter here, and none of it is complained of.

    Warns:
        InputWarning: of lines left out and the like.
    """
    reading = Reading(repair="clip", ids=ids, default_sigmas=(1.0, 1.0))
    graph, account = read_with_account(list(map(str, paths)), None, reading, join=True)
    for line in dataclasses.replace(account, clipped=0, copies=(), doubts=()).warnings():
        warnings.warn(InputWarning(line), stacklevel=2)
    return graph


def _text(errors: TrajectoryErrors) -> str:
    parts = [
        "\n".join(_matches(errors)),
        f"absolute errors (ATE), {FRAMES[errors.align]}\n{_table(errors, 'absolute', 'poses')}",
        f"relative errors (RPE), steps of {errors.step}\n{_table(errors, 'relative', 'steps')}",
    ]
    return "\n\n".join(parts)


def _matches(errors: TrajectoryErrors) -> list[str]:
    """A line on the robots, and one for each on its poses."""
    return [
        f"robots matched by {errors.robots_by}",
        *(
            f"  {one.robot} with {one.true_robot}: {one.absolute.count} of {one.poses} poses,"
            f" by {one.matched_by}"
            for one in errors.robots
        ),
    ]


def _table(errors: TrajectoryErrors, kind: str, counted: str) -> str:
    rows = [[one.robot, *_row(getattr(one, kind))] for one in errors.robots]
    rows.append(["all", *_row(getattr(errors, kind))])
    return columns_of_text(["robot", counted, *HEAD], rows)


def _row(errors: Errors) -> list[object]:
    values = (*errors.translation, *errors.rotation)
    return [errors.count, *(f"{value:.4g}" if errors.count else NOTHING for value in values)]
