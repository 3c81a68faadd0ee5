"""A small network that judges closures by their features, and what follows from its judgement.

Of every closure it predicts three deviations and a score ℓ, the log odds of being right. Then

    Q     squared Mahalanobis distances under the predicted covariances; each closure of a pair adds
          −2 log σ(ℓ), so that what looks doubtful has to agree better
    s     soft_select(Q) · σ(ℓ), between 0 and 1
    map   merge_differentiable with weights s and the predicted information

all of it differentiable. Losses, of one world each:

    through     10 · cross-entropy of s + log(ATE of the map + 5 cm)
    selection   the first of these only
    apart       no Q, s or map: cross-entropy of σ(ℓ), and the likelihood of the true closures'
                errors, which only a simulation knows
    classifier  cross-entropy of σ(ℓ) only
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from benchmarks.experiments.learning_worlds import FEATURES, SIGMA, LearningWorld
from pcm_jax import (
    MultiRobotGraph,
    chi2_gate,
    merge_differentiable,
    soft_select,
    squared_mahalanobis,
)
from pcm_jax.evaluation import ate_rmse

GATE = float(chi2_gate(0.99, 3))
TEMPERATURE = 1.0
WIDTH, DEPTH = 32, 2
START = np.array([0.7, 0.7, 0.7, 3.0])
"""Before training: all deviations twice `SIGMA`, all closures probably right."""


class Judged(NamedTuple):
    """Beliefs about each closure.

    Attributes:
        sigma: `[m, 3]`, deviations; m, m, rad.
        score: `[m]`, log odds of being right.
    """

    sigma: Float[Any, "m 3"]
    score: Float[Any, " m"]


class Judge(eqx.Module):
    """From features to a judgement."""

    network: eqx.nn.MLP

    def __init__(self, key: Any):
        self.network = eqx.nn.MLP(len(FEATURES), 4, WIDTH, DEPTH, jax.nn.tanh, key=key)

    def __call__(self, features: Float[Array, "m f"]) -> Judged:
        """Judges all closures of one world."""
        raw = jax.vmap(self.network)(features) + START
        return Judged(SIGMA * jnp.exp(raw[:, :3]), raw[:, 3])


def all_alike(world: LearningWorld, scale: float) -> Judged:
    """All closures surely right, with `scale` times the least deviations."""
    count = len(world.features)
    return Judged(jnp.tile(scale * SIGMA, (count, 1)), jnp.full(count, jnp.inf))


def selected(world: LearningWorld, judged: Judged) -> Float[Array, " m"]:
    """The share s by which each closure is believed."""
    covariance = jax.vmap(jnp.diag)(judged.sigma**2)
    problem = dataclasses.replace(world.problem, measurement_covariance=covariance)
    doubt = -2.0 * jax.nn.log_sigmoid(judged.score)
    squared = squared_mahalanobis(problem) + doubt + doubt[:, None]
    chosen = soft_select(squared, GATE, temperature=TEMPERATURE)
    return chosen * jax.nn.sigmoid(judged.score)


def map_error(world: LearningWorld, judged: Judged, weights: Float[Array, " m"]) -> Array:
    """ATE of the merged map, m; NaN where it has no optimum."""
    information = jax.vmap(jnp.diag)(judged.sigma**-2)
    closures = dataclasses.replace(world.graph.closures, information=information)
    merged = merge_differentiable(MultiRobotGraph(world.graph.maps, closures), weights)
    return ate_rmse(merged, world.truth, align="umeyama")


def cross_entropy(probability: Float[Array, " m"], right: Bool[Array, " m"]) -> Array:
    """Its mean, of probabilities kept 1e-6 away from certainty."""
    p = jnp.clip(probability, 1e-6, 1.0 - 1e-6)
    return -jnp.mean(jnp.where(right, jnp.log(p), jnp.log1p(-p)))


def through(judged: Judged, world: LearningWorld) -> Array:
    """Loss by selection and map."""
    chosen = selected(world, judged)
    error = map_error(world, judged, chosen)
    known = jnp.isfinite(error)
    off = jnp.where(known, jnp.log(jnp.where(known, error, 1.0) + 0.05), 0.0)
    return 10.0 * cross_entropy(chosen, world.right) + off


def selection(judged: Judged, world: LearningWorld) -> Array:
    """Loss by selection."""
    return cross_entropy(selected(world, judged), world.right)


def classifier(judged: Judged, world: LearningWorld) -> Array:
    """Loss by the score alone."""
    return cross_entropy(jax.nn.sigmoid(judged.score), world.right)


def apart(judged: Judged, world: LearningWorld) -> Array:
    """Loss by the score, and by the errors of the true closures."""
    squared = (world.error / judged.sigma) ** 2
    unlikely = jnp.sum(0.5 * squared + jnp.log(judged.sigma), axis=1)
    return classifier(judged, world) + jnp.mean(unlikely, where=world.right)


def fit(
    loss: Callable[[Judged, LearningWorld], Array],
    data: LearningWorld,
    *,
    seed: int,
    steps: int,
    batch: int = 16,
    rate: float = 5e-3,
    start: Judge | None = None,
) -> tuple[Judge, Float[np.ndarray, " steps"]]:
    """A judge trained by Adam on batches of the worlds, and the loss at every step."""
    import optax

    judge = Judge(jax.random.key(seed)) if start is None else start
    optimizer = optax.chain(
        optax.clip_by_global_norm(1.0), optax.adam(optax.cosine_decay_schedule(rate, steps))
    )

    def mean_loss(judge: Judge, worlds: LearningWorld) -> Array:
        return jnp.mean(jax.vmap(lambda world: loss(judge(world.features), world))(worlds))

    @eqx.filter_jit
    def step(judge: Judge, state: Any, worlds: LearningWorld) -> Any:
        value, gradient = eqx.filter_value_and_grad(mean_loss)(judge, worlds)
        change, state = optimizer.update(gradient, state)
        return eqx.apply_updates(judge, change), state, value

    state = optimizer.init(eqx.filter(judge, eqx.is_inexact_array))
    generator, values = np.random.default_rng(seed), []
    for _ in range(steps):
        rows = generator.choice(len(data.right), batch, replace=False)
        worlds = jax.tree.map(lambda leaf, rows=rows: leaf[rows], data)
        judge, state, value = step(judge, state, worlds)
        values.append(float(value))
    return judge, np.array(values)


@functools.partial(jax.jit, static_argnums=0)
def each(function: Callable[..., Array], *stacks: Any) -> Array:
    """A function of one world, of all worlds of a stack."""
    return jax.lax.map(lambda one: function(*one), stacks)
