"""Step iv: one map from several, with the accepted closures only.

groups           which robots the accepted closures connect
alignment        where each map lies in its group's frame, from the closures alone: a start
_frames          whose frame a group's priors are in, and whether it is one
joint            the maps of a group as one pose graph, and its solution
robust/          the same, of all closures, scaled by how well they fit
merged           every group at its optimum, and the poses back in the robots' maps
_innovation      edges against the map that the others make
consensus        the closures of a set that the map takes in as it grows
recall           edges that were left out, but agree with the merged map, come back
refine           that, and graduated non-convexity before it
refinement       `Refinement`: what these changed
_untied          directions in which closures of singular information leave a map free
_strain          which part of a merge does not fit
_one_more_or_less     how far the anchors would move if a closure were decided the other way
_report          the rows of its report
result           `MergeResult`: maps, anchors, groups; its report
differentiable   `merge_differentiable`: the same solve as one traced function, with derivatives
compile_time     how long JAX compiled meanwhile
"""

from pcm_jax.merging._strain import TOO_BAD
from pcm_jax.merging.differentiable import merge_differentiable
from pcm_jax.merging.refinement import JointTest, Refinement
from pcm_jax.merging.result import MergeResult, MergeSolution
from pcm_jax.merging.robust import ROBUST_METHODS, RobustSolution

__all__ = [
    "ROBUST_METHODS",
    "TOO_BAD",
    "JointTest",
    "MergeResult",
    "MergeSolution",
    "Refinement",
    "RobustSolution",
    "merge_differentiable",
]
