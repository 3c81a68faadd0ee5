"""Simulated cities with closures as a front end reports them: of unequal worth, and many wrong.

The robots, their maps and where they meet are `simulate_city`'s. Candidates between them, by kind:

- true: the right place, registered with normal noise whose deviations differ from closure to
  closure: large with little overlap, far apart, and along a corridor;
- slipped: the right place, but the registration ended in a wrong minimum, 5 to 20 of its own
  deviations off: centimetres for a sharp one, metres for a blunt one. What the place looks like
  does not tell, and no one covariance for all closures can;
- aliased: a group that agrees on one wrong alignment, registered well;
- random: a wrong place, nearby as they all are.

What is seen of a closure (`FEATURES`) is overlap and corridor with noise, the distance measured, a
score of the registration and one of the appearance. Right and wrong closures' scores overlap, so
that features alone cannot tell them apart either.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jaxlie
import numpy as np
from jaxtyping import Bool, Float

from pcm_jax import (
    ConsistencyProblem,
    MultiRobotGraph,
    PoseGraph,
    consistency_problem,
    lie,
    optimize,
)
from pcm_jax.errors import InputError
from pcm_jax.simulation import SimulatedWorld, simulate_city

COUNTS = {"true": 12, "slipped": 20, "aliased": 6, "random": 26}
FEATURES = ("overlap", "corridor", "distance", "registration", "appearance")
POSES, BLOCKS, REACH = 120, 5, 3.0
LOOPS = 16
"""Loop closures inside each map: as many in every world, so that worlds can be stacked."""
SIGMA = np.array([0.04, 0.04, 0.015])
"""Deviations of the sharpest registrations: m along and across the way, rad."""
SLIP = (5.0, 20.0)
"""How many of its own deviations a slipped registration is off, least and most."""


class LearningWorld(NamedTuple):
    """One world, or a stack of them; all fields are arrays or pytrees of arrays.

    Attributes:
        graph: optimised maps and all candidates, whose stated information means nothing.
        problem: what Q needs to know of them, likewise.
        features: `[m, f]`, each within about [-2, 2].
        right: bool `[m]`, the true closures.
        truth: Lie `[n]` of each robot, in one frame.
        sigma: `[m, 3]`, the deviations that true closures were drawn with; m, m, rad.
        error: `[m, 3]`, how far each is off: Log of (truth⁻¹ · measurement).
    """

    graph: MultiRobotGraph
    problem: ConsistencyProblem
    features: Float[Any, "m f"]
    right: Bool[Any, " m"]
    truth: tuple[Any, ...]
    sigma: Float[Any, "m 3"]
    error: Float[Any, "m 3"]


def worlds(seed: int, count: int) -> LearningWorld:
    """A stack of worlds, drawn from one seed."""
    every = [_world(child) for child in np.random.SeedSequence(seed).spawn(count)]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *every)


def _world(seed: Any) -> LearningWorld:
    generator = np.random.default_rng(seed)
    city, maps = _city(generator)
    kind = np.where(city.labels > 0, "aliased", np.where(city.labels < 0, "random", "true"))
    overlap, corridor = generator.beta(1.5, 1.2, len(kind)), generator.random(len(kind))
    place = np.flatnonzero(city.is_true)
    ease = overlap[place] - 0.5 * corridor[place] + generator.normal(0.0, 0.5, len(place))
    kind[place[np.argsort(ease)[: COUNTS["slipped"]]]] = "slipped"  # the harder, the likelier
    exact, sigma, measurement = _measured(generator, city, kind, overlap, corridor)
    closures = dataclasses.replace(city.graph.closures, measurement=lie.as_device(measurement))
    graph = MultiRobotGraph(maps, closures)
    return LearningWorld(
        graph=graph,
        problem=consistency_problem(maps[0], maps[1], closures),
        features=_features(generator, kind, overlap, corridor, measurement),
        right=kind == "true",
        truth=city.truth,
        sigma=sigma,
        error=np.asarray(lie.log(lie.between(exact, measurement))),
    )


def _city(generator: Any) -> tuple[SimulatedWorld, tuple[PoseGraph, ...]]:
    """A city and its optimised maps; drawn again if a map has few loops or robots seldom meet."""
    while True:
        try:
            city = simulate_city(
                seed=generator,
                poses=POSES,
                blocks=BLOCKS,
                inliers=COUNTS["true"] + COUNTS["slipped"],
                aliased_groups=1,
                aliased_size=COUNTS["aliased"],
                random=COUNTS["random"],
                random_range=REACH,
                reach=REACH,
            )
        except InputError:
            continue
        if all(own.num_edges >= POSES - 1 + LOOPS for own in city.graph.maps):
            return city, tuple(optimize(_with_few_loops(own)).graph for own in city.graph.maps)


def _with_few_loops(own: PoseGraph) -> PoseGraph:
    """The map with its odometry, which comes first, and its first `LOOPS` loop closures."""
    kept = np.arange(own.num_poses - 1 + LOOPS)
    return PoseGraph.from_arrays(
        tail=np.asarray(own.tail)[kept],
        head=np.asarray(own.head)[kept],
        measurement=lie.take(lie.as_numpy(own.measurement), kept),
        information=np.asarray(own.information)[kept],
    )


def _measured(
    generator: Any, city: SimulatedWorld, kind: Any, overlap: Any, corridor: Any
) -> tuple[Any, Float[np.ndarray, "m 3"], Any]:
    """True relative poses, deviations, and measurements: of the right place drawn anew."""
    closures = city.graph.closures
    ends = zip(city.truth, (closures.pose_a, closures.pose_b), strict=True)
    at_a, at_b = (lie.take(path, np.asarray(rows)) for path, rows in ends)
    exact = lie.between(at_a, at_b)
    far = 1.0 + 0.2 * np.minimum(np.linalg.norm(lie.translation(exact), axis=1), REACH)
    across = far * np.exp(2.0 * (1.0 - overlap) ** 2)
    sigma = SIGMA * np.stack([across * np.exp(1.8 * corridor**2), across, across], axis=1)
    white = generator.normal(size=sigma.shape)
    unit = white / np.linalg.norm(white, axis=1, keepdims=True)
    slip = unit * generator.uniform(*SLIP, size=(len(kind), 1))
    error: Any = sigma * np.where((kind == "slipped")[:, None], slip, white)
    drawn = lie.parameters(lie.compose(exact, lie.exp(jaxlie.SE2, error)))
    given = lie.parameters(lie.as_numpy(closures.measurement))
    values: Any = np.where(city.is_true[:, None], drawn, given)
    return exact, sigma, jaxlie.SE2(values)


def _features(
    generator: np.random.Generator, kind: Any, overlap: Any, corridor: Any, measurement: Any
) -> Float[np.ndarray, "m f"]:
    noise = generator.normal(size=(4, len(kind)))
    sharp = np.isin(kind, ["true", "aliased"])
    alike = kind != "random"
    distance = np.linalg.norm(lie.translation(measurement), axis=1)
    columns = (
        4.0 * (overlap - 0.5) + 0.3 * noise[0],
        4.0 * (corridor - 0.5) + 0.3 * noise[1],
        distance - 0.5 * REACH,
        np.where(sharp, 0.8, -0.8) + 0.5 * (overlap - 0.5) + noise[2],
        np.where(alike, 0.8, -0.8) + noise[3],
    )
    return np.stack(columns, axis=1)
