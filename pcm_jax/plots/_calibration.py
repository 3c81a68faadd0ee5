"""Pictures of a calibration: residuals against what stated covariances say of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from pcm_jax.integrity import Calibration
from pcm_jax.integrity.calibration import Factors, quantiles_of
from pcm_jax.plots import style
from pcm_jax.plots.style import axes_or_new, legend_below

TINY = 1e-6
"""Squared distances below which a residual is drawn as this."""


def plot_calibration(calibration: Calibration, ax: Any = None) -> Any:
    """Draws squared residuals against chi-squared, quantile by quantile, as stated and calibrated.

    Honest covariances lie on the diagonal; a line above it has errors stated too small, one below
    it too large; a line that leaves it at the end alone has a few false closures, or tails.

    Args:
        calibration: of `calibrate`.
        ax: matplotlib axes to draw into; None makes a figure.

    Returns:
        The axes; both scales are logarithmic.
    """
    ax = axes_or_new(ax)
    components, d = calibration.components, calibration.tangent_dim
    both = (components.as_stated, "as stated"), (components.squared, "calibrated")
    drawn = []
    named = ("odometry", calibration.odometry), ("closures", calibration.closures)
    for row, (kind, told) in enumerate(named):
        for values, when in both:
            if not len(values[row]):
                continue
            expected, found = quantiles_of(values[row], d)
            look = style.series_style(row, 2)
            filled = look["color"] if when == "calibrated" else "none"
            ax.plot(
                expected,
                np.maximum(found, TINY),
                linestyle="none",
                marker=look["marker"],
                markersize=4.0,
                color=look["color"],
                markerfacecolor=filled,
                label=f"{kind}, {when}{_factors(told) if when == 'calibrated' else ''}",
            )
            drawn.append(expected)
    ends = [min(map(np.min, drawn), default=0.1), max(map(np.max, drawn), default=10.0)]
    ax.plot(ends, ends, color=style.GREY, label="honest", zorder=1.0)
    ax.set(xscale="log", yscale="log", xlabel=f"chi-squared with {d} degrees of freedom")
    ax.set_ylabel("squared residual")
    legend_below(ax, columns=1)
    return ax


def _factors(told: Factors) -> str:
    """The factors that calibrated residuals are of, in a legend's words."""
    known = [f"{name} {float(each):.3g}" for name, each in told._asdict().items() if each.known]
    return f" (information × {', '.join(known)})" if known else ""
