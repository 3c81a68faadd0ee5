"""Variance components: by how much odometry and closures misstate their errors, by residuals.

Let the covariance of an edge be D Σ D, Σ as stated, D = diag(σ_t, …, σ_r, …) one of its kind
(odometry or closure): four factors θ on variances. With v the residuals at the optimum, P the
projection that turns errors into them, and for every kind and half of the tangent

    a = Σ v_halfᵀ (Ω v)_half  over the edges of the kind,     E a = tr(P ∂Σ/∂log θ) =: b

the restricted likelihood (REML; Patterson and Thompson 1971; in geodesy the variance components of
Helmert 1907) has the score (a − b)/2 and the information F = Cov(a)/4 in log θ. The odometry that
loops do not check enters neither. Both expectations are means over simulated errors ε ~ N(0, I),
whitened, carried through the same linear map as the real ones,

    v = ε − J H⁻¹ Jᵀ ε,

one back substitution each: no selected inverse, no trace, whatever the graph. Steps are
log θ ← log θ + log(a/b) far from the end and Fisher's near it, 2 Cov(a)⁻¹ (a − b); half of what
would turn back, since errors that are not normal bend a more than the model says.

Closures that passed a gate γ² are a truncated sample: their b is E a given that they passed,
κ₁ = F_{d+2}(γ²/φ)/F_d(γ²/φ) times as large, and the mean of its square κ₂ = F_{d+4}/F_d times; F_d
the law of chi-squared. φ is how much larger than stated, to the power d the determinant, the
covariance of a closure in the map of all others is, L⁻ᵀ C⁻¹ L⁻¹ with L Lᵀ = Ω and C that of its
whitened residual: where the map is less certain than the closure, φ hardly grows with θ. So a
rescaled selection is not taken for a narrower law at every turn.

Intervals: of 2/ν = F⁻¹ the chi-squared with ν degrees of freedom (Satterthwaite 1946), F⁻¹ times
as large as the closures' own contributions to a vary more than simulated ones (tails). Closures are
not resampled: copies of one share its error, which reads as less noise.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float
from scipy.special import chdtr, chdtri

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.errors import InputError
from pcm_jax.graph import PoseGraph
from pcm_jax.mapping import optimize
from pcm_jax.mapping._linearization import linearize
from pcm_jax.mapping.covariance_factor import covariance_factor
from pcm_jax.mapping.least_squares import padded_edges
from pcm_jax.mapping.optimization import host_arrays

COVERED = 0.9
"""Probability that an interval holds the factor."""
SAMPLES = 100
"""Simulated errors a step."""
STEPS = 40
MOST = 30
"""Evaluations of a map's solve, which begins near its optimum; contradictions have none near."""
GIVEN_UP = 3
"""Steps one after another in which some map has no optimum near, after which none is looked for."""
NEAR = 0.3
"""In log θ: from there Fisher's steps are taken."""
SETTLED = 1e-3
"""In log θ."""
FARTHEST = 2.0
"""In log θ, the longest step."""
LARGEST = 16.0
"""In log θ, from what is stated: further is not known."""
CHECKED = 1e-3
"""Of the sum of d whitened variances: less is left of an edge that nothing checks."""
KNOWN = 0.5
"""Redundant numbers below which a factor is not known."""
KINDS = ("odometry translation", "odometry rotation", "closures translation", "closures rotation")


class Part(NamedTuple):
    """A connected map and what its edges are.

    Attributes:
        graph: all edges that hold.
        closing: bool [e], those that are closures, not odometry.
        gated: bool [e], closures that passed a gate.
    """

    graph: PoseGraph
    closing: Bool[np.ndarray, " e"]
    gated: Bool[np.ndarray, " e"]


@dataclass(frozen=True)
class Components:
    """The variance components of some maps, as factors on what is stated.

    Attributes:
        variance: float64 [4], θ of odometry's translation and rotation, of closures' likewise.
        low: float64 [4], the lower end of the interval of each.
        high: float64 [4], the upper end; infinite where nothing is known.
        redundancy: float64 [4], how many numbers each rests on (b).
        tails: float64 [4], at least 1: how much more edges of a kind vary than normal errors do.
        squared: a pair, odometry and closures: float64 [·], q² of edges' residuals by their
            covariance under the factors, chi-squared with d degrees of freedom.
        as_stated: the same under what is stated.
        converged: whether the steps ended.
    """

    variance: Float[np.ndarray, " 4"]
    low: Float[np.ndarray, " 4"]
    high: Float[np.ndarray, " 4"]
    redundancy: Float[np.ndarray, " 4"]
    tails: Float[np.ndarray, " 4"]
    squared: tuple[Float[np.ndarray, " o"], Float[np.ndarray, " c"]]
    as_stated: tuple[Float[np.ndarray, " o"], Float[np.ndarray, " c"]]
    converged: bool

    def after(self, first: Components) -> Components:
        """The same as factors on what was stated before it was rescaled by those found first."""
        times = first.variance
        return dataclasses.replace(
            self,
            variance=self.variance * times,
            low=self.low * times,
            high=self.high * times,
            as_stated=first.as_stated,
        )


@on_host
def variance_components(
    parts: list[Part], gate: float | None = None, *, seed: int = 0
) -> Components:
    """Finds the factors on variances under which residuals are as large as they should be.

    Args:
        parts: connected maps, each at poses near its optimum.
        gate: γ² that gated closures passed; None: none was gated.
        seed: of simulated errors.

    Raises:
        InputError: where no map has a loop.
    """
    if not any(one.graph.num_edges >= one.graph.num_poses for one in parts):
        raise InputError("graph: no map has a loop, expected closures, which residuals come from")
    log, graphs, as_stated, volumes = np.zeros(4), [one.graph for one in parts], None, None
    converged, failed, last, share = False, 0, np.zeros(4), 1.0
    for _ in range(STEPS):
        found = [
            _residuals(one, graph, log, np.random.default_rng([seed, number]))
            for number, (one, graph) in enumerate(zip(parts, graphs, strict=True))
        ]
        graphs = [each.graph for each in found]
        as_stated = as_stated or _by_kind(found)
        volumes = volumes or [each.log_volume for each in found]
        score = _Score.of(found, [*map(functools.partial(_cut, gate), found, volumes)])
        move = score.step()
        share = 0.5 * share if move @ last < 0.0 else min(2.0 * share, 1.0)
        log, last = np.clip(log + share * move, -LARGEST, LARGEST), move
        converged = bool(np.abs(move).max() < SETTLED)
        failed = failed + 1 if not all(each.solved for each in found) else 0
        if converged or failed == GIVEN_UP:
            break
    low, high = score.interval(log)
    return Components(
        variance=np.exp(log),
        low=low,
        high=high,
        redundancy=score.expected,
        tails=score.tails,
        squared=_by_kind(found),
        as_stated=as_stated,  # type: ignore[arg-type]
        converged=converged,
    )


class _Found(NamedTuple):
    """One map at its optimum under some factors.

    Attributes:
        graph: at its optimum, information as stated.
        real: `[e, 2]`, what each edge adds to a, translation and rotation.
        simulated: `[s, e, 2]`, the same of simulated errors.
        squared: `[e]`, q² of each residual by the covariance of simulated ones; NaN for edges that
            nothing checks.
        log_volume: `[e]`, the logarithm of the determinant of its covariance in the map of all
            others; infinite likewise.
        part: as given.
        solved: whether that optimum was found.
    """

    graph: PoseGraph
    real: Float[np.ndarray, "e 2"]
    simulated: Float[np.ndarray, "s e 2"]
    squared: Float[np.ndarray, " e"]
    log_volume: Float[np.ndarray, " e"]
    part: Part
    solved: bool


def _residuals(
    part: Part, graph: PoseGraph, log: Float[np.ndarray, " 4"], generator: np.random.Generator
) -> _Found:
    information = scaled_information(np.asarray(graph.information), part.closing, np.exp(-log))
    scaled = dataclasses.replace(graph, information=information)
    solution = optimize(scaled, initial="given", max_steps=MOST)
    solved = solution.graph
    tail, head, measurement, information = host_arrays(solved)
    edges = padded_edges(tail, head, measurement, information, size=solved.num_edges)
    linear = linearize(lie.as_numpy(solved.poses), edges)
    jacobian = _sparse(linear, tail, head, solved.num_poses)
    count, d = solved.num_edges, solved.tangent_dim
    errors = generator.normal(size=(count * d, SAMPLES))
    errors -= jacobian @ covariance_factor(solved).solve(np.asarray(jacobian.T @ errors))
    lower = np.linalg.cholesky(information)
    whitened = np.concatenate([np.asarray(linear.residual).T.reshape(-1, 1), errors], axis=1)
    whitened = whitened.reshape(count, d, -1)
    weighed = lower @ whitened
    plain = np.linalg.solve(lower.swapaxes(1, 2), whitened)
    product = plain * weighed
    half = d - 1 if d == 3 else 3
    halves = np.stack([product[:, :half].sum(axis=1), product[:, half:].sum(axis=1)], axis=-1)
    back = graph.with_poses(solved.poses)
    squared, log_volume = _judged(whitened)
    log_volume -= np.linalg.slogdet(information)[1]
    draws = halves[:, 1:].swapaxes(0, 1)
    return _Found(back, halves[:, 0], draws, squared, log_volume, part, solution.converged)


def _judged(
    whitened: Float[np.ndarray, "e d s"],
) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, " e"]]:
    """q² of the first by the covariance C of all others, and log det C⁻¹.

    Hotelling's, scaled to chi-squared.
    """
    real, draws = whitened[:, :, 0], whitened[:, :, 1:]
    count, d = draws.shape[2], draws.shape[1]
    covariance = draws @ draws.swapaxes(1, 2) / count
    checked = np.trace(covariance, axis1=1, axis2=2) > CHECKED
    squared, log_volume = np.full(len(real), np.nan), np.full(len(real), np.inf)
    solved = np.linalg.solve(covariance[checked], real[checked][..., None])[..., 0]
    squared[checked] = np.einsum("ei,ei->e", solved, real[checked]) * (count - d - 1) / count
    log_volume[checked] = -np.linalg.slogdet(covariance[checked])[1]
    return squared, log_volume


def _by_kind(found: list[_Found]) -> tuple[np.ndarray, np.ndarray]:
    """The q² that are known, of odometry and of closures."""
    squared = np.concatenate([each.squared for each in found])
    closing, known = np.concatenate([each.part.closing for each in found]), np.isfinite(squared)
    return squared[known & ~closing], squared[known & closing]


def scaled_information(
    information: Float[np.ndarray, "e d d"],
    closing: Bool[np.ndarray, " e"],
    factors: Float[np.ndarray, " 4"],
) -> Float[np.ndarray, "e d d"]:
    """The information times factors; cross terms by the geometric mean."""
    d = information.shape[1]
    half = np.arange(d) >= (d - 1 if d == 3 else 3)
    root = np.sqrt(factors)[2 * closing.astype(int)[:, None] + half]
    return information * root[:, :, None] * root[:, None, :]


def _sparse(linear: Any, tail: np.ndarray, head: np.ndarray, poses: int) -> Any:
    """The whitened Jacobian `[e d, n d]`; the first pose, which is held, has no column."""
    by_tail, by_head = (np.moveaxis(np.asarray(part), -1, 0) for part in (linear.tail, linear.head))
    count, d = by_tail.shape[:2]
    scalar = np.arange(d)
    rows = (np.arange(count)[:, None, None] * d + scalar[:, None] + 0 * scalar).ravel()
    blocks = []
    for part, ends in ((by_tail, tail), (by_head, head)):
        columns = (ends[:, None, None] * d + 0 * scalar[:, None] + scalar).ravel()
        values = np.where((ends == 0)[:, None, None], 0.0, part).ravel()
        shape = (count * d, poses * d)
        blocks.append(scipy.sparse.csr_array((values, (rows, columns)), shape=shape))
    return blocks[0] + blocks[1]


class _Cut(NamedTuple):
    """Chi-squareds cut off at a gate: what is left of their means, and of their mean squares.

    A radius is cut, no direction: a part of the sum of squares keeps the same shares.

    Attributes:
        mean: `[e]`, 1 for edges that passed no gate.
        square: `[e]`, likewise.
    """

    mean: Float[np.ndarray, " e"]
    square: Float[np.ndarray, " e"]

    @classmethod
    def at(cls, gate: Float[np.ndarray, " e"], d: int) -> _Cut:
        """Gives what is left of chi-squareds with d degrees of freedom that are below a gate γ²."""
        passed = np.maximum(chdtr(d, gate), np.finfo(float).tiny)
        return cls(chdtr(d + 2, gate) / passed, chdtr(d + 4, gate) / passed)

    def of(self, draws: Float[np.ndarray, "s e 2"]) -> Float[np.ndarray, "s e 2"]:
        """Draws of sums of squares, with the means and variances that are left."""
        mean, square = draws.mean(axis=0), (draws**2).mean(axis=0)
        less, lesser = self.mean[:, None] * mean, self.square[:, None] * square
        spread = np.maximum(square - mean**2, np.finfo(float).tiny)
        ratio = np.maximum(lesser - less**2, 0.0) / spread
        return less + np.sqrt(ratio) * (draws - mean)


def _cut(gate: float | None, found: _Found, stated: Float[np.ndarray, " e"]) -> _Cut | None:
    """The cut of a map's gated closures; None where a gate chose none."""
    if gate is None or not found.part.gated.any():
        return None
    d = found.graph.tangent_dim
    known = found.part.gated & np.isfinite(found.log_volume) & np.isfinite(stated)
    within = np.full(len(stated), np.inf)
    within[known] = gate / np.exp((found.log_volume[known] - stated[known]) / d)
    return _Cut.at(within, d)


class _Score(NamedTuple):
    """The sums a, real and expected, and their covariance.

    Attributes:
        real: float64 [4].
        expected: float64 [4].
        covariance: float64 [4, 4].
        tails: float64 [4], variance of the edges' own contributions over that of simulated ones.
    """

    real: Float[np.ndarray, " 4"]
    expected: Float[np.ndarray, " 4"]
    covariance: Float[np.ndarray, "4 4"]
    tails: Float[np.ndarray, " 4"]

    @classmethod
    def of(cls, found: list[_Found], cuts: list[_Cut | None]) -> _Score:
        real, simulated = np.zeros(4), np.zeros((SAMPLES, 4))
        spread = np.zeros((2, 4))
        for each, cut in zip(found, cuts, strict=True):
            draws = each.simulated if cut is None else cut.of(each.simulated)
            mean = draws.mean(axis=0)
            for kind, edges in enumerate((~each.part.closing, each.part.closing)):
                rows = slice(2 * kind, 2 * kind + 2)
                real[rows] += each.real[edges].sum(axis=0)
                simulated[:, rows] += draws[:, edges].sum(axis=1)
                spread[0, rows] += ((each.real - mean)[edges] ** 2).sum(axis=0)
                spread[1, rows] += ((draws - mean)[:, edges] ** 2).mean(axis=0).sum(axis=0)
        tails = np.divide(spread[0], spread[1], where=spread[1] > 0, out=np.ones(4))
        covariance = np.cov(simulated.T)
        return cls(real, simulated.mean(axis=0), covariance, np.maximum(tails, 1.0))

    @property
    def known(self) -> Bool[np.ndarray, " 4"]:
        """True for those that residuals say anything of."""
        return self.expected > KNOWN

    def step(self) -> Float[np.ndarray, " 4"]:
        move, known = np.zeros(4), self.known
        ratio = self.real[known] / self.expected[known]
        move[known] = np.log(np.maximum(ratio, np.exp(-FARTHEST)))
        if np.abs(move).max() < NEAR:
            inner = self.covariance[np.ix_(known, known)]
            newton = 2.0 * np.linalg.solve(inner, (self.real - self.expected)[known])
            move[known] = np.clip(newton, -NEAR, NEAR)
        return np.clip(move, -FARTHEST, FARTHEST)

    def interval(self, log: Float[np.ndarray, " 4"]) -> tuple[np.ndarray, np.ndarray]:
        known = self.known
        low, high = np.zeros(4), np.full(4, np.inf)
        inner = np.linalg.inv(self.covariance[np.ix_(known, known)])
        variance = 4.0 * np.diagonal(inner) * self.tails[known]
        freedom = 2.0 / variance
        tail = 0.5 * (1.0 - COVERED)
        enough = np.flatnonzero(known)[freedom >= 1.0]
        freedom = freedom[freedom >= 1.0]
        low[enough] = np.exp(log[enough]) * freedom / chdtri(freedom, tail)
        high[enough] = np.exp(log[enough]) * freedom / chdtri(freedom, 1.0 - tail)
        return low, high
