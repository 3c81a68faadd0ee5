"""Measures of a result: rates of closures, errors of maps and trajectories, and their table.

    metrics        rates, map errors, trajectory errors
    _pairing       estimated poses and their true ones
    trajectories   absolute and relative errors of several robots, as evo defines them

Their table, `comparison_table`, is one of `pcm_jax.tables`.
"""

from pcm_jax.evaluation.metrics import (
    PoseError,
    aligned,
    ate_rmse,
    false_positive_rate,
    normalized_chi2,
    pose_error,
    precision,
    relative_map_pose_error,
    relative_pose_error,
    rotation_mse,
    translation_mse,
    true_positive_rate,
)
from pcm_jax.evaluation.trajectories import (
    Errors,
    RobotErrors,
    Statistics,
    TrajectoryErrors,
    trajectory_errors,
)
from pcm_jax.tables import comparison_table

__all__ = [
    "Errors",
    "PoseError",
    "RobotErrors",
    "Statistics",
    "TrajectoryErrors",
    "aligned",
    "ate_rmse",
    "comparison_table",
    "false_positive_rate",
    "normalized_chi2",
    "pose_error",
    "precision",
    "relative_map_pose_error",
    "relative_pose_error",
    "rotation_mse",
    "trajectory_errors",
    "translation_mse",
    "true_positive_rate",
]
