"""Step iii, the loop closures to believe: the paper's method and those it is compared with.

method           what a method is (`SelectionMethod`), and what it returns (`Choice`)
_distances       the two ways to read distances that are not symmetric
methods/         one file a method, the host's form and the kernel side by side
choose           `select_from` and `choose`: a method by name, or as a function, on one pair
weights          which methods go by closures' weights; what is said where one cannot
batched          `select_batched`: the kernels, on many small problems at once
soft             `soft_select`: PCM relaxed, with derivatives
within_one_map   `WithinSelection`: what `pipeline.select_within` returns
result           `Selection`, `PairSelection`: what `pipeline.select` returns
"""

from pcm_jax.selection.batched import select_batched
from pcm_jax.selection.choose import choose, select_from
from pcm_jax.selection.method import Choice, SelectionMethod
from pcm_jax.selection.methods import METHODS
from pcm_jax.selection.methods.jcbb import repair
from pcm_jax.selection.result import PairSelection, Selection
from pcm_jax.selection.soft import soft_select
from pcm_jax.selection.within_one_map import WithinSelection

__all__ = [
    "METHODS",
    "Choice",
    "PairSelection",
    "Selection",
    "SelectionMethod",
    "WithinSelection",
    "choose",
    "repair",
    "select_batched",
    "select_from",
    "soft_select",
]
