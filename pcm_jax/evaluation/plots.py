"""Every picture the package draws. Needs matplotlib, the `plot` extra.

Each function draws into the matplotlib axes given as `ax`, or makes a figure of its own, and
returns the axes; saving and showing are left to the caller.
"""

from pcm_jax.evaluation.consistency_plots import (
    plot_consistency_graph,
    plot_set_size_histogram,
    plot_squared_distances,
    plot_threshold_sweep,
)
from pcm_jax.evaluation.map_plots import (
    plot_comparison,
    plot_merge,
    plot_trajectories_with_closures,
)

__all__ = [
    "plot_comparison",
    "plot_consistency_graph",
    "plot_merge",
    "plot_set_size_histogram",
    "plot_squared_distances",
    "plot_threshold_sweep",
    "plot_trajectories_with_closures",
]
