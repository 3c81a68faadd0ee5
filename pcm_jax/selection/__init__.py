"""Which loop closures to believe: the paper's method and those it is compared with.

methods         the registry: `select_from`, on a matrix Q of one's own
pcm, combinatorial, ransac, scgp     the methods, one short file each
batched         `select_batched`, the same methods as kernels, for many small problems at once
soft            `soft_select`, PCM relaxed, with derivatives
within_one_map  `select_within`, the loop closures inside one robot's own map
"""

from pcm_jax.selection.batched import select_batched
from pcm_jax.selection.choice import Choice
from pcm_jax.selection.methods import METHODS, choose, select_from
from pcm_jax.selection.result import PairSelection, Selection
from pcm_jax.selection.soft import soft_select
from pcm_jax.selection.within_one_map import WithinSelection, clean_maps, select_within

__all__ = [
    "METHODS",
    "Choice",
    "PairSelection",
    "Selection",
    "WithinSelection",
    "choose",
    "clean_maps",
    "select_batched",
    "select_from",
    "select_within",
    "soft_select",
]
