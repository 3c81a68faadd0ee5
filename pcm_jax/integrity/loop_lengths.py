"""The growth of odometry's errors with the way, where no one factor holds for loops of any length.

A factor on odometry's information says that steps err independently, so that the variance of what
they add up to grows with their number. Drift often does not: a bias or a scale adds up faster,
errors that take each other back more slowly. Short loops, of which there are many, then fix the
factor, and long ones, of which there are few, contradict it.

At the optimum, in the map's frame, edge e has the residual ξ_e = Ad(X_head) r_e, forward in time.
Around a loop the poses cancel, to first order, and what is left are the errors themselves:

    c_u = Σ_{i ≤ s < k} ξ_s − ξ_u                 closure u from pose i to k of one robot
    c_u − c_v                                     two closures near each other at both ends

the second loop runs over the odometry between their ends alone, and need not be in one robot. With
P the covariance of the odometry on the way, Z that of the closures, both under the factors found,

    c ~ N(0, s P + Z),      s = 1 if the factor is right at this length

s of every class of lengths (by powers of ten of poses) maximises the product of its loops'
densities. Short loops are many and determine the factor that is the likeliest if there is one.
Where lengths differ there is none, and each has the same say in the mean of their variances. Loops
are not independent, so that all statistics are taken from simulated errors on the same loops: 90 %
intervals, and the probability p that classes differ as much from 1 by chance, by the squared
Mahalanobis distance of their cube roots (that of a chi-squared is nearly normal; Wilson and
Hilferty 1931).
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.integrity.variance_components import COVERED, Part, scaled_information
from pcm_jax.mapping import optimize

CLASSES = (1, 10, 100, 1_000, 10_000)
"""Poses: the least length of the loops of a class."""
MOST = 300
"""Loops of a class that are looked at, evenly spaced."""
FEWEST = 5
"""Loops of a class; of fewer nothing is said."""
LAGS = (1, 2, 4, 8, 16, 32)
"""Closures, in the order of their first poses, that are paired."""
DRAWS, AT_ONCE = 199, 20
"""Simulated errors; how many are held in memory."""
GRID = np.linspace(-4.6, 4.6, 93)
"""Of log s."""
LEVEL = 0.01
"""Probability below which lengths contradict each other."""


class LengthFactor(NamedTuple):
    """The loops of about one length.

    Attributes:
        poses: their least length, steps of odometry.
        loops: how many were looked at.
        times: on odometry's standard deviations under the factors (1: as these say).
        interval: its lower and upper end, 90 %.
    """

    poses: int
    loops: int
    times: float
    interval: tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Growth:
    """The lengths of loops, and whether odometry's factors hold for all of them.

    Attributes:
        lengths: from the shortest to the longest.
        p_value: of differences as large where one factor holds for all; 1 for fewer than two.
        variance: the mean over lengths, times odometry's under the factors found; 1 unless they
            differ.
        deviation: of the logarithm of the variance, from length to length; 0 unless they differ.
    """

    lengths: tuple[LengthFactor, ...] = ()
    p_value: float = 1.0
    variance: float = 1.0
    deviation: float = 0.0

    @property
    def uneven(self) -> bool:
        """True where no single factor holds for all lengths."""
        return self.p_value <= LEVEL

    @property
    def words(self) -> str:
        """A sentence on lengths that differ."""
        ends = [f"{one.poses:,} to {10 * one.poses - 1:,} poses" for one in self.lengths]
        ends[-1] = f"{self.lengths[-1].poses:,} poses and more"
        told = [
            f"{one.times:.2g} times ({one.interval[0]:.2g} to {one.interval[1]:.2g})"
            + (" as large as these factors say" if not row else "")
            + f" in loops of {end}"
            for row, (one, end) in enumerate(zip(self.lengths, ends, strict=True))
        ]
        return (
            f"odometry's errors {self._way()}: {', '.join(told)}; no single factor holds for all,"
            " and the intervals of odometry's cover that"
        )

    def _way(self) -> str:
        low, high = np.transpose([one.interval for one in self.lengths])
        shorter = np.tri(len(low), k=-1, dtype=bool)
        rises = bool((shorter & (low[:, None] > high)).any())
        falls = bool((shorter & (high[:, None] < low)).any())
        if rises == falls:
            return "do not grow with the way as independent ones do"
        return f"grow {'faster' if rises else 'more slowly'} with the way than independent ones do"

    def as_dict(self) -> dict[str, Any]:
        """Plain data, as in `report.json`."""
        rows = [{**one._asdict(), "interval": list(one.interval)} for one in self.lengths]
        return {"p": self.p_value, "loops": rows}


@on_host
def growth(parts: list[Part], variance: Float[np.ndarray, " 4"], *, seed: int = 0) -> Growth:
    """Compares odometry's errors in short and in long loops.

    Args:
        parts: connected maps, each at poses near its optimum.
        variance: the factors found, of `variance_components`.
        seed: of simulated errors.

    Returns:
        Lengths, and what they make of the factors: where they differ, the mean of the variance over
        lengths, and the deviation of its logarithm for a length that is not known.
    """
    found = [
        loops
        for number, part in enumerate(parts)
        if (loops := _loops_of(part, variance, np.random.default_rng([seed, number]))) is not None
    ]
    if not found:
        return Growth()
    length, expected, squared = (np.concatenate(each) for each in zip(*found, strict=True))
    named, best = [], []
    for number, least in enumerate(CLASSES):
        rows = np.searchsorted(CLASSES, length, side="right") == number + 1
        if rows.sum() >= FEWEST:
            named.append((least, int(rows.sum())))
            best.append(_likeliest(expected[rows], squared[rows]))
    return _growth(named, np.array(best)) if named else Growth()


def _growth(named: list[tuple[int, int]], log: Float[np.ndarray, "c s"]) -> Growth:
    """The numbers of real (first) and simulated errors."""
    real, drawn = log[:, 0], log[:, 1:]
    tail = 0.5 * (1.0 - COVERED)
    few, middle, many = np.quantile(drawn, [tail, 0.5, 1.0 - tail], axis=1)
    lengths = tuple(
        LengthFactor(*about, *_times(real[row], few[row], middle[row], many[row]))
        for row, about in enumerate(named)
    )
    if len(lengths) < 2:
        return Growth(lengths)
    root = np.exp(log / 3.0)
    root -= np.median(root[:, 1:], axis=1, keepdims=True)
    weight = np.linalg.pinv(np.cov(root[:, 1:]))
    far = np.einsum("cs,ck,ks->s", root, weight, root)
    p = float((1 + np.sum(far[1:] >= far[0])) / (1 + DRAWS))
    if p > LEVEL:
        return Growth(lengths, p)
    within, log_variance = np.mean(((many - few) / 3.29) ** 2), real - middle
    mean = float(np.exp(log_variance).mean())
    between = float(max(log_variance.var(ddof=1) - within, 0.0))
    spread = (between + (between + within) / len(lengths)) ** 0.5
    times = [_divided(one, mean**0.5) for one in lengths]
    return Growth(tuple(times), p, mean, float(spread))


def _divided(one: LengthFactor, times: float) -> LengthFactor:
    """The same under deviations so many times larger."""
    low, high = one.interval
    return one._replace(times=float(one.times / times), interval=(low / times, high / times))


def _times(real: float, few: float, middle: float, many: float) -> tuple[float, tuple]:
    """The factor on deviations with its interval, by quantiles of simulated ones."""
    times, low, high = (float(np.exp(0.5 * (real - each))) for each in (middle, many, few))
    return times, (low, high)


class _Chain(NamedTuple):
    """A map's edges, forward in time, in one frame, under the factors found.

    Attributes:
        start, end: int `[e]`, the earlier and the later pose.
        step: bool `[e]`, odometry.
        segment: int `[n]`, of poses that odometry joins.
        residual: `[e, d]`, ξ.
        covariance: `[e, d, d]`, likewise.
    """

    start: Int[np.ndarray, " e"]
    end: Int[np.ndarray, " e"]
    step: Bool[np.ndarray, " e"]
    segment: Int[np.ndarray, " n"]
    residual: Float[np.ndarray, "e d"]
    covariance: Float[np.ndarray, "e d d"]

    def summed(self, errors: Float[np.ndarray, "e ..."]) -> Float[np.ndarray, "n ..."]:
        """Sums over the odometry up to each pose."""
        total = np.zeros((len(self.segment), *errors.shape[1:]))
        total[self.end[self.step]] = errors[self.step]
        return np.cumsum(total, axis=0)

    def around(
        self, errors: Float[np.ndarray, "e d s"], loops: _Loops
    ) -> Float[np.ndarray, "l d s"]:
        """Sums of errors around loops."""
        total = self.summed(errors)

        def one(edges: np.ndarray) -> np.ndarray:
            return total[self.end[edges]] - total[self.start[edges]] - errors[edges]

        return one(loops.first) - np.where(loops.paired[:, None, None], one(loops.second), 0.0)


class _Loops(NamedTuple):
    """Loops of one closure, or of two.

    Attributes:
        first: int `[l]`, edges.
        second: int `[l]`, the same edge for a loop of one.
        length: int `[l]`, steps of odometry.
    """

    first: Int[np.ndarray, " l"]
    second: Int[np.ndarray, " l"]
    length: Int[np.ndarray, " l"]

    @property
    def paired(self) -> Bool[np.ndarray, " l"]:
        return self.first != self.second


def _loops_of(
    part: Part, variance: Float[np.ndarray, " 4"], generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Lengths `[l]`; P by Z `[l, d]` and c² `[l, d, 1 + s]` along their common axes."""
    chain = _chain(part, variance)
    loops = _thinned(_all_loops(chain))
    if not len(loops.length):
        return None
    measured = chain.covariance[loops.first]
    measured = measured + np.where(loops.paired[:, None, None], chain.covariance[loops.second], 0.0)
    inverse = np.linalg.inv(np.linalg.cholesky(measured))
    way = inverse @ _odometry(chain, loops) @ inverse.swapaxes(1, 2)
    expected, axes = np.linalg.eigh(0.5 * (way + way.swapaxes(1, 2)))
    turned = axes.swapaxes(1, 2) @ inverse
    lower = np.linalg.cholesky(chain.covariance)
    squared = [(turned @ chain.around(chain.residual[..., None], loops)) ** 2]
    for first in range(0, DRAWS, AT_ONCE):
        shape = (*chain.residual.shape, min(AT_ONCE, DRAWS - first))
        drawn = lower @ generator.normal(size=shape)
        squared.append((turned @ chain.around(drawn, loops)) ** 2)
    return loops.length, np.maximum(expected, 0.0), np.concatenate(squared, axis=2)


def _chain(part: Part, variance: Float[np.ndarray, " 4"]) -> _Chain:
    stated = np.asarray(part.graph.information)
    information = scaled_information(stated, part.closing, 1.0 / variance)
    graph = dataclasses.replace(part.graph, information=information)
    graph = optimize(graph, initial="given").graph
    poses: Any = lie.as_numpy(graph.poses)
    middle = lie.translation(poses).mean(axis=0)
    centred = np.array(lie.parameters(poses))
    centred[:, -len(middle) :] -= middle
    poses = graph.group(centred)
    tail, head = np.asarray(graph.tail), np.asarray(graph.head)
    ends = (lie.take(poses, tail), lie.take(poses, head))
    measured = lie.inverse(lie.as_numpy(graph.measurement))
    residual = np.asarray(lie.log(lie.compose(measured, lie.between(*ends))))
    adjoint = np.asarray(lie.adjoint(ends[1])) * np.where(head > tail, 1.0, -1.0)[:, None, None]
    joined = np.zeros(graph.num_poses, bool)
    joined[np.maximum(tail, head)[~part.closing]] = True
    return _Chain(
        np.minimum(tail, head),
        np.maximum(tail, head),
        ~part.closing,
        np.cumsum(~joined),
        (adjoint @ residual[..., None])[..., 0],
        adjoint @ np.linalg.inv(information) @ adjoint.swapaxes(1, 2),
    )


def _all_loops(chain: _Chain) -> _Loops:
    """Each closure of one robot with odometry; pairs whose ends are near each other."""
    closing = np.flatnonzero(~chain.step)
    start, end = chain.segment[chain.start], chain.segment[chain.end]
    alone = closing[start[closing] == end[closing]]
    found = [_Loops(alone, alone, (chain.end - chain.start)[alone])]
    order = closing[np.lexsort((chain.start[closing], end[closing], start[closing]))]
    for lag in LAGS:
        u, v = order[:-lag], order[lag:]
        length = abs(chain.start[u] - chain.start[v]) + abs(chain.end[u] - chain.end[v])
        ours = (start[u] == start[v]) & (end[u] == end[v]) & (length > 0)
        around = np.minimum(chain.end[u] - chain.start[u], chain.end[v] - chain.start[v])
        between = start[u] != end[u]
        crossing = np.maximum(chain.start[u], chain.start[v]) >= np.minimum(
            chain.end[u], chain.end[v]
        )
        near = ours & (between | ((2 * length < around) & ~crossing))
        found.append(_Loops(u[near], v[near], length[near]))
    return _Loops(*(np.concatenate(each) for each in zip(*found, strict=True)))


def _thinned(loops: _Loops) -> _Loops:
    """Some of each class, evenly spaced."""
    kind = np.searchsorted(CLASSES, loops.length, side="right")
    kept = []
    for number in range(1, len(CLASSES) + 1):
        rows = np.flatnonzero(kind == number)
        kept.append(
            rows[np.unique(np.linspace(0, len(rows) - 1, min(MOST, len(rows))).astype(int))]
        )
    rows = np.concatenate(kept)
    return _Loops(*(each[rows] for each in loops))


def _odometry(chain: _Chain, loops: _Loops) -> Float[np.ndarray, "l d d"]:
    """P: the covariance that odometry adds on the way."""
    total = chain.summed(chain.covariance)
    (i, j), (k, m) = (
        np.sort([each[loops.first], each[loops.second]], axis=0)
        for each in (chain.start, chain.end)
    )
    pair = total[j] - total[i] + total[m] - total[k]
    return np.where(loops.paired[:, None, None], pair, total[k] - total[i])


def _likeliest(
    expected: Float[np.ndarray, "l d"], squared: Float[np.ndarray, "l d s"]
) -> Float[np.ndarray, " s"]:
    """The log s with the largest density, of each column."""
    best, log = np.full(squared.shape[2], -np.inf), np.zeros(squared.shape[2])
    for each in GRID:
        spread = 1.0 + np.exp(each) * expected
        density = -np.log(spread).sum() - np.einsum("ld,lds->s", 1.0 / spread, squared)
        better = density > best
        best[better], log[better] = density[better], each
    return log
