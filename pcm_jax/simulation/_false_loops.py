"""False loop closures inside one robot's map, by the four laws that back ends are raced with.

After the policies of Sünderhauf and Protzel ("Switchable constraints for robust pose graph SLAM",
IROS 2012), whose generator (vertigo) the papers since then use. A front end takes two poses for the
same place:

    random          any two poses
    grouped         stretches: poses v, v + 1, … for w, w + 1, …, as when a corridor is mistaken
    local           poses a few steps apart
    local-grouped   stretches a few steps apart

and says that one stands where the other does, but for some noise; a whole group says the same, so
that its members agree with each other. What the paper leaves open is chosen here: the sizes of
groups and neighbourhoods, and the noise, are arguments; a false closure states the information of
one of the map's own, drawn at random, so that nothing tells it from these.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.consistency import odometry_edges
from pcm_jax.errors import InputError, check_class, check_number
from pcm_jax.graph import PoseGraph
from pcm_jax.simulation.measurements import space_dim

LAWS = ("random", "grouped", "local", "local-grouped")
SMALLEST_GAP = 2
"""Steps between two poses that are taken for one: between neighbours there is odometry."""


@dataclasses.dataclass(frozen=True, eq=False)
class SpoiledMap:
    """A map with false closures.

    Attributes:
        graph: the map; the false closures stand behind its own edges.
        is_true: bool `[e]`, false for these.
    """

    graph: PoseGraph
    is_true: Bool[np.ndarray, " e"]


@on_host
def add_false_loops(
    pose_graph: PoseGraph,
    *,
    share: float,
    law: str = "random",
    group_size: int = 10,
    reach: int = 20,
    sigma_translation: float = 0.3,
    sigma_rotation: float = 0.17,
    seed: int = 0,
) -> SpoiledMap:
    """Adds false loop closures to one robot's map.

        spoiled = pcm_jax.simulation.add_false_loops(graph.maps[0], share=0.3, law="grouped")
        pcm_jax.select_within(spoiled.graph).kept & ~spoiled.is_true        # those let in

    Args:
        pose_graph: a chain with closures, as for `select_within`, all of them taken for right.
        share: how many are added, as a share of the map's own closures (0.5: a third of all).
        law: "random", "grouped", "local" or "local-grouped".
        group_size: members of a group.
        reach: steps between two poses at most, of the local laws.
        sigma_translation: m, standard deviation of what a false closure measures along each axis.
        sigma_rotation: rad, likewise about each axis.
        seed: of all that is drawn.

    Raises:
        InputError: for an unknown law, a negative share or size, a map without a closure or with
            too few poses for such groups, consecutive poses that no edge joins.
    """
    check_class("pose_graph", pose_graph, "a PoseGraph", PoseGraph)
    if law not in LAWS:
        raise InputError(f"law: {law!r}, expected one of {', '.join(LAWS)}")
    for name, value in (("share", share), ("sigma_translation", sigma_translation)):
        check_number(name, value, least=0)
    check_number("sigma_rotation", sigma_rotation, least=0)
    check_number("group_size", group_size, least=1, integer=True)
    check_number("reach", reach, least=SMALLEST_GAP, integer=True)
    closures = np.setdiff1d(np.arange(pose_graph.num_edges), odometry_edges(pose_graph))
    if not len(closures):
        raise InputError("pose_graph: no closure given, expected some that a share is taken of")
    generator, count = np.random.default_rng(seed), round(share * len(closures))
    size = group_size if "grouped" in law else 1
    spread = reach if "local" in law else pose_graph.num_poses
    start, end = _pairs(generator, pose_graph.num_poses, -(-count // size), size, spread)
    noise = _noise(generator, pose_graph.group, len(start), sigma_translation, sigma_rotation)
    member = np.arange(size)
    tail, head = ((ends[:, None] + member).ravel()[:count] for ends in (start, end))
    drawn = generator.choice(closures, count)
    information = np.asarray(pose_graph.information)
    graph = dataclasses.replace(
        pose_graph,
        tail=np.append(np.asarray(pose_graph.tail), tail).astype(np.int32),
        head=np.append(np.asarray(pose_graph.head), head).astype(np.int32),
        measurement=lie.concatenate(
            [
                lie.as_numpy(pose_graph.measurement),
                lie.take(noise, np.repeat(np.arange(len(start)), size)[:count]),
            ]
        ),
        information=np.concatenate([information, information[drawn]]),
        source=np.append(pose_graph.source, np.full(count, "", object)),
    )
    return SpoiledMap(graph, np.arange(graph.num_edges) < pose_graph.num_edges)


def _pairs(
    generator: np.random.Generator, poses: int, count: int, size: int, spread: int
) -> tuple[Int[np.ndarray, " g"], Int[np.ndarray, " g"]]:
    """The first poses of both stretches of each group, the earlier one first.

    Uniform over all pairs that are at least `SMALLEST_GAP` and at most `spread` steps apart.
    """
    last = poses - size
    if last < SMALLEST_GAP:
        raise InputError(f"group_size: {size} given, expected less, for the map has {poses} poses")
    gaps = np.arange(SMALLEST_GAP, min(spread, last) + 1)
    places = last + 1 - gaps  # starts that leave room for a gap
    gap = generator.choice(gaps, count, p=places / places.sum())
    start = np.floor(generator.random(count) * (last + 1 - gap)).astype(np.int64)
    return start, start + gap


def _noise(
    generator: np.random.Generator, group: Any, count: int, translation: float, rotation: float
) -> Any:
    """Motions near the identity."""
    space = space_dim(group)
    scale = np.full(lie.tangent_dim(group), rotation)
    scale[:space] = translation
    drawn: Any = scale * generator.standard_normal((count, len(scale)))
    return lie.as_numpy(lie.exp(group, drawn))
