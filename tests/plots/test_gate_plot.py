"""The picture that answers "is my gate right", with labels and without."""

import matplotlib as mpl
import numpy as np
import pytest
from drawn import legend_of, line
from scipy.stats import chi2

from pcm_jax import plots, select
from pcm_jax.errors import InputError
from pcm_jax.integrity.calibration import scaled_graph
from pcm_jax.plots._gate import right_pairs
from pcm_jax.simulation import simulate_city

mpl.use("Agg")
GATE = 11.345  # 99 %, three degrees of freedom


def clutter(generator, count, dof=3):
    """Pairs that miss by metres, in units of centimetres: uniform in a ball."""
    return 1e6 * generator.random(count) ** (2.0 / dof)


def test_the_gate_is_drawn_beside_what_right_pairs_should_have():
    generator = np.random.default_rng(0)
    squared = np.triu(generator.chisquare(3, (40, 40)), 1)
    inliers = np.arange(40) < 30
    squared[:, ~inliers] *= 1e5
    squared += squared.T
    ax = plots.plot_gate(squared, 11.34, dof=3, is_true=inliers)
    assert {"two true (435)", "one or both false (345)"} < set(legend_of(ax))
    for bars in ax.patches:
        assert bars.get_data().values.sum() == pytest.approx(100.0)
    right, wrong = (bars.get_data() for bars in ax.patches)
    assert (
        right.edges[1:][right.values > 0].max() < 100.0 < wrong.edges[:-1][wrong.values > 0].min()
    )
    x, y = line(ax, "chi-squared, d = 3").get_data()
    step = np.log10(x[1] / x[0])
    assert y.sum() * step / 0.25 == pytest.approx(100.0, rel=0.01)  # bins of 0.25 decades
    at = np.log10(right.edges[:-1]) + 0.125
    assert np.abs(np.interp(at, np.log10(x), y) - right.values).max() < 5.0
    assert line(ax, "gate γ² = 11.34").get_xdata()[0] == 11.34
    assert ax.get_xscale() == "log"


def test_the_gate_without_truth_counts_larger_directions():
    squared = np.array([[0.0, 1.0, 0.0], [50.0, 0.0, 2.0], [0.0, 2.0, 0.0]])
    ax = plots.plot_gate(squared, 10.0, dof=1)
    (bars,) = ax.patches
    assert "pairs (3)" in legend_of(ax)
    values, edges, _ = bars.get_data()
    assert values[edges[:-1] > 10.0].sum() == 1
    assert ax.get_title() == "2 of 3 pairs inside the gate\ntoo few look right to judge it"
    with pytest.raises(InputError, match="is_true"):
        plots.plot_gate(squared, 10.0, dof=1, is_true=np.ones(2, bool))
    with pytest.raises(InputError, match="squared"):
        plots.plot_gate(np.ones((2, 3)), 10.0, dof=1)


@pytest.mark.parametrize("times", [0.01, 0.1, 1.0, 10.0])
@pytest.mark.parametrize("dof", [3, 6])
def test_right_pairs_are_found_by_their_law_among_clutter(times, dof):
    """Of covariances that are stated 100 times too large to 10 times too small."""
    generator = np.random.default_rng(7)
    right = times * generator.chisquare(dof, 400)
    pairs = np.concatenate([right, times * clutter(generator, 20_000, dof)])
    gate = chi2.ppf(0.99, dof)
    found = right_pairs(pairs, gate, dof)
    assert found.spread == pytest.approx(right.mean() / dof, rel=0.1)  # steps of 12 %
    assert found.count == pytest.approx(400, rel=0.03)
    assert found.inside == pytest.approx(np.mean(right <= gate), abs=0.04)
    assert found.expected == pytest.approx(0.99)


def test_a_mode_is_not_cut_where_other_pairs_begin_beside_it():
    """Right pairs, some of which are better than they should be, and others from ten gates on."""
    generator = np.random.default_rng(4)
    right = np.concatenate([generator.chisquare(3, 105), 0.3 * generator.chisquare(3, 15)])
    far = GATE * 10.0 ** generator.normal(2.2, 0.4, 6_000)
    found = right_pairs(np.concatenate([right, far]), GATE, 3)
    assert found.count == pytest.approx(120, rel=0.06)
    assert found.as_stated


@pytest.mark.slow
def test_clutter_alone_is_not_taken_for_right_pairs():
    generator = np.random.default_rng(3)
    for _ in range(20):
        assert right_pairs(1e-3 * clutter(generator, 5_000), GATE, 3) is None


def test_right_pairs_alone_are_found_as_well():
    found = right_pairs(np.random.default_rng(0).chisquare(3, 300), GATE, 3)
    assert found.count == pytest.approx(300, rel=0.02)
    assert found.as_stated


@pytest.mark.parametrize(
    ("information", "verdict"),
    [
        (1.0, "errors are about as stated: the gate is right"),
        (0.01, "errors are stated 10 times too large: the gate is too wide"),
        (10.0, "errors are stated 3.2 times too small: the gate is too narrow"),
    ],
)
def test_a_gate_is_judged_without_labels(information, verdict):
    """A world of 15 right closures, 10 that agree on a wrong place, and 90 at random."""
    graph = scaled_graph(simulate_city(seed=0).graph, np.full(4, information))
    (pair,) = select(graph).pairs
    ax = plots.plot_gate(pair.evidence, pair.gate, dof=3)
    first, second = ax.get_title().split("\n")
    assert first.startswith("125 pairs look right")  # 105, and twice the 10 of five aliased ones
    assert "99 % expected" in first
    assert second == verdict
    dashed = [x for x in ax.get_lines() if "times chi-squared" in str(x.get_label())]
    assert len(dashed) == (information != 1.0)


def test_bars_of_right_pairs_fill_the_picture_however_many_are_false():
    generator = np.random.default_rng(1)
    squared = np.triu(clutter(generator, 300 * 300).reshape(300, 300), 1)
    squared[:20, :20] = np.triu(generator.chisquare(3, (20, 20)), 1)
    ax = plots.plot_gate(squared + squared.T, GATE, dof=3)
    (bars,) = ax.patches
    values, edges, _ = bars.get_data()
    tallest = values[edges[:-1] <= GATE].max()
    assert 0.5 < tallest / ax.get_ylim()[1] < 1.0
