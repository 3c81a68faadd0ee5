"""Pose graphs of one and of several robots, in NumPy, and the checks on what users pass.

checked         poses, measurements and uncertainty as users may pass them
validation      the checks themselves, which name their first culprit
unsaid          information that lacks directions: its rank, and what is left unsaid
symbols         GTSAM's symbol keys
_printed        how finely measurements were printed
copies          measurements that are stated more than once
priors          `Priors`: poses that were measured by themselves
spanning_tree   poses by composing measurements along a tree; connectedness
pose_graph      `PoseGraph`: one robot's map
loop_closures   `LoopClosures`: measurements between robots
multi_robot     `MultiRobotGraph`: maps and the closures between them
split           one trajectory cut into several robots' maps
padded          graphs of different sizes filled up to one
"""

from pcm_jax.graph.loop_closures import LoopClosures
from pcm_jax.graph.multi_robot import MultiRobotGraph
from pcm_jax.graph.padded import pad_graph
from pcm_jax.graph.pose_graph import PoseGraph
from pcm_jax.graph.priors import Priors
from pcm_jax.graph.spanning_tree import spanning_tree_poses
from pcm_jax.graph.split import split

__all__ = [
    "LoopClosures",
    "MultiRobotGraph",
    "PoseGraph",
    "Priors",
    "pad_graph",
    "spanning_tree_poses",
    "split",
]
