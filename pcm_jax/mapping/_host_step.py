"""One step's linear system on the host: assembled, factorised and solved by `sparse`.

Called back from the compiled program (`_normal_equations`), or step by step (`_stepwise`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pcm_jax.sparse import registry
from pcm_jax.sparse.cholesky import NotPositiveDefiniteError
from pcm_jax.sparse.system import System, system_for


def system_of(pattern: Sequence[np.ndarray], block_dim: int) -> System:
    """The system of a padded pattern: tail, head, free and counts, as a callback is given them."""
    tail, head, free, counts = pattern
    poses, edges = counts.tolist()
    return system_for(poses, tail[:edges], head[:edges], ~free[:poses], block_dim)


def solve_on_host(out: np.ndarray, *arguments: np.ndarray) -> None:
    """Body of the callback: δ into `out`, NaN if there is no factor."""
    *pattern, damping, products, gradients, below = arguments
    system = system_of(pattern, products.shape[-1])
    gradient = system.gradient(gradients.astype(np.float64, copy=False))
    if below.any():
        diagonal = system.gradient(np.diagonal(products[:2], axis1=2, axis2=3))
        gradient += np.sqrt(damping * diagonal) * below[: system.size]
    out[...] = 0.0
    with registry.spare.borrow(system.plan.scalars) as memory:
        try:
            numbers = products.astype(np.float64, copy=False), float(damping)
            factor = system.factorize(*numbers, memory)
        except NotPositiveDefiniteError:
            out[...] = np.nan
        else:
            out[: system.size] = factor.solve(gradient.ravel()).reshape(gradient.shape)
