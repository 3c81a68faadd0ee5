"""The merged map as a differentiable function of closures, information and soft weights.

One compiled program, everything in it traced: the maps are aligned by their closures, solved
together by Gauss-Newton as in `joint`, and the derivatives follow from the optimum itself
(`mapping.implicit`), not from the steps that led to it.

The gauge. A closure of weight zero joins nothing, so which robots hang together is known at run
time only. One more pose, the world's, stands fixed at the origin, and an edge from it to each
robot's first pose holds the first robot of every group where its own map has it. All else is free
to move with that robot, so these edges end up without residual, whatever their weight.

**Training through it.** What a network says of each closure can be trained through consistency,
selection and merge:

```python
import dataclasses
import jax.numpy as jnp
gate, ready = pcm.chi2_gate(0.99, dof=3), pcm.MultiRobotGraph(tuple(maps), closures)

def loss(scale):                                       # of each closure's covariance
    covariance = scale[:, None, None] * problem.measurement_covariance
    learnt = dataclasses.replace(problem, measurement_covariance=covariance)
    weights = pcm.soft_select(pcm.squared_mahalanobis(learnt), gate, temperature=1.0)
    poses_a, poses_b = pcm.merge_differentiable(ready, weights)
    return jnp.sum(poses_b.translation() ** 2)         # any function of the merged map

slope = jax.grad(loss)(jnp.ones(len(problem.valid)))
```

Bad samples of a batch are NaN, change nothing else and have derivative zero; `pad_graph` makes
worlds of different sizes one batch.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import as_real, host_device
from pcm_jax.errors import InputError, check_class
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph
from pcm_jax.mapping.least_squares import SOLVERS, padded_size
from pcm_jax.mapping.priors import priors_of
from pcm_jax.merging.alignment import MOST_COMPARED, medoid_costs


def merge_differentiable(
    graph: MultiRobotGraph, weights: Float[Array, " m"], *, solver: str = "gauss-newton"
) -> tuple[Any, ...]:
    """Merges the maps by weighted closures; differentiable, forward and reverse.

    Finds the poses of least cost 0.5 Σ rᵀΩr over the maps' edges plus 0.5 Σ w rᵀΩr over the
    closures, r = Log(z⁻¹ X_i⁻¹ X_j), starting from the maps' poses, aligned by the closures. So
    the maps should be near their optimum, as `optimize` leaves them, and the weights should favour
    closures that agree.

    An edge or a closure whose information is all zero does not count, whatever else it says, and a
    pose that no other touches is not part of the map: `pad_graph` fills worlds of different sizes
    up with such, for `vmap`, and the rest is the same bit for bit.

    Safe under jit, vmap (problems are solved one after the other), grad, jvp, and their
    compositions, with the graph closed over or as an argument. The linear systems are solved on
    the host; a call outside jit runs on the CPU altogether, and a program that is compiled for
    another device goes back and forth. Derivatives are those of the exact
    optimum, by the implicit function theorem, with respect to:

    - `weights`, also at zero;
    - information of closures and maps, `[·, d, d]`;
    - measurements of closures and maps. A transform's parameters do not vary freely, so vary a
      right perturbation δ instead, at zero:

            def loss(delta):  # [m, d]
                z = lie.compose(closures.measurement, lie.exp(closures.group, delta))
                moved = dataclasses.replace(closures, measurement=z)
                merged = merge_differentiable(MultiRobotGraph(graph.maps, moved), weights)
                ...

            jax.grad(loss)(jnp.zeros((m, d)))

    - each group's first pose, which the whole group follows. All other poses are a start only, and
      have derivative zero.

    Args:
        graph: maps and all candidate closures. Structure (robots, poses and edges) may be traced;
            sizes are static.
        weights: `[m]`, at least 0, factor of each closure's information. Where it is 0 the closure
            counts as absent.
        solver: "gauss-newton", or "levenberg-marquardt" where the start is poor.

    Returns:
        For each robot its poses, Lie `[n]`. Robots that closures of positive weight connect share
        the frame of the group's first robot, whose first pose stays where its own map has it; a
        robot that none connects stays in its own frame. Between robots of different groups a
        weight's derivative is zero, since the map is not continuous there.

        All poses are NaN where the solve did not converge to a minimum (contradicting weights, or
        input that is not finite or not positive definite). Nothing flows back from those:
        their derivatives are zero, so that one bad problem in a batch spoils no gradient if
        its loss is masked by `jnp.where`.

    Raises:
        InputError: for an unknown solver, another number of weights than closures, or a map with
            priors, which have no derivative here (inside a transformation they are lost before);
            for closures of singular information.
    """
    check_class("graph", graph, "a MultiRobotGraph", MultiRobotGraph)
    if solver not in SOLVERS:
        raise InputError(f"solver: {solver!r} given, expected one of {', '.join(SOLVERS)}")
    for own in graph.maps:
        if (priors := priors_of(own)) is not None:
            raise InputError(
                f"priors: map {own.name!r} has {len(priors)}, which merge_differentiable does"
                " not take; expected none (PoseGraph.without_priors)"
            )
    count = len(graph.closures)
    if not isinstance(weights, jax.Array):
        if getattr(weights, "dtype", None) == np.bool_:  # a mask: weights of 0 and 1
            weights = np.asarray(weights, np.float64)
        weights = cast(Any, as_real(weights, "weights"))
    if jnp.shape(weights) != (count,):
        raise InputError(f"weights: shape {jnp.shape(weights)}, expected ({count},)")
    leaves = jax.tree.leaves((graph, weights))
    if not any(isinstance(leaf, Tracer) for leaf in leaves):
        graph, weights = jax.tree.map(np.asarray, (graph, weights))
        _check_all_said(graph)
    with _scope(graph):
        return _merged(solver, graph, jnp.asarray(weights, graph.closures.information.dtype))


def _check_all_said(graph: MultiRobotGraph) -> None:
    """Raises `InputError` for singular information other than padding's zeros."""
    rank = graph.closures.rank
    lacking = np.flatnonzero((rank > 0) & (rank < graph.closures.tangent_dim))
    if lacking.size:
        raise InputError(
            f"closures[{lacking[0]}]: information of rank {rank[lacking[0]]}, expected full rank"
        )


@contextmanager
def _scope(graph: MultiRobotGraph) -> Iterator[None]:
    """The precision of the maps, JAX's standard rules, and the CPU for what is not in a jit."""
    with ExitStack() as scopes:
        scopes.enter_context(lie.own_precision(graph))
        scopes.enter_context(jax.default_device(host_device()))
        scopes.enter_context(jax.numpy_dtype_promotion("standard"))
        scopes.enter_context(jax.numpy_rank_promotion("allow"))
        scopes.enter_context(jax.debug_nans(False))  # NaN is how a solve says that it failed
        yield


@functools.partial(jax.jit, static_argnums=0)
def _merged(solver: str, graph: MultiRobotGraph, weights: Float[Array, " m"]) -> tuple[Any, ...]:
    from pcm_jax.mapping.implicit import Data, optimum, pattern_of

    counted = [_counted(edges) for edges in (*graph.maps, graph.closures)]
    weights = jnp.where(counted[-1], weights, 0.0)
    maps = tuple(map(_blanked, graph.maps, counted[:-1]))
    graph = MultiRobotGraph(maps, _blanked(graph.closures, counted[-1]))
    first = np.cumsum([0, *(one.num_poses for one in maps)])
    placing = jax.lax.stop_gradient(_placing(graph, weights))
    tail, head = _ends(graph, first)
    order = _order(tail, head, jnp.concatenate([*counted, jnp.ones(len(maps), bool)]), first[-1])
    size = padded_size(len(order.poses), len(order.edges))
    pattern = pattern_of(
        *(jnp.where(order.counted, order.place[end], 0)[order.edges] for end in (tail, head)),
        poses=jnp.sum(order.touched, dtype=jnp.int32),
        edges=jnp.sum(order.counted, dtype=jnp.int32),
        size=size,
    )
    measurement, information, weight = _edges(graph, weights, placing, counted)
    data = Data(
        _padded(lie.take(measurement, order.edges), size),
        _filled(information[order.edges], jnp.eye(graph.tangent_dim), size),
        _filled(weight[order.edges], jnp.zeros(()), size),
    )
    start = _aligned(graph, placing)
    touched = order.touched[order.poses, None]
    known = jnp.where(touched, lie.parameters(lie.take(start, order.poses)), _unit(graph.group))
    begin = jax.lax.stop_gradient(_padded(graph.group(known), size))
    poses, converged = optimum(solver, pattern, begin, data)
    found = lie.parameters(poses)[order.place]
    values = jnp.where(order.touched[:, None], found, lie.parameters(start))
    values = jnp.where(converged, values, jnp.nan)
    return tuple(graph.group(values[low:high]) for low, high in itertools.pairwise(first))


def _counted(edges: PoseGraph | LoopClosures) -> Bool[Array, " e"]:
    return jnp.any(edges.information != 0.0, axis=(1, 2))


def _blanked(edges: Any, counted: Bool[Array, " e"]) -> Any:
    """The same map or closures, with harmless numbers in the edges that do not count."""
    values = jnp.where(
        counted[:, None], lie.parameters(edges.measurement), _unit(lie.group_of(edges.measurement))
    )
    unit = jnp.eye(edges.information.shape[-1])
    information = jnp.where(counted[:, None, None], edges.information, unit)
    measurement = lie.group_of(edges.measurement)(values)
    return dataclasses.replace(edges, measurement=measurement, information=information)


class _Order(NamedTuple):
    """An order with all that counts in front, so that padding in between changes nothing.

    Attributes:
        counted: `[e]`, the edges that count, in the order given.
        touched: `[n]`, the poses that these join; the last one, the world's, is among them.
        edges: `[e]`, the given edges in the new order.
        poses: `[n]`, the given poses in the new order.
        place: `[n]`, where each given pose is in it.
    """

    counted: Bool[Array, " e"]
    touched: Bool[Array, " n"]
    edges: Int[Array, " e"]
    poses: Int[Array, " n"]
    place: Int[Array, " n"]


def _order(
    tail: Int[Array, " e"], head: Int[Array, " e"], counted: Bool[Array, " e"], world: int
) -> _Order:
    touched = jnp.zeros(world + 1, bool)
    for end in (tail, head):
        touched = touched.at[jnp.where(counted, end, world)].set(True)
    poses = jnp.argsort(~touched)
    place = jnp.argsort(poses).astype(jnp.int32)
    return _Order(counted, touched, jnp.argsort(~counted), poses, place)


def _edges(
    graph: MultiRobotGraph,
    weights: Float[Array, " m"],
    placing: _Placing,
    counted: list[Bool[Array, " e"]],
) -> tuple[Any, Float[Array, "e d d"], Float[Array, " e"]]:
    """Measurement, information and weight of all edges: the maps', the closures', the gauge's."""
    maps, closures = graph.maps, graph.closures
    informations = [one.information for one in (*maps, closures)]
    together = placing.group[closures.robot_a] == placing.group[closures.robot_b]
    # The gauge's edges weigh as much as the strongest measurement: any weight gives one optimum.
    diagonals = [jnp.diagonal(each, axis1=1, axis2=2).ravel() for each in informations]
    stiffness = jax.lax.stop_gradient(jnp.max(jnp.concatenate([*diagonals, jnp.ones(1)])))
    leads = placing.group == jnp.arange(len(maps))
    firsts = lie.stack([lie.take(one.poses, 0) for one in maps])
    unit = jnp.broadcast_to(jnp.eye(graph.tangent_dim), (len(maps), *informations[0].shape[1:]))
    weight = [
        *(jnp.where(rows, 1.0, 0.0) for rows in counted[:-1]),
        jnp.where(together | ~(weights >= 0.0), weights, 0.0),  # NaN is not passed over
        jnp.where(leads, stiffness, 0.0),
    ]
    return (
        lie.concatenate([*(one.measurement for one in maps), closures.measurement, firsts]),
        jnp.concatenate([*informations, unit]),
        jnp.concatenate(weight).astype(weights.dtype),
    )


def _aligned(graph: MultiRobotGraph, placing: _Placing) -> Any:
    """All poses in their group's frame, and the world's."""
    moved = [
        lie.compose(lie.take(placing.anchors, np.full(one.num_poses, robot)), one.poses)
        for robot, one in enumerate(graph.maps)
    ]
    return lie.concatenate([*moved, graph.group(_unit(graph.group)[None])])


def _ends(graph: MultiRobotGraph, first: np.ndarray) -> tuple[Array, Array]:
    """Tail and head of all edges in the joint graph: the maps', the closures', the gauge's."""
    closures, robots = graph.closures, len(graph.maps)
    starts = jnp.asarray(first[:-1], jnp.int32)
    tails = [one.tail + start for one, start in zip(graph.maps, starts, strict=True)]
    heads = [one.head + start for one, start in zip(graph.maps, starts, strict=True)]
    ends_a = starts[closures.robot_a] + closures.pose_a
    ends_b = starts[closures.robot_b] + closures.pose_b
    world = jnp.full(robots, first[-1], jnp.int32)
    return jnp.concatenate([*tails, ends_a, world]), jnp.concatenate([*heads, ends_b, starts])


def _unit(group: Any) -> Float[np.ndarray, " p"]:
    """Parameters of the identity."""
    return np.asarray(lie.parameters(lie.identity(group)))


def _padded(batch: Any, size: int) -> Any:
    """A batch of `size`, identities at the end."""
    group = lie.group_of(batch)
    return group(_filled(lie.parameters(batch), _unit(group), size))


def _filled(values: Array, filler: Any, size: int) -> Array:
    """An array of `size` rows, `filler` at the end."""
    missing = (size - len(values), *values.shape[1:])
    return jnp.concatenate([values, jnp.broadcast_to(filler, missing).astype(values.dtype)])


class _Placing(NamedTuple):
    """The places where maps are put to start with.

    Attributes:
        anchors: Lie `[robots]`, each map's frame in that of its group's first robot.
        group: `[robots]`, the first robot of the group that each belongs to.
    """

    anchors: Any
    group: Int[Array, " robots"]


def _placing(graph: MultiRobotGraph, weights: Float[Array, " m"]) -> _Placing:
    """Places robot by robot, along the heaviest pair that joins a placed one to a new one."""
    robots, kind = len(graph.maps), graph.group
    pairs = np.stack(np.triu_indices(robots, 1), axis=1)
    total, relative = _relative_anchors(graph, weights, pairs)
    low, high = pairs[:, 0], pairs[:, 1]
    weight = jnp.zeros((robots, robots), weights.dtype)
    weight = weight.at[low, high].set(total).at[high, low].set(total)
    values, backward = lie.parameters(relative), lie.parameters(lie.inverse(relative))
    step = jnp.zeros((robots, robots, values.shape[-1]), values.dtype)
    step = step.at[low, high].set(values).at[high, low].set(backward)

    def place(_: int, state: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
        anchors, group, placed = state
        bridges = jnp.where(placed[:, None] & ~placed[None, :], weight, 0.0)
        a, b = jnp.unravel_index(jnp.argmax(bridges), bridges.shape)
        joined = bridges[a, b] > 0.0
        alone = jnp.argmin(placed)
        b = jnp.where(joined, b, alone).astype(jnp.int32)
        moved = lie.parameters(lie.compose(kind(anchors[a]), kind(step[a, b])))
        anchors = anchors.at[b].set(jnp.where(joined, moved, anchors[b]))
        group = group.at[b].set(jnp.where(joined, group[a], b))
        return anchors, group, placed.at[b].set(True)

    unmoved = lie.parameters(lie.identity(kind, (robots,), xp=jnp)).astype(values.dtype)
    first = jnp.arange(robots) == 0
    anchors, group, _ = jax.lax.fori_loop(
        1, robots, place, (unmoved, jnp.zeros(robots, jnp.int32), first)
    )
    return _Placing(kind(anchors), group)


def _relative_anchors(
    graph: MultiRobotGraph, weights: Float[Array, " m"], pairs: Int[np.ndarray, "pairs 2"]
) -> tuple[Float[Array, " pairs"], Any]:
    """Each pair's total weight, and where its second map lies in the first, by the medoid.

    Closure u alone would put the second map at T_u = X_i z_u Y_k⁻¹. Believed is the one whose T_u
    is the nearest to all others', weighted, see `medoid_costs`.
    """
    placed, seen, low, high = _oriented(graph)
    kept = min(MOST_COMPARED, len(weights))

    def of_pair(pair: Int[Array, " 2"]) -> tuple[Array, Array]:
        share = jnp.where((low == pair[0]) & (high == pair[1]), weights, 0.0)
        w, rows = jax.lax.top_k(share, kept)
        cost = medoid_costs(lie.as_matrix(lie.take(placed, rows)), seen[rows], w)
        best = jnp.argmin(jnp.where(w > 0.0, cost, jnp.inf))
        return jnp.sum(share), lie.parameters(lie.take(placed, rows[best]))

    if not (len(pairs) and kept):
        one = lie.parameters(lie.identity(graph.group, (len(pairs),), xp=jnp))
        return jnp.zeros(len(pairs), weights.dtype), graph.group(one.astype(weights.dtype))
    total, values = jax.lax.map(of_pair, jnp.asarray(pairs))
    return total, graph.group(values)


def _oriented(graph: MultiRobotGraph) -> tuple[Any, Float[Array, "m s"], Array, Array]:
    """T_u and y_u of every closure, taken from its lower robot to its higher, and those robots."""
    closures: LoopClosures = graph.closures
    first = np.cumsum([0, *(one.num_poses for one in graph.maps)])[:-1]
    poses, starts = lie.concatenate([one.poses for one in graph.maps]), jnp.asarray(first)
    pose_a = lie.take(poses, starts[closures.robot_a] + closures.pose_a)
    pose_b = lie.take(poses, starts[closures.robot_b] + closures.pose_b)
    placed = lie.compose(lie.compose(pose_a, closures.measurement), lie.inverse(pose_b))
    flipped: Any = closures.robot_a > closures.robot_b
    values = jnp.where(
        flipped[:, None], lie.parameters(lie.inverse(placed)), lie.parameters(placed)
    )
    seen = jnp.where(flipped[:, None], lie.translation(pose_a), lie.translation(pose_b))
    low = jnp.minimum(closures.robot_a, closures.robot_b)
    return graph.group(values), seen, low, jnp.maximum(closures.robot_a, closures.robot_b)
