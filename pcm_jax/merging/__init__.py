"""Step iv: one map from several, with the accepted closures only.

groups      which robots the accepted closures connect
alignment   where each map lies in its group's frame, from the closures alone: a start
joint       the maps of a group as one pose graph, and its solution
result      `MergeResult`: maps, anchors, groups; its report
merge       `merge`, what users call: select, group, align, solve
"""

from pcm_jax.merging.merge import merge
from pcm_jax.merging.result import MergeResult, MergeSolution

__all__ = ["MergeResult", "MergeSolution", "merge"]
