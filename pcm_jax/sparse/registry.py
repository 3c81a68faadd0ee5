"""The one owner of what outlives a call: plans by pattern, memory for factors, BLAS's threads.

Each part has its lock and its bound; nothing else in the package's sparse algebra is kept. What is
forgotten is made again: it costs time, and changes no number.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pcm_jax.sparse._blas import BlasThreads
from pcm_jax.sparse._memory import SpareMemory
from pcm_jax.sparse._pattern_cache import PatternCache

if TYPE_CHECKING:
    from pcm_jax.sparse._symbolic import FrontTree
    from pcm_jax.sparse.assembly import CholeskyPlan
    from pcm_jax.sparse.system import System

trees: PatternCache[FrontTree] = PatternCache()
plans: PatternCache[CholeskyPlan] = PatternCache()
systems: PatternCache[System] = PatternCache()
spare = SpareMemory()
blas = BlasThreads()
