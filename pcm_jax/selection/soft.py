"""Soft PCM: the maximum clique of a soft consistency graph, differentiable in the distances.

Soft adjacency, τ the temperature and q²_uv the larger of a pair's two directions:

    a_uv = σ((γ² − q²_uv) / τ)

Relaxed clique: with B = A + I/2, the maxima of xᵀBx over the simplex (x ≥ 0, Σx = 1) are, for a
graph of zeros and ones, the maximal cliques and nothing else, x uniform on each, and a clique of ω
vertices has the value 1 − 1/(2ω) (Motzkin and Straus 1965; with the diagonal, Bomze 1997). So the
largest clique is the global maximum, and ω = 1 / (2 − 2 xᵀBx) reads a size from any x.

Local maxima are climbed to by replicator dynamics in its exponential form (Pelillo 1999),
x ← x exp(κ B x) / Σ with κ = 2ω, from the closed neighbourhood of every vertex and from the maximum
clique of the graph within the gate. Climbing alone cannot always find the largest, which is
NP-hard; the last start, exact and with no derivative of its own, is a fixed point as τ → 0. Then

    members   min(1, ω x_i): 1 in a clique where nothing is contradicted. At a maximum it equals
              1 − 2 Σ_j (1 − a_ij) ω x_j, and a pair with a_uv < 1/2 does not keep both its members
    result    their mean over the starts, weighted by exp(ω / T)

with T = τ / γ². As τ → 0 only the starts that found the most remain: PCM's own answer where the
maximum is unique, and a mean over the maxima where it is not.

**From PyTorch**, by DLPack, without a copy; any other function likewise:

```python
import torch

class SoftSelect(torch.autograd.Function):
    @staticmethod
    def forward(ctx, squared):
        run = lambda q: pcm.soft_select(q, gate, temperature=1.0)
        weights, ctx.back = jax.vjp(run, jax.dlpack.from_dlpack(squared.detach().contiguous()))
        return torch.from_dlpack(weights)

    @staticmethod
    def backward(ctx, slope):
        return torch.from_dlpack(ctx.back(jax.dlpack.from_dlpack(slope.contiguous()))[0])
```
"""

from __future__ import annotations

from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from pcm_jax import lie
from pcm_jax.arrays import as_real
from pcm_jax.clique import maximum_clique_batched
from pcm_jax.errors import InputError

STEPS = 20
RATE = 2.0
"""κ/ω: a vertex that misses one member of a clique keeps 1/e of its share in each step."""
SMALLEST = 1e-30
"""Of gates and temperatures: quotients of two still are numbers."""
MOST_SEARCHED = 1 << 17
"""Steps after which the exact search hands over the best clique that it has."""


def soft_select(
    squared: Float[Array, "m m"],
    gate: Any,
    *,
    temperature: Any,
    valid: Bool[Array, " m"] | None = None,
    steps: int = STEPS,
) -> Float[Array, " m"]:
    """Weighs how far each measurement belongs to the largest consistent set, differentiably.

    A relaxation of PCM (regularised Motzkin-Straus, by replicator dynamics; see
    `pcm_jax.selection.soft`). Safe under jit, vmap, grad and jvp, with respect to `squared`, `gate`
    and `temperature`. Takes memory for m² · `steps` numbers under grad: map large batches by
    `jax.lax.map(..., batch_size=)`.

    Args:
        squared: squared distances q², as in `select_from`; the larger of a pair's two directions
            counts (equal ones share the derivative). What is not finite agrees with nothing, and
            has derivative zero. The diagonal is ignored.
        gate: γ², above zero.
        temperature: τ, above zero, in the unit of q²: pairs within about τ of the gate are
            undecided, and sets that differ by fewer than τ/γ² members compete. Around γ²/10 the
            result is informative; towards zero it is PCM's, and its derivatives vanish.
        valid: the measurements that count; the others get zero and change nothing. All, by default.
        steps: of the dynamics.

    Returns:
        In [0, 1]; the limit as τ → 0 is the mask of `select_from(method="pcm-exact")`, provided
        that the largest set is unique, no pair lies on the gate, and the exact search ends within
        131,072 steps (beyond which it starts from the best set found).

    Raises:
        InputError: for distances that are not square, and for a concrete gate or temperature that
            is not a number above zero.
    """
    for name, given in (("gate", gate), ("temperature", temperature)):
        _check_positive(name, given)
    if not isinstance(squared, jax.Array):
        as_real(squared, "squared")  # which refuses what is none; the precision stays
        squared = cast(Any, np.asarray(squared))
    shape = jnp.shape(squared)
    if len(shape) != 2 or shape[0] != shape[1]:
        raise InputError(f"squared: shape {shape}, expected [m, m]")
    counted = np.ones(shape[0], bool) if valid is None else valid
    with lie.own_precision((squared, gate, temperature)):
        return _relaxed(jnp.asarray(squared), gate, temperature, counted, steps)


def _check_positive(name: str, given: Any) -> None:
    if isinstance(given, Tracer):
        return
    value = as_real(given, name)
    if value.ndim or not SMALLEST < value < np.inf:
        raise InputError(f"{name}: {given}, expected a number above zero")


def _soft(squared: Any, gate: Any, temperature: Any, valid: Any, steps: int) -> Any:
    m = len(squared)
    if m == 0:
        return jnp.zeros(0, squared.dtype)
    adjacency = soft_adjacency(squared, gate, temperature, valid)
    payoff = adjacency + 0.5 * jnp.eye(m, dtype=adjacency.dtype)
    x = _climb(payoff, _starts(adjacency, valid), steps)
    size = _size(x, x @ payoff)
    member = jnp.minimum(size[:, None] * x, 1.0)
    # The exact start counts for a vertex of its own, so that there is one where none is valid.
    size = jnp.where(jnp.append(valid, True), size, 0.0)
    weight = jax.nn.softmax((size - jnp.max(size)) * (gate / temperature))
    return jnp.where(valid, weight @ member, 0.0)


_relaxed = jax.jit(_soft, static_argnums=4)


def soft_adjacency(
    squared: Float[Array, "m m"], gate: Any, temperature: Any, valid: Bool[Array, " m"]
) -> Float[Array, "m m"]:
    """a_uv, zero on the diagonal and for what does not count."""
    larger = jnp.maximum(squared, squared.T)
    both = valid[:, None] & valid[None, :] & ~np.eye(len(squared), dtype=bool)
    known = both & jnp.isfinite(larger)
    # Not even a derivative by the temperature may meet an infinite distance.
    margin = gate - jnp.where(known, larger, 0.0)
    return jnp.where(known, jax.nn.sigmoid(margin / temperature), 0.0)


def _starts(adjacency: Float[Array, "m m"], valid: Bool[Array, " m"]) -> Float[Array, "m+1 m"]:
    """Every closed neighbourhood and the maximum clique within the gate, on the simplex."""
    exact = maximum_clique_batched(adjacency >= 0.5, valid=valid, max_steps=MOST_SEARCHED).members
    near = adjacency + jnp.eye(len(adjacency), dtype=adjacency.dtype)
    starts = jnp.concatenate([near, exact[None].astype(near.dtype)])
    total = jnp.sum(starts, axis=1, keepdims=True)
    return starts / jnp.where(total > 0.0, total, 1.0)


def _size(x: Float[Array, "k m"], earned: Float[Array, "k m"]) -> Float[Array, " k"]:
    """ω, from x and B x."""
    return 0.5 / (1.0 - jnp.sum(x * earned, axis=1))


def _climb(
    payoff: Float[Array, "m m"], starts: Float[Array, "k m"], steps: int
) -> Float[Array, "k m"]:
    """The dynamics from every start, so many steps of them."""

    @jax.checkpoint
    def step(x: Any, _: None) -> tuple[Any, None]:
        earned = x @ payoff
        rate = RATE * _size(x, earned)[:, None]
        grown = x * jnp.exp(rate * (earned - jnp.max(earned, axis=1, keepdims=True)))
        total = jnp.sum(grown, axis=1, keepdims=True)
        return grown / jnp.where(total > 0.0, total, 1.0), None

    return jax.lax.scan(step, starts, None, length=steps)[0]
