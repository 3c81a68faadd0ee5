"""Host code called from a compiled program: without copies on a CPU, by copies elsewhere.

On a CPU the numbers cross over by JAX's buffer callback, which hands over the memory itself;
`jax.pure_callback` copies its arguments on JAX's own threads, and deadlocks where those wait for
the callback (jax issue 24255; it does on one core). On other devices the buffers are not the
host's, and `pure_callback`, which brings them there, is the one that works. What is compiled for a
CPU holds nothing of the other way.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

Body = Callable[..., None]


def call_host(body: Body, struct: jax.ShapeDtypeStruct, *arguments: Any) -> Array:
    """Calls `body(out, *arguments)` on the host, with NumPy arrays; under vmap one by one.

    Args:
        body: fills `out`, and keeps none of its arguments, which are gone after the call.
        struct: of `out`.
        arguments: arrays.
    """
    return jax.lax.platform_dependent(
        *arguments, cpu=_by_buffers(body, struct), default=_by_copies(body, struct)
    )


def _by_buffers(body: Body, struct: jax.ShapeDtypeStruct) -> Callable[..., Array]:
    from jax.experimental.buffer_callback import buffer_callback

    def call(context: Any, out: Any, *arguments: Any) -> None:
        del context
        body(np.asarray(out), *map(np.asarray, arguments))

    return buffer_callback(call, struct, vmap_method="sequential")


def _by_copies(body: Body, struct: jax.ShapeDtypeStruct) -> Callable[..., Array]:
    def call(*arguments: Any) -> np.ndarray:
        out = np.empty(struct.shape, struct.dtype)
        body(out, *map(np.asarray, arguments))
        return out

    def traced(*arguments: Any) -> Array:
        return jax.pure_callback(call, struct, *arguments, vmap_method="sequential")

    return traced
