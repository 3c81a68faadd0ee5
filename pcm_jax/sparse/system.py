"""Normal equations of measurements that each join two blocks of unknowns, by their pattern.

`H = JᵀJ` has a block for every unknown and for every pair that an edge joins. `System` is all that
follows from which edges join which unknowns, and which unknowns are held; it is found by content
(`system_for`), so that a traced program needs to name it by nothing but the pattern itself.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax.sparse import registry
from pcm_jax.sparse.assembly import CholeskyPlan, plan_for
from pcm_jax.sparse.cholesky import CholeskyFactor, factorize


@dataclasses.dataclass(frozen=True, eq=False)
class System:
    """The pattern of normal equations, with some unknowns held fixed.

    Attributes:
        size: number of unknowns, n.
        tail, head: `[e]` unknowns that each edge joins.
        fixed: the unknowns that are held.
        plan: of the factorisation; edges between the same two unknowns share a block.
        flipped: edges between free unknowns whose block is the transposed product.
        sum_blocks: 0/1 matrices from the edges' products to the blocks of `H`: of tails, of heads,
            of both, and of both transposed.
        sum_gradient: 0/1 matrix from the edges' (tail, head) gradients to the unknowns.
    """

    size: int
    tail: Int[np.ndarray, " e"]
    head: Int[np.ndarray, " e"]
    fixed: Int[np.ndarray, " f"]
    plan: CholeskyPlan
    flipped: Int[np.ndarray, " b"]
    sum_blocks: tuple[Any, Any, Any, Any]
    sum_gradient: Any

    def factorize(
        self,
        products: Float[np.ndarray, "3 e d d"],
        damping: float = 0.0,
        memory: Float[np.ndarray, " s"] | None = None,
    ) -> CholeskyFactor:
        """Factorises `H + λ diag(H)`; fixed unknowns have identity blocks.

        Args:
            products: per edge JᵗᵀJᵗ, JʰᵀJʰ and JʰᵀJᵗ (t: tail, h: head); padding is ignored.
            damping: λ.
            memory: as for `cholesky.factorize`.

        Raises:
            NotPositiveDefiniteError: the system is singular or not finite.
        """
        plan = self.plan
        d = plan.block_dim
        turned = products[2, self.flipped].transpose(0, 2, 1)
        parts = *products[:, : len(self.tail)], turned
        blocks = np.zeros((len(plan.block_row), d, d))
        for sums, part in zip(self.sum_blocks, parts, strict=True):
            blocks += (sums @ part.reshape(len(part), d * d)).reshape(blocks.shape)
        scalar = np.arange(d)
        blocks[: self.size, scalar, scalar] *= 1.0 + damping
        blocks[plan.position[self.fixed]] = np.eye(d)
        return factorize(plan, blocks, memory)

    def gradient(self, gradients: Float[np.ndarray, "2 e d"]) -> Float[np.ndarray, "n d"]:
        """Jᵀ r of every unknown; zero for fixed ones."""
        terms = np.ascontiguousarray(gradients[:, : len(self.tail)])
        return self.sum_gradient @ terms.reshape(-1, gradients.shape[2])


def system_for(
    size: int,
    tail: Int[np.ndarray, " e"],
    head: Int[np.ndarray, " e"],
    fixed: Bool[np.ndarray, " n"],
    block_dim: int,
) -> System:
    """The system of a pattern, made once and then found by content.

    Args:
        size: number of unknowns, n.
        tail, head: unknowns that each edge joins; copied, where they are kept.
        fixed: the unknowns that are held.
        block_dim: scalars of an unknown.
    """
    held = np.flatnonzero(fixed)
    return registry.systems.get(
        lambda: _make_system(
            size, np.array(tail, np.int64), np.array(head, np.int64), held, block_dim
        ),
        size,
        block_dim,
        tail,
        head,
        held,
    )


def _make_system(
    size: int, tail: np.ndarray, head: np.ndarray, fixed: np.ndarray, block_dim: int
) -> System:
    free = np.ones(size, bool)
    free[fixed] = False
    tails, heads = np.flatnonzero(free[tail]), np.flatnonzero(free[head])
    both = np.flatnonzero(free[tail] & free[head])
    plan = plan_for(size, tail[both], head[both], block_dim)
    as_given, flipped = ~plan.edge_transposed, plan.edge_transposed
    blocks, edges = len(plan.block_row), len(tail)
    sum_blocks = (
        _ones(plan.position[tail[tails]], tails, (blocks, edges)),
        _ones(plan.position[head[heads]], heads, (blocks, edges)),
        _ones(plan.edge_block[as_given], both[as_given], (blocks, edges)),
        _ones(plan.edge_block[flipped], np.arange(flipped.sum()), (blocks, flipped.sum())),
    )
    unknown, source = np.concatenate([tail[tails], head[heads]]), np.append(tails, heads + edges)
    sum_gradient = _ones(unknown, source, (size, 2 * edges))
    return System(size, tail, head, fixed, plan, both[flipped], sum_blocks, sum_gradient)


def _ones(row: np.ndarray, column: np.ndarray, shape: tuple[int, int]) -> Any:
    from scipy.sparse import csr_array

    return csr_array((np.ones(len(row)), (row, column)), shape=shape)
