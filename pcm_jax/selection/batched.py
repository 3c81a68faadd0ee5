"""The selection methods as pure kernels, for many small problems at once.

A kernel takes one matrix and returns one mask; the shape alone fixes the work, so that worlds are
batched by `vmap`, in blocks that fit into cache (PCM-Exact, whose work depends on the world, gets
all worlds at once and shares them out itself). With the same rules for ties as the host's methods
of the same names, kernels return the same sets; each stands beside its host's form in `methods`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from pcm_jax.arrays import standard_rules
from pcm_jax.errors import InputError
from pcm_jax.selection.method import SelectionMethod
from pcm_jax.selection.methods import METHODS

_BLOCK = 1 << 20  # entries of the largest array within a block of worlds

KERNELS = tuple(name for name, method in METHODS.items() if method.kernel is not None)
"""The methods that have a kernel, by name."""


@standard_rules()
def select_batched(
    squared: Float[Array, "*batch m m"],
    gate: Any,
    *,
    method: str | Callable[..., Bool[Array, " m"]] = "pcm-exact",
    **options: Any,
) -> Bool[Array, "*batch m"]:
    """Selects by a method in each of many small problems; jit it.

    Args:
        squared: [..., m, m], squared distances, as in `select_from`.
        gate: γ², one number.
        method: as in `select_from`, or a traceable function of one matrix and the gate to bool [m].
        **options: `affinity` of `"scgp"`.

    Returns:
        bool [..., m], what `select_from` returns for each matrix in the same precision.

    Raises:
        InputError: an unknown method, or more measurements than 32 for `"combinatorial"` or
            128 for `"pcm-exact"`.
    """
    chosen = kernel_of(method)
    *batch, m, _ = squared.shape
    if m == 0:
        return jnp.zeros((*batch, 0), bool)
    worlds = squared.reshape(-1, m, m)
    block = max(1, _BLOCK // chosen.entries(m)) if chosen.entries else len(worlds)
    kernel: Any = partial(chosen.kernel, gate=gate, **options)  # type: ignore[arg-type]
    members = jax.lax.map(kernel, worlds, batch_size=block)
    return members.reshape(*batch, m)


def kernel_of(
    method: str | Callable[..., Any], argument: str = "method", choice: str = "one"
) -> SelectionMethod:
    """The record of a method that has a kernel, or one made of a function."""
    if callable(method):
        return SelectionMethod(getattr(method, "__name__", "function"), method, kernel=method)
    if method not in KERNELS:
        raise InputError(f"{argument}: {method!r}, expected {choice} of {', '.join(KERNELS)}")
    return METHODS[method]
