"""Metrics of the paper, and plots (`pcm_jax.evaluation.plots`, which needs matplotlib)."""

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

__all__ = [
    "PoseError",
    "aligned",
    "ate_rmse",
    "false_positive_rate",
    "normalized_chi2",
    "pose_error",
    "precision",
    "relative_map_pose_error",
    "relative_pose_error",
    "rotation_mse",
    "translation_mse",
    "true_positive_rate",
]
