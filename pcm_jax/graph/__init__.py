"""Pose graphs of one and of several robots, and the checks on what users pass."""

from pcm_jax.graph.loop_closures import LoopClosures
from pcm_jax.graph.multi_robot import MultiRobotGraph
from pcm_jax.graph.padded import pad_graph
from pcm_jax.graph.pose_graph import PoseGraph
from pcm_jax.graph.spanning_tree import spanning_tree_poses
from pcm_jax.graph.split import split

__all__ = [
    "LoopClosures",
    "MultiRobotGraph",
    "PoseGraph",
    "pad_graph",
    "spanning_tree_poses",
    "split",
]
