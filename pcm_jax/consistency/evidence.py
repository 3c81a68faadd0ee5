"""`Evidence`: what every pair of robots' closures say of each other, computed once.

Everything before it (maps, covariances, Q, the streamed graph) costs time; everything after it
(gates, methods, weights, explanations) is cheap and can be asked again and again. `weigh` makes it.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax.arrays import as_array
from pcm_jax.consistency.graph import consistency_graph
from pcm_jax.consistency.limit import Limit, comparable
from pcm_jax.consistency.packed import PackedGraph
from pcm_jax.consistency.problem import ConsistencyProblem, problem_from_covariances
from pcm_jax.consistency.shuffled import ShuffledByMetric, ShuffledClosures
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph
from pcm_jax.mapping import MapCovariance
from pcm_jax.tables import ShownAsTable

KEPT_GATES = 2
"""Streamed graphs that a pair of robots keeps, of the gates asked for last."""


@dataclass(frozen=True, eq=False, repr=False)
class PairEvidence:
    """The evidence of the k closures between two robots: what they say of each other.

    Attributes:
        robot_a: index of the robot with the smaller index.
        robot_b: index of the other.
        closures: int64 [k], their indices among the graph's closures, ascending.
        measured: the closures themselves, turned to run from a to b; None where there are none to
            speak of (`from_squared`).
        covariances: a `MapCovariance` of map a and of map b; None likewise.
    """

    robot_a: int
    robot_b: int
    closures: Int[np.ndarray, " k"]
    measured: LoopClosures | None = None
    covariances: tuple[MapCovariance, MapCovariance] | None = None
    _squared: Float[np.ndarray, "k k"] | None = None
    _freedom: Int[np.ndarray, "k k"] | None = None
    _distances: Callable[[], Limit] | None = None
    _stream: Callable[[float], PackedGraph] | None = None
    _metric: Callable[[LoopClosures], Float[np.ndarray, "k k"]] | None = None
    _kept: OrderedDict[float, PackedGraph] = field(default_factory=OrderedDict)
    _lock: Any = field(default_factory=threading.Lock)

    @classmethod
    def from_squared(cls, squared: Float[np.ndarray, "k k"]) -> PairEvidence:
        """Makes evidence of a matrix of one's own, as if between robots 0 and 1.

        Args:
            squared: [k, k], `[u, v]` is q²_uv, not necessarily symmetric.

        Raises:
            InputError: unless it is a square matrix of numbers.
        """
        checked = checked_squared(squared)
        return cls(0, 1, np.arange(len(checked)), _squared=checked)

    def __len__(self) -> int:
        return len(self.closures)

    def __repr__(self) -> str:
        kept = "streamed: a graph for each gate" if self.is_streamed else "distances kept"
        return (
            f"PairEvidence(robots {self.robot_a} and {self.robot_b})\n"
            f"  closures  {len(self)}\n"
            f"  evidence  {kept}"
        )

    @classmethod
    def with_graph(
        cls,
        robots: tuple[int, int],
        closures: Int[np.ndarray, " k"],
        measured: LoopClosures,
        covariances: tuple[MapCovariance, MapCovariance],
        known: tuple[float, PackedGraph] | None,
        **found: Callable[..., Any],
    ) -> PairEvidence:
        """Makes evidence whose graph at one gate is known, before any distance is asked for.

        Args:
            robots: a and b.
            closures: as the attribute of that name.
            measured: likewise.
            covariances: likewise.
            known: a gate and the graph at it; None: none is known.
            **found: how anything else is found when it is asked for: `distances`, without
                arguments, or `stream`, of a gate, where distances take too much memory; `metric`
                for those of a function of one's own.
        """
        ways: dict[str, Any] = {f"_{name}": way for name, way in found.items()}
        evidence = cls(*robots, closures, measured, covariances, **ways)
        if known is not None:
            evidence._kept[known[0]] = known[1]
        return evidence

    @property
    def is_streamed(self) -> bool:
        """True where the distances took more memory than allowed: only graphs are at hand."""
        return self._squared is None and self._distances is None

    def _found(self) -> Limit | None:
        """Distances and degrees of freedom, computed when first asked; None where streamed."""
        with self._lock:
            if self._squared is None and self._distances is not None:
                squared, freedom = self._distances()
                object.__setattr__(self, "_freedom", freedom)
                object.__setattr__(self, "_squared", squared)
        return None if self._squared is None else Limit(self._squared, self._freedom)

    @property
    def squared(self) -> Float[np.ndarray, "k k"]:
        """Squared Mahalanobis distances (paper, eq. 4), float64, not symmetrised.

        Raises:
            InputError: if they take more memory than `weigh` was allowed.
        """
        found = self._found()
        if found is None:
            raise InputError(
                f"squared: not kept for the {len(self)} closures between robots {self.robot_a} "
                f"and {self.robot_b}, expected a larger memory_limit for them"
            )
        return found.squared

    @property
    def freedom(self) -> Int[np.ndarray, "k k"] | None:
        """Degrees of freedom of each pair's q²; None where all have d (see `freedom_of`)."""
        found = self._found()
        return None if found is None else found.freedom

    @property
    def comparable(self) -> Float[np.ndarray, "k k"]:
        """Squared distances for one gate: of pairs with fewer than d degrees of freedom, as likely.

        `squared` itself where every pair has d. A pair of n degrees has the χ²_d that is exceeded
        as rarely as its q² is by χ²_n; one of none is infinite.

        Raises:
            InputError: as `squared`.
        """
        squared, freedom = self.squared, self.freedom
        if freedom is None or self.measured is None:
            return squared
        return comparable(squared, freedom, self.measured.tangent_dim)

    def problem(self) -> ConsistencyProblem:
        """Gathers the input of Q anew: Mahalanobis evidence does not keep what is easily rebuilt.

        Raises:
            InputError: for evidence of another metric, or of a matrix of one's own.
        """
        if self.covariances is None or self.measured is None or self._metric is not None:
            raise InputError("problem: these distances are a metric's own, expected Mahalanobis")
        return problem_from_covariances(*self.covariances, self.measured)

    @property
    def maps(self) -> tuple[PoseGraph, PoseGraph] | None:
        """The two optimised maps; None where there are none to speak of."""
        return None if self.covariances is None else tuple(c.pose_graph for c in self.covariances)  # type: ignore[return-value]

    def shuffles(
        self,
        gate: float,
        among: Int[np.ndarray, " c"] | None = None,
        joined: Bool[np.ndarray, "c c"] | None = None,
    ) -> ShuffledClosures | ShuffledByMetric:
        """Prepares some closures (all, by default) to have their measurements shuffled.

        Args:
            gate: γ².
            among: `[c]` indices among the k.
            joined: the pairs that may have an edge; None: all.

        Raises:
            InputError: for distances alone.
        """
        if self.covariances is None or self.measured is None:
            raise InputError("evidence: distances alone given, expected closures between two maps")
        chosen = self.measured if among is None else self.measured[among]
        if self._metric is not None:
            return ShuffledByMetric(chosen, self._metric, gate, joined)
        problem = problem_from_covariances(*self.covariances, chosen)
        return ShuffledClosures(problem, gate, joined)

    def packed(self, gate: float) -> PackedGraph:
        """The consistency graph, one bit a pair; a streamed one is kept for the last gates."""
        if gate not in self._kept and not self.is_streamed:
            dense = self.consistent(gate)
            return PackedGraph(np.packbits(dense, axis=1), len(dense))
        with self._lock:
            if gate not in self._kept:
                self._kept[gate] = self._stream(gate)  # type: ignore[misc]
                while len(self._kept) > KEPT_GATES:
                    self._kept.popitem(last=False)
            return self._kept[gate]

    def consistent(self, gate: float) -> Bool[np.ndarray, "k k"]:
        """The consistency graph, k² bytes; pairs of fewer than d degrees have gates of their own.

        A streamed pair weighs its closures anew for a gate that was not among the last two.

        Args:
            gate: γ², see `chi2_gate`.
        """
        if gate in self._kept or self.is_streamed:
            return self.packed(gate).dense()
        return np.asarray(consistency_graph(self.comparable, gate))  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False, repr=False)
class Evidence(ShownAsTable):
    """The evidence of a graph: what its closures say of each other, for every pair of robots.

    Attributes:
        graph: as given.
        maps: the optimised maps that the distances were measured in.
        covariances: a `MapCovariance` of each map, factorised when first asked.
        pairs: one `PairEvidence` per pair of robots that closures join, by robot index.
        metric: "mahalanobis", or the name of the function that measured.
        seconds: wall-clock time of "optimize", "marginals" and "consistency".
    """

    graph: MultiRobotGraph
    maps: tuple[PoseGraph, ...]
    covariances: tuple[Any, ...]
    pairs: tuple[PairEvidence, ...]
    metric: str
    seconds: dict[str, float]

    def __repr__(self) -> str:
        names = self.graph.names
        told = [f"{names[p.robot_a]}-{names[p.robot_b]} {len(p)}" for p in self.pairs]
        return (
            f"Evidence({len(self.maps)} maps, {len(self.graph.closures)} closures)\n"
            f"  pairs   {', '.join(told) or 'none'}\n"
            f"  metric  {self.metric}, {sum(self.seconds.values()):.2g} s"
        )

    def _table(self) -> tuple[Sequence[str], Iterable[Sequence[object]]]:
        names = self.graph.names
        rows = (
            (
                f"{names[pair.robot_a]} – {names[pair.robot_b]}",
                len(pair),
                "streamed" if pair.is_streamed else "kept",
            )
            for pair in self.pairs
        )
        return ("robots", "closures", "distances"), rows

    @property
    def optimized(self) -> MultiRobotGraph:
        """The optimised maps with all closures."""
        return MultiRobotGraph(self.maps, self.graph.closures)

    @property
    def tangent_dim(self) -> int:
        """d: 3 for SE(2), 6 for SE(3)."""
        return self.graph.tangent_dim


def checked_squared(squared: Any, what: str = "squared") -> Float[np.ndarray, "k k"]:
    """A matrix of squared distances as float64.

    Raises:
        InputError: unless it is square, and of numbers.
    """
    distances = as_array(squared, what)
    if distances.ndim != 2 or distances.shape[0] != distances.shape[1]:
        raise InputError(f"{what}: shape {distances.shape}, expected [m, m]")
    if distances.dtype.kind not in "iuf":
        raise InputError(f"{what}: dtype {distances.dtype}, expected numbers")
    return distances.astype(np.float64)
