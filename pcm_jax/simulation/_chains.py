"""Two robots on one grid of streets, drawn inside a compiled program: for sweeps over thousands.

The law is that of `city`, in the plane or in space, but for two things that would cost a program of
fixed shape too much: maps have no loop closures of their own, and places where the robots meet are
looked for among some of their poses instead of all.

- Both drive through a town of square blocks, straight on or, now and then, to a side (`streets`).
- A map is odometry alone, X_{s+1} = X_s z_s, each step with an error of its own, so that the joint
  covariance of its poses has a closed form (`consistency.within` derives it):
  with S_k = Σ_{s<k} Ad(X_{s+1}) Σ_s Ad(X_{s+1})ᵀ, Cov(ξ_i, ξ_j) = S_min(i, j) and so
  G_ij = Cov(ξ_j − ξ_i) = S_max(i, j) − S_min(i, j), left perturbations in the map's frame.
- A true closure joins poses that are near each other, measured with noise.
- Aliased groups and random closures are those of `outliers`.

Everything follows from one random key, traced or not, by JAX's counter-based generator: the same
key gives the same world, to rounding, on every kind of device.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from pcm_jax import lie
from pcm_jax.consistency import ConsistencyProblem
from pcm_jax.errors import InputError
from pcm_jax.lie import unrolled
from pcm_jax.simulation._town import crossings_left, index_below, town_drive
from pcm_jax.simulation.measurements import space_dim
from pcm_jax.simulation.outliers import (
    ALIAS_DRAWS,
    RANDOM_LABEL,
    bounding_box,
    squared_lengths,
    wrong_alignment,
)
from pcm_jax.simulation.world import require_at_least, require_positive

# Poses looked at for each closure wanted: in the default town all closures are then within reach.
_LOOKED_AT = 4


class ChainWorld(NamedTuple):
    """Two maps, the candidate closures between them, and the truth about both.

    A pytree of arrays; `m` closures in random order, `n` poses of either robot.

    Attributes:
        problem: what Q needs, as `consistency_problem` gathers it, without padding.
        labels: int32 `[m]`: 0 true; 1, 2, … the aliased group; -1 random.
        touched: int32 `[2, m]`, the pose of robot a that each closure starts at, and that of robot
            b that it ends at.
        maps: Lie `[2, n]`, both robots' poses by odometry alone; the first of each is the identity.
        truth: Lie `[2, n]`, their true poses in one common frame.
    """

    problem: ConsistencyProblem
    labels: Int[Array, " m"]
    touched: Int[Array, "2 m"]
    maps: Any
    truth: Any

    @property
    def is_true(self) -> Bool[Array, " m"]:
        """Marks of the true closures."""
        return self.labels == 0


def simulate_chains(
    key: PRNGKeyArray,
    *,
    group: lie.Group[Any] = jaxlie.SE2,
    poses: int = 500,
    inliers: int = 15,
    aliased_groups: int = 2,
    aliased_size: int = 5,
    random: int = 90,
    sigma_translation: Any = 0.02,
    sigma_rotation: Any = 0.002,
    closure_sigma_translation: Any = 0.02,
    closure_sigma_rotation: Any = 0.01,
    blocks: int | None = None,
    reach: Any = 3.0,
) -> ChainWorld:
    """A world of two maps and `inliers + aliased_groups · aliased_size + random` closures.

    Safe under jit and vmap (over the key, deviations and `reach`); float64 where 64-bit types are
    enabled. The defaults are the paper's numbers of closures.

    Args:
        key: of `jax.random`, typed.
        group: `jaxlie.SE2` or `jaxlie.SE3`.
        poses: poses of each robot.
        inliers: true closures.
        aliased_groups: groups of false closures that agree among themselves.
        aliased_size: closures in each group.
        random: closures that agree with nothing.
        sigma_translation: standard deviation along every axis of an odometry step, metres.
        sigma_rotation: standard deviation about every axis of an odometry step, radians.
        closure_sigma_translation: of a closure likewise, metres.
        closure_sigma_rotation: of a closure likewise, radians.
        blocks: blocks of 5 m along each side of the town; by default as many as give each of its
            places two poses or so.
        reach: metres between two poses that can measure each other, or be mistaken for neighbours.

    Raises:
        InputError: a number out of range (deviations only where they are not traced).
    """
    require_at_least(0, inliers=inliers, aliased_groups=aliased_groups, random=random)
    require_at_least(1, aliased_size=aliased_size)
    require_at_least(2, poses=poses)
    counts = inliers, aliased_groups, aliased_size, random
    known = inliers + aliased_groups * aliased_size
    if known + random == 0:
        raise InputError("inliers, aliased_groups, random: all 0, expected a closure at least")
    odometry = sigma_translation, sigma_rotation
    closing = closure_sigma_translation, closure_sigma_rotation
    _require_deviations(*odometry, *closing, reach)
    chance, white = _draws(key, group, poses, counts)
    drive = functools.partial(town_drive, group=group, poses=poses, blocks=blocks)
    truth = jax.vmap(drive)(chance.drives)
    steps = lie.between(lie.take(truth, np.s_[:, :-1]), lie.take(truth, np.s_[:, 1:]))
    maps = jax.vmap(_added_up)(_measured(steps, white.steps, odometry))
    pairs = _pairs(chance, white, truth, counts, reach)
    seen, guessed = (lie.take(pairs.exact, part) for part in (np.s_[:known], np.s_[known:]))
    measurement = lie.concatenate([_measured(seen, white.closures, closing), guessed])
    order = jnp.argsort(chance.order)
    touched = jnp.stack([pairs.pose_a[order], pairs.pose_b[order]])
    problem = _problem(maps, touched, lie.take(measurement, order), odometry, closing)
    return ChainWorld(problem, pairs.labels[order], touched, maps, truth)


class _Chance(NamedTuple):
    """Uniform numbers in [0, 1)."""

    drives: Float[Array, "2 c w"]  # for every crossing: whether to turn, and each way's appeal
    meetings: Float[Array, "l s+1"]  # for every place looked at: a pose, and where around it
    alignments: Float[Array, "g n"]
    mistaken: Float[Array, "g l s+1"]
    anywhere: Float[Array, "r s+2"]
    order: Float[Array, " m"]


class _White(NamedTuple):
    """Standard normal numbers."""

    steps: Float[Array, "2 n-1 d"]
    closures: Float[Array, "k d"]
    rotations: Float[Array, "r q"]


def _draws(
    key: Any, group: Any, poses: int, counts: tuple[int, int, int, int]
) -> tuple[_Chance, _White]:
    """All that is random, by two calls: each takes seconds to compile."""
    inliers, groups, size, random = counts
    space, d = space_dim(group), lie.tangent_dim(group)
    known = inliers + groups * size
    rotation = lie.module_of(group).PARAMETERS_DIM - space
    uniform, normal = jax.random.split(key)
    chance = _cut(
        functools.partial(jax.random.uniform, uniform),
        drives=(2, 1 + crossings_left(poses), 1 + 2 * space),
        meetings=(_LOOKED_AT * inliers, 1 + space),
        alignments=(groups, 2 * ALIAS_DRAWS + space),
        mistaken=(groups, _LOOKED_AT * size, 1 + space),
        anywhere=(random, 2 + space),
        order=(known + random,),
    )
    white = _cut(
        functools.partial(jax.random.normal, normal),
        steps=(2, poses - 1, d),
        closures=(known, d),
        rotations=(random, rotation),
    )
    return _Chance(**chance), _White(**white)


def _cut(draw: Callable[[tuple[int]], Any], **shapes: tuple[int, ...]) -> dict[str, Any]:
    sizes = [math.prod(shape) for shape in shapes.values()]
    parts = jnp.split(draw((sum(sizes),)), np.cumsum(sizes)[:-1])
    named = zip(shapes.items(), parts, strict=True)
    return {name: part.reshape(shape) for (name, shape), part in named}


def _require_deviations(*values: Any) -> None:
    names = ("sigma_translation", "sigma_rotation", "closure_sigma_translation")
    names += ("closure_sigma_rotation", "reach")
    known = zip(names, values, strict=True)
    require_positive(**{name: value for name, value in known if not isinstance(value, Tracer)})


def _added_up(steps: Any) -> Any:
    """Poses `[n]` by odometry alone, the first the identity."""
    start = lie.identity(lie.group_of(steps), (1,), xp=jnp)
    return lie.normalize(lie.concatenate([start, jax.lax.associative_scan(lie.compose, steps)]))


def _measured(exact: Any, white: Float[Array, "*batch d"], sigmas: tuple[Any, Any]) -> Any:
    """The transforms `exact · exp(δ)`, δ normal."""
    group = lie.group_of(exact)
    error = jnp.stack(_deviations(group, sigmas)) * white
    return lie.compose(exact, lie.exp(group, error))


def _deviations(group: Any, sigmas: tuple[Any, Any]) -> list[Any]:
    space = space_dim(group)
    return [sigmas[0]] * space + [sigmas[1]] * (lie.tangent_dim(group) - space)


class _Pairs(NamedTuple):
    """Pose pairs `[m]`, and what a measurement without noise says of each."""

    pose_a: Any
    pose_b: Any
    exact: Any
    labels: Any


def _pairs(
    chance: _Chance, white: _White, truth: Any, counts: tuple[int, int, int, int], reach: Any
) -> _Pairs:
    """True ones, then aliased group after group, then random ones."""
    path_a, path_b = lie.take(truth, 0), lie.take(truth, 1)
    inliers, groups, size, random = counts

    def mistaken(chance: Any, around: Any) -> Any:
        moved = lie.compose(_alignment(chance, path_a, path_b, reach), path_b)
        return _meetings(around, path_a, moved, size, reach)

    aliased = jax.vmap(mistaken)(chance.alignments, chance.mistaken)
    parts = (
        _meetings(chance.meetings, path_a, path_b, inliers, reach),
        jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), aliased),
        _anywhere(chance.anywhere, white.rotations, path_a, path_b),
    )
    labels = np.repeat([*range(1 + groups), RANDOM_LABEL], [inliers, *[size] * groups, random])
    i, k, exact = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    return _Pairs(i, k, exact, jnp.asarray(labels, np.int32))


def _meetings(
    chance: Float[Array, "l s+1"], path_a: Any, path_b: Any, count: int, reach: Any
) -> tuple[Any, Any, Any]:
    """`count` pose pairs that are near each other.

    A random pose of robot a, and robot b's nearest to a random place within reach of it; where too
    few of those that are looked at are within reach of each other, the closest others follow.
    """
    here, there = lie.translation(path_a), lie.translation(path_b)
    i = index_below(chance[:, 0], len(here))
    about = here[i] + (2.0 * chance[:, 1:] - 1.0) * reach / here.shape[1] ** 0.5
    k = _nearest(about, there)
    apart = squared_lengths(here[i] - there[k])
    best = jnp.argsort(jnp.maximum(apart, reach**2), stable=True)[:count]
    return _seen(path_a, path_b, i[best], k[best])


def _nearest(places: Float[Array, "l s"], others: Float[Array, "n s"]) -> Int[Array, " l"]:
    """The first of the nearest, up to rounding; `argmin` takes five times as long on a CPU."""
    squared = squared_lengths(places[:, None] - others)
    least = squared.min(axis=1, keepdims=True)
    index = np.arange(len(others), dtype=np.int32)
    return jnp.where(squared <= least * (1.0 + 1e-6), index, len(others) - 1).min(axis=1)


def _seen(path_a: Any, path_b: Any, i: Any, k: Any) -> tuple[Any, Any, Any]:
    return i, k, lie.between(lie.take(path_a, i), lie.take(path_b, k))


def _alignment(chance: Float[Array, " n"], path_a: Any, path_b: Any, reach: Any) -> Any:
    """The wrong alignment that uniform numbers draw: two poses' indices, then the shift."""
    draws = (chance[:ALIAS_DRAWS], path_a), (chance[ALIAS_DRAWS : 2 * ALIAS_DRAWS], path_b)
    i, k = (index_below(uniform, len(lie.parameters(path))) for uniform, path in draws)
    shift = (2.0 * chance[2 * ALIAS_DRAWS :] - 1.0) * reach
    return wrong_alignment((i, k), shift, path_a, path_b)


def _anywhere(
    chance: Float[Array, "r s+2"], white: Float[Array, "r q"], path_a: Any, path_b: Any
) -> tuple[Any, Any, Any]:
    """As in `outliers`: pose k of b stands anywhere in the box around both paths, anyhow turned."""
    group, (low, high) = lie.group_of(path_a), bounding_box(path_a, path_b)
    poses = len(lie.parameters(path_a))
    i, k = index_below(chance[:, 0], poses), index_below(chance[:, 1], poses)
    place = low + chance[:, 2:] * (high - low)
    stands = lie.normalize(group(jnp.concatenate([white, place], axis=1)))
    return i, k, lie.between(lie.take(path_a, i), stands)


def _problem(
    maps: Any,
    touched: Int[Array, "2 m"],
    measurement: Any,
    odometry: tuple[Any, Any],
    closing: tuple[Any, Any],
) -> ConsistencyProblem:
    """Every closure has rows of G of its own."""
    group, count = lie.group_of(measurement), touched.shape[1]
    side = functools.partial(_touched_poses, sigmas=odometry)
    poses, cumulated = jax.vmap(side)(maps, touched)
    noise = jnp.diag(jnp.square(jnp.stack(_deviations(group, closing))))
    rows = jnp.arange(count, dtype=jnp.int32)
    return ConsistencyProblem(
        measurement=measurement,
        measurement_covariance=jnp.broadcast_to(noise, (count, *noise.shape)),
        pose_a=lie.take(poses, 0),
        pose_b=lie.take(poses, 1),
        row_a=rows,
        row_b=rows,
        relative_covariance_a=_relative_covariance(touched[0], cumulated[0]),
        relative_covariance_b=_relative_covariance(touched[1], cumulated[1]),
        valid=jnp.ones(count, bool),
    )


def _touched_poses(
    poses: Any, touched: Int[Array, " m"], sigmas: tuple[Any, Any]
) -> tuple[Any, Float[Array, "packed m"]]:
    """The poses of one map that closures touch, its origin moved to their mean, and S of them."""
    group = lie.group_of(poses)
    centre = jnp.mean(lie.translation(poses)[touched], axis=0)
    poses = group(lie.parameters(poses).at[:, -len(centre) :].add(-centre))
    variances = [sigma**2 for sigma in _deviations(group, sigmas)]
    diagonal = [
        [v if i == j else 0.0 for j in range(len(variances))] for i, v in enumerate(variances)
    ]
    reached = lie.components(lie.take(poses, np.s_[1:]))
    added = unrolled.pack(lie.module_of(group).adjoint_sandwich(reached, diagonal))
    steps = jnp.stack(jnp.broadcast_arrays(*map(jnp.asarray, added), reached[0])[:-1])
    cumulated = jnp.pad(jnp.cumsum(steps, axis=1), ((0, 0), (1, 0)))
    return lie.take(poses, touched), cumulated[:, touched]


def _relative_covariance(
    touched: Int[Array, " m"], cumulated: Float[Array, "packed m"]
) -> Float[Array, "packed m m"]:
    """G of two poses: S of the later one, less S of the earlier."""
    apart = cumulated[:, None] - cumulated[:, :, None]
    return jnp.where(touched[:, None] < touched, apart, -apart)
