"""Every picture the package draws. Needs matplotlib, the `plot` extra.

Each function draws into the matplotlib axes given as `ax`, or makes a figure of its own, and
returns the axes; saving and showing are left to the caller.
"""

from pcm_jax.evaluation.consistency_plots import (
    plot_consistency_graph,
    plot_gate,
    plot_squared_distances,
)
from pcm_jax.evaluation.map_plots import (
    plot_comparison,
    plot_merge,
    plot_trajectories_with_closures,
)
from pcm_jax.evaluation.method_plots import (
    plot_precision_recall,
    plot_seconds,
    plot_set_size_histogram,
    plot_threshold_sweep,
    plot_threshold_sweeps,
)
from pcm_jax.evaluation.table_plots import plot_comparison_table

__all__ = [
    "plot_comparison",
    "plot_comparison_table",
    "plot_consistency_graph",
    "plot_gate",
    "plot_merge",
    "plot_precision_recall",
    "plot_seconds",
    "plot_set_size_histogram",
    "plot_squared_distances",
    "plot_threshold_sweep",
    "plot_threshold_sweeps",
    "plot_trajectories_with_closures",
]
