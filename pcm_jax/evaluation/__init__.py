"""How good a result is, and what it looks like.

metrics      rates, map errors, trajectory errors
comparison   every method on the same maps, closures and Q
tables       the comparison as text
sweep        every method at every gate on thousands of simulated worlds, to Parquet files
plots        every picture; needs matplotlib
"""

from pcm_jax.evaluation.comparison import Compared, Method, compare_methods, mean_figures
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
from pcm_jax.evaluation.sweep import sweep
from pcm_jax.evaluation.tables import comparison_table

__all__ = [
    "Compared",
    "Method",
    "PoseError",
    "aligned",
    "ate_rmse",
    "compare_methods",
    "comparison_table",
    "false_positive_rate",
    "mean_figures",
    "normalized_chi2",
    "pose_error",
    "precision",
    "relative_map_pose_error",
    "relative_pose_error",
    "rotation_mse",
    "sweep",
    "translation_mse",
    "true_positive_rate",
]
