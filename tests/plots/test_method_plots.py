"""Plots that compare methods, and their tables."""

import matplotlib as mpl
import numpy as np
import pytest
from drawn import legend_of, line
from matplotlib import pyplot

from pcm_jax import plots
from pcm_jax.errors import InputError
from pcm_jax.plots import style as plot_style

mpl.use("Agg")

ROWS = {
    "no-outliers": {"tpr": 1, "fpr": 0.0, "mse": 0.2756, "solver": "converged"},
    "scgp": {"tpr": 0.668, "fpr": 0.0514, "mse": 623.4, "solver": "converged"},
    "dcs": {"tpr": 0, "fpr": 0, "mse": 183_078.4, "solver": "stopped"},
    "pcm": {"tpr": 0.9996, "fpr": 0.00004, "mse": np.nan},
}


def test_methods_differ_in_more_than_colour():
    styles = [plot_style.series_style(k, 6) for k in range(6)]
    for looks in ("color", "marker", "linewidth", "markersize"):
        assert len({style[looks] for style in styles}) == 6


def test_a_sweep_draws_means_and_bands_over_versions():
    confidence = np.array([0.1, 0.5, 0.9])
    versions = np.array([[0.0, 0.5, 1.0], [1.0, 0.5, 1.0]])
    ax = plots.plot_threshold_sweep(
        confidence, {"PCM": versions, "SCGP": versions[0]}, ylabel="TPR", percent=True
    )
    assert line(ax, "PCM").get_ydata().tolist() == [50.0, 50.0, 100.0]
    assert line(ax, "SCGP").get_ydata().tolist() == [0.0, 50.0, 100.0]
    assert len(ax.collections) == 1  # one band: SCGP has a single version
    assert ax.get_ylabel() == "TPR (%)"
    assert line(ax, "PCM").get_marker() != line(ax, "SCGP").get_marker()
    with pytest.raises(InputError, match="PCM"):
        plots.plot_threshold_sweep(confidence, {"PCM": np.ones(2)}, ylabel="TPR")


def test_set_sizes_are_shares_of_worlds():
    exact, heuristic = np.array([5, 6, 7, 7]), np.array([5, 6, 6, 7])
    ax = plots.plot_set_size_histogram({"exact": exact, "heuristic": heuristic}, reference=exact)
    heights = [[patch.get_height() for patch in bars] for bars in ax.containers]
    assert heights == [[0.0, 100.0], [25.0, 75.0]]
    assert legend_of(ax) == ["exact", "heuristic"]
    absolute = plots.plot_set_size_histogram({"exact": exact})
    assert [patch.get_height() for patch in absolute.containers[0]] == [25.0, 25.0, 50.0]
    with pytest.raises(InputError, match="reference"):
        plots.plot_set_size_histogram({"exact": exact}, reference=exact[:2])


def test_a_sweep_can_be_over_anything():
    ax = plots.plot_threshold_sweep(
        np.arange(3), {"PCM": np.array([1.0, np.nan, 3.0])}, ylabel="ATE (m)", xlabel="drift (m)"
    )
    assert ax.get_xlabel() == "drift (m)"
    assert np.isnan(line(ax, "PCM").get_ydata()[1])


def test_sweeps_share_one_axis_and_one_legend():
    """As in Fig. 4: three figures of merit of three methods at twenty thresholds."""
    confidence = np.linspace(0.05, 0.99, 20)
    methods = ("PCM-Exact", "PCM-HeuPatt", "RANSAC")
    panels = {
        name: {method: np.full((4, 20), value) for method in methods}
        for name, value in (("TPR", 1.0), ("FPR", 0.01), ("normalised χ²", 1.2))
    }
    axes = plots.plot_threshold_sweeps(confidence, panels, percent=("TPR", "FPR"))
    assert [ax.get_ylabel() for ax in axes] == ["TPR (%)", "FPR (%)", "normalised χ²"]
    assert [line(ax, "RANSAC").get_ydata()[0] for ax in axes] == [100.0, 1.0, 1.2]
    assert [ax.get_legend() is None for ax in axes] == [True, True, False]
    assert [bool(ax.get_xlabel()) for ax in axes] == [False, False, True]
    assert legend_of(axes[2]) == list(methods)
    axes[0].set_xlim(0.0, 1.0)
    assert axes[2].get_xlim() == (0.0, 1.0)
    given = pyplot.figure().subplots(1, 3)
    assert plots.plot_threshold_sweeps(confidence, panels, axes=given) == list(given)


def test_times_are_medians_and_end_where_a_method_gave_up():
    sizes = np.array([10, 100, 1000])
    slow = np.array([[1.0, 5.0, 7.0], [2.0, 6.0, np.nan], [9.0, 7.0, 8.0]])
    ax = plots.plot_seconds(sizes, {"exact": slow, "greedy": np.array([1e-3, 1e-2, 1e-1])})
    drawn = line(ax, "exact").get_ydata()
    assert drawn[:2].tolist() == [2.0, 6.0]
    assert np.isnan(drawn[2])
    assert np.transpose(line(ax, "gave up").get_data()).tolist() == [[100.0, 6.0]]
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    assert ax.get_ylabel() == "time (s)"
    assert len(ax.collections) == 1  # one band: the other method was timed once
    assert "gave up beyond" not in legend_of(plots.plot_seconds(sizes, {"greedy": sizes}))
    with pytest.raises(InputError, match="seconds"):
        plots.plot_seconds(sizes, {"exact": np.ones(2)})


def test_precision_and_recall_are_a_row_for_each_method():
    scores = {
        "PCM": {"precision": np.array([0.9, 1.0]), "recall": 0.8},
        "DCS": {"precision": np.nan, "recall": 0.0},
    }
    ax = plots.plot_precision_recall(scores)
    precision, recall = (c for c in ax.collections if c.get_label() in ("precision", "recall"))
    assert precision.get_offsets()[:, 0].tolist()[0] == pytest.approx(95.0)
    assert np.ma.getmaskarray(np.ma.masked_invalid(precision.get_offsets()[:, 0]))[1]
    assert recall.get_offsets()[:, 0].tolist() == [80.0, 0.0]
    top, below = recall.get_offsets()[:, 1]
    assert top < below
    assert ax.yaxis_inverted()
    assert [text.get_text() for text in ax.get_yticklabels()] == ["PCM", "DCS"]
    assert not np.allclose(precision.get_facecolors(), recall.get_facecolors())
    assert legend_of(ax) == ["precision", "recall"]


def test_a_table_is_drawn_with_the_same_texts():
    columns = {"tpr": "TPR", "mse": "translation\nMSE (m²)"}
    ax = plots.plot_comparison_table(ROWS, columns, best={"mse": min}, reference="no-outliers")
    texts = {text.get_text(): text for text in ax.texts}
    assert {"TPR", "translation\nMSE (m²)", "scgp", "623", "1.00", "–"} <= set(texts)
    assert texts["623"].get_fontweight() == "bold"
    assert texts["0.276"].get_fontweight() == "normal"
    assert texts["183,078"].get_horizontalalignment() == "right"
    assert texts["scgp"].get_horizontalalignment() == "left"


def test_a_table_fits_its_axes():
    narrow = pyplot.figure(figsize=(2.0, 1.0)).subplots()
    for ax in (plots.plot_comparison_table(ROWS), plots.plot_comparison_table(ROWS, ax=narrow)):
        ax.figure.canvas.draw()
        boxes = [text.get_window_extent() for text in ax.texts if text.get_text()]
        outer = ax.get_window_extent()
        assert all(outer.x0 <= box.x0 and box.x1 <= outer.x1 for box in boxes)
        assert not any(
            one.overlaps(other) for k, one in enumerate(boxes) for other in boxes[k + 1 :]
        )
