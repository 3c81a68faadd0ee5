"""`pcm-jax inspect`: what pose-graph files hold, and what is odd about them."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np

from pcm_jax import lie
from pcm_jax.cli._hints import square_root
from pcm_jax.cli._inputs import Given, read
from pcm_jax.cli._outputs import json_text
from pcm_jax.cli._progress import Progress
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph, symbols
from pcm_jax.graph.unsaid import rank_deficient
from pcm_jax.merging.groups import robot_groups
from pcm_jax.tables import columns_of_text

SINGULAR = 1e8  # ratio of an information matrix's eigenvalues, its units balanced
HEAD = ("robot", "poses", "ids", "edges", "odometry", "loops", "length (m)", "extent (m)")


def run(options: Any) -> None:
    """Prints how files were read, robots, closures, connectivity, and the odd things found."""
    with Progress("reading") as progress, warnings.catch_warnings(record=True) as corrections:
        given = _read(options)
        progress("looking for what is odd")
        graph, account = given.graph, given.account
        odd = [str(correction.message) for correction in corrections]
        odd += [*account.warnings(), *(line for line, severe in account.doubts if not severe)]
        odd += oddities(graph)
        told = square_root(options, graph, progress)
        odd += [] if told is None else [told]
    if options.json:
        print(json_text(_as_dict(given, odd)), end="")
        return
    read_as = [line for file in account.files for line in file.lines()]
    parts = ["\n".join(read_as), f"{graph.group.__name__} poses", robots(graph), closures(graph)]
    if account.copies:
        parts.append("\n".join(["stated again, counted once:", *map(str, account.copies)]))
    parts.append("odd:" if odd else "nothing odd found")
    print("\n\n".join(parts))
    for finding in odd:
        print(f"- {finding}")


def _read(options: Any) -> Given:
    """Reads files; information that is refused is clipped, to say how many need it."""
    try:
        return read(options)
    except InputError:
        return read(options, repair="clip")


def _as_dict(given: Given, odd: list[str]) -> dict[str, Any]:
    """Says what is printed, as JSON has it."""
    graph = given.graph
    return {
        **given.as_dict(),
        "group": graph.group.__name__,
        "robots": [_robot_as_dict(one) for one in graph.maps],
        "closures": [
            {"a": graph.names[a], "b": graph.names[b], "measured": len(indices)}
            for a, b in graph.closures.pairs()
            for indices in (graph.closures.between(a, b)[1],)
        ],
        "groups": [[graph.names[robot] for robot in group] for group in _groups(graph)],
        "odd": odd,
    }


def _robot_as_dict(one: PoseGraph) -> dict[str, Any]:
    """A robot's row in numbers: metres."""
    odometry = int(_is_odometry(one).sum())
    places = lie.translation(lie.as_numpy(one.poses))
    return {
        "robot": one.name,
        "poses": one.num_poses,
        "ids": [int(one.ids.min()), int(one.ids.max())],
        "edges": one.num_edges,
        "odometry": odometry,
        "loops": one.num_edges - odometry,
        "priors": 0 if one.priors is None else len(one.priors),
        "length": float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum()),
        "extent": np.ptp(places, axis=0).tolist(),
    }


def _groups(graph: MultiRobotGraph) -> list[Any]:
    between = graph.closures
    return list(robot_groups(len(graph.maps), between, np.ones(len(between), bool)))


def robots(graph: MultiRobotGraph) -> str:
    """A row for each robot."""
    return columns_of_text(HEAD, [_robot(one) for one in graph.maps])


def _robot(one: PoseGraph) -> list[object]:
    odometry = int(_is_odometry(one).sum())
    places = lie.translation(lie.as_numpy(one.poses))
    length = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    extent = " x ".join(f"{side:.4g}" for side in np.ptp(places, axis=0))
    ids = symbols.indices_of(one.ids)
    return [
        one.name,
        one.num_poses,
        f"{ids.min()} to {ids.max()}",
        one.num_edges,
        odometry,
        one.num_edges - odometry,
        f"{length:.4g}",
        extent,
    ]


def closures(graph: MultiRobotGraph) -> str:
    """Counts the closures between robots, and says whether they join all of them."""
    if len(graph.maps) < 2:
        return "no closures: there is one robot"
    between = graph.closures
    if not len(between):
        return "no closures between the robots"
    rows = [
        [f"{graph.names[a]} - {graph.names[b]}", len(between.between(a, b)[1])]
        for a, b in between.pairs()
    ]
    joined = " | ".join(" ".join(graph.names[robot] for robot in group) for group in _groups(graph))
    return f"{columns_of_text(['robots', 'closures'], rows)}\nconnected by closures: {joined}"


def oddities(graph: MultiRobotGraph) -> Iterator[str]:
    """Finds what a user should know before merging, one line each."""
    for one in graph.maps:
        for odd in (*_odd_ids(one), *_odd_edges(one)):
            yield f"robot {one.name}: {odd}"
    yield from (f"between robots: {odd}" for odd in _odd_closures(graph.closures))


def _odd_ids(one: PoseGraph) -> Iterator[str]:
    gaps = int((np.diff(np.sort(one.ids)) > 1).sum())
    if gaps:
        yield f"gaps in the poses' ids: {gaps}"


def _odd_edges(one: PoseGraph) -> Iterator[str]:
    ends = np.sort(np.stack([np.asarray(one.tail), np.asarray(one.head)], axis=1), axis=1)
    first = ends[_is_odometry(one), 0]
    missing = one.num_poses - 1 - len(np.unique(first))
    if missing:
        yield f"consecutive poses without an edge between them: {missing}"
    repeated = len(ends) - len(np.unique(ends, axis=0))
    if repeated:
        yield f"edges between poses that another edge joins already: {repeated}"
    identity = _is_identity(one.measurement) & ~_is_odometry(one)
    if identity.any():
        yield f"loop closures that measure exactly the identity: {identity.sum()}"
    yield from _odd_information(one.information)


def _odd_information(information: Any) -> Iterator[str]:
    """Matrices that all but lack an inverse, after scaling to a diagonal of ones."""
    matrices = np.asarray(information)
    matrices = matrices[~rank_deficient(matrices)]
    if not len(matrices):
        return
    scale = 1.0 / np.sqrt(np.diagonal(matrices, axis1=1, axis2=2))
    values = np.linalg.eigvalsh(scale[:, :, None] * matrices * scale[:, None, :])
    singular = int((values[:, -1] > SINGULAR * values[:, 0]).sum())
    if singular:
        yield f"information matrices that are nearly singular: {singular}"


def _odd_closures(between: LoopClosures) -> Iterator[str]:
    if not len(between):
        return
    identity = int(_is_identity(between.measurement).sum())
    if identity:
        yield f"closures that measure exactly the identity: {identity}"
    ends = [
        np.asarray(getattr(between, f"{what}_{end}")) for end in "ab" for what in ("robot", "pose")
    ]
    repeated = len(between) - len(np.unique(np.stack(ends, axis=1), axis=0))
    if repeated:
        yield f"closures between poses that another one joins already: {repeated}"
    yield from _odd_information(between.information)


def _is_odometry(one: PoseGraph) -> np.ndarray:
    """Marks the edges `[e]` between consecutive poses."""
    return np.abs(np.asarray(one.tail) - np.asarray(one.head)) == 1


def _is_identity(measurement: Any) -> np.ndarray:
    """Marks the transforms `[e]` that are the identity, to the last bit."""
    matrices = np.asarray(lie.as_matrix(lie.as_numpy(measurement)))
    return (matrices == np.eye(matrices.shape[-1])).all(axis=(1, 2))
