"""The picture of a gate: squared distances beside their law, and what they say of the gate.

Without labels right pairs are told from others by the law of their q². Pairs of right closures
whose deviations are stated √s times too small have q² ~ s χ²_d; of the others, whose misses know
nothing of covariances, those below a limit w are distributed as (q² / w)^α, with α = d/2 where the
misses fill a volume evenly. In fine bins of log q² the mixture

    share · P(s χ²_d in the bin) + (1 − share) · (upper^α − lower^α) / w^α

is fitted by maximum likelihood, s and α on grids, the share by expectation and maximisation; for
growing limits w, from the first at which right pairs explain the distances far better than none
and all that s χ²_d has lies below w, on to the first at which they gain most by it. So the bulk of
other pairs is never taken for right ones with large errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import gammainc, xlogy

from pcm_jax.consistency import PairEvidence
from pcm_jax.graph.checked import as_mask
from pcm_jax.plots import style
from pcm_jax.plots._consistency import checked_distances
from pcm_jax.plots.style import axes_or_new, legend_below

REACH = 100.0
"""Gates up to which pairs tell anything of it."""
FEWEST = 10.0
"""Right pairs from which their law can be told: those of five closures."""
SURE = 8.0
"""Log-likelihood by which right pairs must explain the distances better than none."""
NO_NEWS = 0.1
"""Relative error of stated deviations that is of no consequence."""
_LIMITS = 10.0 ** np.arange(-4.0, 2.01, 0.5)  # in gates
_STEP = 0.05  # decades between values of s
_STEPS = np.arange(-20, 21)  # from the largest s whose pairs lie below w
_POWERS = np.array([0.0625, 0.125, 0.25, 0.5, 1.0])  # α, in d/2
_TAIL = 5.0  # d s below which all but one pair in 1,000 (d = 6: 30,000) of s χ²_d lies
_FINE, _DEPTH = 0.1, 7.0  # decades to a bin of the fit, and to all of them
_ROUNDS = 100
_BIN = 0.25  # decades to a bar
_TINY = float(np.finfo(float).tiny)
# Right pairs, and pairs of unknown truth, are dark; others are an outline that hides nothing.
_HISTOGRAMS: tuple[dict[str, Any], ...] = (
    {"fill": True, "color": style.BLUE, "alpha": 0.85, "zorder": 2.0},
    {"fill": False, "color": style.GREY, "hatch": "////", "linewidth": 1.5, "zorder": 2.5},
)


@dataclass(frozen=True)
class RightPairs:
    """The pairs that are right, by the law of their distances.

    Attributes:
        count: how many, inside the gate or not.
        spread: s of q² ~ s χ²_d; 1 where covariances are as stated.
        inside: the fraction of them inside the gate, by that law.
        expected: that fraction where s is 1.
        doubt: one standard deviation of √s, relative, for as many closures as make so many pairs.
    """

    count: float
    spread: float
    inside: float
    expected: float
    doubt: float

    @property
    def as_stated(self) -> bool:
        """True where s cannot be told from 1, or is of no consequence."""
        return abs(0.5 * np.log(self.spread)) < max(2.0 * self.doubt, NO_NEWS)

    @property
    def sentences(self) -> tuple[str, str]:
        """The answer to "is my gate right", in two lines."""
        off = float(np.sqrt(self.spread))
        shares = f"{100 * self.inside:.3g} % of them inside, {100 * self.expected:.3g} % expected"
        if self.as_stated:
            verdict = "errors are about as stated: the gate is right"
        elif off < 1.0:
            verdict = f"errors are stated {1.0 / off:.2g} times too large: the gate is too wide"
        else:
            verdict = f"errors are stated {off:.2g} times too small: the gate is too narrow"
        return f"{self.count:,.0f} pairs look right: {shares}", verdict


def right_pairs(pairs: Float[np.ndarray, " p"], gate: float, dof: int) -> RightPairs | None:
    """Tells right pairs from others by the law of their squared distances; None: cannot be told.

    Args:
        pairs: squared distances, one for each pair.
        gate: γ².
        dof: degrees of freedom, d.
    """
    best = (0.0, 1.0, 0.0)
    for limit in _LIMITS * gate:
        count, spread, gain = _fitted(pairs, limit, dof)
        if best[0] and gain < best[2]:
            break
        if count >= FEWEST and gain >= SURE and _TAIL * dof * spread <= limit:
            best = count, spread, gain
    count, spread, _ = best
    if not count:
        return None
    closures = 0.5 + np.sqrt(0.25 + 2.0 * count)
    inside, expected = (float(gammainc(0.5 * dof, 0.5 * gate / s)) for s in (spread, 1.0))
    return RightPairs(count, spread, inside, expected, 1.0 / float(np.sqrt(2.0 * dof * closures)))


def _fitted(pairs: Float[np.ndarray, " p"], limit: float, dof: int) -> tuple[float, float, float]:
    """The number of right pairs below a limit, their s, and the log-likelihood that they gain.

    None of the latter where s is the least of the grid: it belongs to a lower limit then.
    """
    top = np.log10(limit)
    edges = np.arange(top - _DEPTH, top + 0.5 * _FINE, _FINE)
    spreads = 10.0 ** (_STEP * (np.floor(np.log10(limit / (_TAIL * dof)) / _STEP) + _STEPS))
    places = np.log10(pairs)
    counts, _ = np.histogram(np.clip(places[places <= edges[-1]], edges[0], None), edges)
    upper = 10.0**edges
    upper[0] = 0.0
    right = np.diff(gammainc(0.5 * dof, 0.5 * upper / spreads[:, None]))[:, None]
    others = np.diff((upper / upper[-1]) ** (0.5 * dof * _POWERS[:, None]))
    share = np.full((len(spreads), len(_POWERS), 1), 0.5)
    for _ in range(_ROUNDS):
        of_right = share * right / np.maximum(share * right + (1.0 - share) * others, _TINY)
        share = (of_right * counts).sum(axis=-1, keepdims=True) / max(counts.sum(), 1)
    mixed = np.maximum(share * right + (1.0 - share) * others, _TINY)
    likely = xlogy(counts, mixed).sum(axis=-1)
    alone = xlogy(counts, np.maximum(others, _TINY)).sum(axis=-1).max()
    best = np.unravel_index(int(likely.argmax()), likely.shape)
    count, gain = float(share[best][0] * counts.sum()), float(likely[best] - alone)
    return count, float(spreads[best[0]]), gain if best[0] else 0.0


def plot_gate(
    squared: Float[np.ndarray, "m m"] | PairEvidence,
    gate: float,
    *,
    dof: int,
    is_true: Bool[np.ndarray, " m"] | None = None,
    ax: Any = None,
) -> Any:
    """Draws squared distances beside the law of right ones, and says whether the gate is right.

    The curve is what chi-squared expects of pairs of two right closures. Without labels the right
    pairs are found by their law (the title says how many, and how many of them the gate holds), and
    a dashed curve shows it where errors are not as stated; pairs far beyond the gate are counted in
    the legend. With labels pairs of two true closures are drawn apart from the rest, each kind in
    percent of its own number. The axis is logarithmic: an outlier's distance can be anything.

    Args:
        squared: squared Mahalanobis distances, or a `PairEvidence` that has them; the two
            directions of a pair count as their maximum.
        gate: γ², as of `chi2_gate`.
        dof: degrees of freedom, d: 3 in SE(2), 6 in SE(3).
        is_true: which measurements are true, where that is known.
        ax: matplotlib axes to draw into; None makes a figure.

    Returns:
        The axes.

    Raises:
        InputError: `squared` is not square, the gate is not above 0, or a mask of another length.
    """
    values = checked_distances(squared, gate)
    true = None if is_true is None else as_mask(is_true, "is_true", len(values))
    u, v = np.triu_indices(len(values), 1)
    pairs = np.maximum(np.maximum(values[u, v], values[v, u]), _TINY)
    ax = axes_or_new(ax, (5.8, 4.4))
    if true is None:
        _draw_unlabelled(ax, pairs, gate, dof)
    else:
        _draw_labelled(ax, pairs, true[u] & true[v], gate, dof)
    ax.axvline(gate, color=style.RED, linewidth=2.0, label=f"gate γ² = {gate:.4g}")
    ax.set_xscale("log")
    ax.set_xlabel("squared distance q², larger direction")
    legend_below(ax, columns=2, offset=-0.2)
    return ax


def _draw_unlabelled(ax: Any, pairs: Float[np.ndarray, " p"], gate: float, dof: int) -> None:
    """Pairs near the gate, in numbers: of thousands far from it only how many there are."""
    found = right_pairs(pairs, gate, dof)
    low = np.log10(gate) - (3.0 if found is None else max(3.0, 1.0 - np.log10(found.spread)))
    edges = _edges(low, np.log10(gate * REACH))
    near = np.log10(pairs) <= edges[-1]
    counts = _in_bins(pairs[near], edges)
    beyond = f"\n{np.count_nonzero(~near):,} more far beyond" if not near.all() else ""
    label = f"pairs ({np.count_nonzero(near):,}){beyond}"
    ax.stairs(counts, 10.0**edges, label=label, **_HISTOGRAMS[0])
    inside = int(np.count_nonzero(pairs <= gate))
    law = inside if found is None else found.count
    _draw_law(ax, edges, dof, law, color=style.BLACK, label=f"chi-squared, d = {dof}")
    if found is not None and not found.as_stated:
        looks = {"color": style.ORANGE, "linestyle": "--", "linewidth": 2.2}
        label = f"{found.spread:.2g} times chi-squared"
        _draw_law(ax, edges, dof, law, found.spread, label=label, **looks)
    ax.set_ylim(0.0, 1.15 * max(_tallest(counts, edges, gate, found), law * 0.2, 1.0))
    ax.set_ylabel("pairs of closures")
    untold = f"{inside} of {len(pairs):,} pairs inside the gate", "too few look right to judge it"
    ax.set_title("\n".join(untold if found is None else found.sentences), fontsize="medium")


def _tallest(counts: Any, edges: Any, gate: float, found: RightPairs | None) -> float:
    """The tallest bar among those where right pairs are: others may be cut off."""
    reach = gate * (1.0 if found is None else max(1.0, found.spread))
    return float(counts[10.0 ** edges[:-1] <= reach].max(initial=0.0))


def _draw_labelled(
    ax: Any, pairs: Float[np.ndarray, " p"], right: Bool[np.ndarray, " p"], gate: float, dof: int
) -> None:
    """Pairs of two true closures and all others, each kind in percent."""
    low = min(-2.0, np.log10(gate) - 2.0)
    edges = _edges(low, max(np.log10(pairs.max(initial=gate)), low + 4.0))
    kinds = {"two true": right, "one or both false": ~right}
    for (name, rows), looks in zip(kinds.items(), _HISTOGRAMS, strict=True):
        percent = 100.0 * _in_bins(pairs[rows], edges) / max(rows.sum(), 1)
        ax.stairs(percent, 10.0**edges, label=f"{name} ({rows.sum():,})", **looks)
    _draw_law(ax, edges, dof, 100.0, color=style.BLACK, label=f"chi-squared, d = {dof}")
    ax.set_ylabel("pairs of closures (%)")
    if right.any():
        inside, expected = np.mean(pairs[right] <= gate), gammainc(0.5 * dof, 0.5 * gate)
        told = f"{100 * inside:.3g} % of true pairs inside the gate, {100 * expected:.3g} %"
        ax.set_title(f"{told} expected", fontsize="medium")


def _edges(low: float, high: float) -> Float[np.ndarray, " e"]:
    return np.arange(low, high + _BIN, _BIN)


def _in_bins(pairs: Float[np.ndarray, " p"], edges: Float[np.ndarray, " e"]) -> Any:
    return np.histogram(np.clip(np.log10(pairs), edges[0], edges[-1]), edges)[0]


def _draw_law(
    ax: Any,
    edges: Float[np.ndarray, " e"],
    dof: int,
    total: float,
    spread: float = 1.0,
    **looks: Any,
) -> None:
    """Draws what chi-squared expects in a bar centred at each place, of so many pairs in all."""
    at = np.linspace(edges[0], edges[-1], 400)
    ends = (10.0 ** (at + h * _BIN) / spread for h in (0.5, -0.5))
    above, below = (gammainc(0.5 * dof, 0.5 * end) for end in ends)
    ax.plot(10.0**at, total * (above - below), zorder=3.0, **looks)
