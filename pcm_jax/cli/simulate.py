"""`pcm-jax simulate`: maps and candidate closures with known truth, as files that `merge` reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pcm_jax.cli._outputs import json_text
from pcm_jax.errors import FileFormatError
from pcm_jax.files import write_candidates, write_g2o, write_trajectory
from pcm_jax.files.output import check_target, folder_written_whole, write_text
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.simulation import SimulatedWorld, simulate_city, simulate_sessions

_WORLDS = {"city": simulate_city, "sessions": simulate_sessions}
_NOT_THE_WORLDS = ("command", "world", "output", "csv")


def run(options: Any) -> None:
    """Writes a world's files and says how to merge them."""
    folder = options.output
    _check_folder(folder)
    arguments = {k: v for k, v in vars(options).items() if k not in _NOT_THE_WORLDS}
    world = _WORLDS[options.world](**arguments)
    with folder_written_whole(folder) as place:
        given = _write_plain(place, world.graph) if options.csv else _write_one(place, world.graph)
        for graph, poses in zip(world.graph.maps, world.truth, strict=True):
            write_trajectory(place / f"truth_{graph.name}.txt", poses)
        write_text(place / "labels.json", json_text(_labels(world, options.world, arguments)))
    command = " ".join(str(folder / name) if "." in name else name for name in given)
    print(
        f"wrote {folder}: {len(world.graph.maps)} robots, {len(world.labels)} closures,"
        f" {int(world.is_true.sum())} of them true (labels.json)\n"
        f"try   pcm-jax merge {command}"
    )


def _check_folder(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise FileFormatError(folder, None, "this is a file, expected a folder to write to")
    check_target(folder / "labels.json" if folder.is_dir() else folder)


def _write_one(folder: Path, graph: MultiRobotGraph) -> list[str]:
    write_g2o(folder / "graph.g2o", graph)
    return ["graph.g2o"]


def _write_plain(folder: Path, graph: MultiRobotGraph) -> list[str]:
    """Gives the files as arguments of `merge`."""
    names = [f"{one.name}.g2o" for one in graph.maps]
    for name, one in zip(names, graph.maps, strict=True):
        write_g2o(folder / name, one)
    write_candidates(folder / "candidates.csv", graph)
    return [*names, "--closures", "candidates.csv"]


def _labels(world: SimulatedWorld, kind: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """Lists the true closures, by their index in the file and in `report.json`."""
    return {
        "world": kind,
        "arguments": arguments,
        "true_closures": np.flatnonzero(world.is_true).tolist(),
        "labels": world.labels.tolist(),
        "meaning": "labels[index]: 0 true; 1, 2, ... the aliased group; -1 random",
    }
