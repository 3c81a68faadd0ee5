"""Every picture the package draws; the only importers of matplotlib. Needs the `plot` extra.

    maps           trajectories, closures by what became of them, several merges side by side
    _consistency   squared distances, the consistency graph
    _gate          the gate, and if it is right, by the law of the distances
    _methods       precision and recall, sweeps of thresholds, times, set sizes
    _calibration   residuals against what they should be
    _tables        a comparison table as a picture
    style          colours, lines and figures that all of these share

Each function draws into the matplotlib axes given as `ax`, or makes a figure of its own, and
returns the axes; saving and showing are left to the caller.
"""

from pcm_jax.plots._calibration import plot_calibration
from pcm_jax.plots._consistency import (
    plot_consistency_graph,
    plot_squared_distances,
)
from pcm_jax.plots._gate import plot_gate
from pcm_jax.plots._methods import (
    plot_precision_recall,
    plot_seconds,
    plot_set_size_histogram,
    plot_threshold_sweep,
    plot_threshold_sweeps,
)
from pcm_jax.plots._tables import plot_comparison_table
from pcm_jax.plots.maps import (
    plot_comparison,
    plot_merge,
    plot_trajectories_with_closures,
)

__all__ = [
    "plot_calibration",
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
