"""Step iv: one map from several, with the accepted closures only.

groups      which robots the accepted closures connect
alignment   where each map lies in its group's frame, from the closures alone: a start
joint       the maps of a group as one pose graph, and its solution
robust      the same, of all closures, scaled by how well they fit; robust_methods by name,
            robust_weights: their kernels
result      `MergeResult`: maps, anchors, groups; its report
merge       `merge`, what users call: select, group, align, solve
differentiable     `merge_differentiable`: the same solve as one traced function, with derivatives
"""

from pcm_jax.merging.differentiable import merge_differentiable
from pcm_jax.merging.merge import merge
from pcm_jax.merging.result import MergeResult, MergeSolution
from pcm_jax.merging.robust import RobustSolution
from pcm_jax.merging.robust_methods import ROBUST_METHODS

__all__ = [
    "ROBUST_METHODS",
    "MergeResult",
    "MergeSolution",
    "RobustSolution",
    "merge",
    "merge_differentiable",
]
