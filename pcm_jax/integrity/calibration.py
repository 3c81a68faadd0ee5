"""`Calibration`: how honest the stated covariances are, in numbers and in words."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtri

from pcm_jax.graph import MultiRobotGraph, PoseGraph
from pcm_jax.integrity.loop_lengths import Growth
from pcm_jax.integrity.variance_components import Components, scaled_information
from pcm_jax.tables import NOTHING, ShownAsTable

Graph = TypeVar("Graph", PoseGraph, MultiRobotGraph)

ALIKE = 1.25
"""Times, up or down: a factor on the information that is no news."""
VAGUE = 10.0
"""Times its lower end, the upper end of an interval that says little."""
NEAR_IT = 1.1
"""Times, beyond the interval's ends: a factor is the information itself, so that is a root."""
SHOWN = 200
"""Quantiles of a kind."""


class Factor(float):
    """A factor on the information (1: as stated), with the interval that holds it in 9 of 10 cases.

    Attributes:
        interval: its lower and upper end; (0, ∞) where the data say nothing of it.
    """

    interval: tuple[float, float]

    def __new__(cls, value: float, interval: tuple[float, float]) -> Factor:
        """Makes a number that knows its interval."""
        made = super().__new__(cls, value)
        made.interval = interval
        return made

    def __getnewargs__(self) -> tuple[float, tuple[float, float]]:
        return float(self), self.interval

    @property
    def known(self) -> bool:
        """True where the data say anything of it."""
        return bool(np.isfinite(self.interval[1]))

    def __repr__(self) -> str:
        low, high = self.interval
        return f"{float(self):.4g} ({low:.4g} to {high:.4g})" if self.known else "unknown"


class Factors(NamedTuple):
    """The factors on the information of one kind of edge.

    Attributes:
        translation: on that of translations, 1/m².
        rotation: on that of rotations, 1/rad².
    """

    translation: Factor
    rotation: Factor


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(ShownAsTable):
    """The factors on stated information under which residuals are as large as they should be.

    Attributes:
        odometry: of edges between consecutive poses.
        closures: of all others, inside maps and between robots.
        map_consistency: the normalised chi-squared of each map's own loops with information as
            stated, 1 where it is honest; None for a map without loops.
        accepted: bool [m], the closures between robots that it went by.
        widened: how many times larger than stated the deviations had to be for that.
        used: how many closures it went by, inside maps and between robots.
        left_out: closures inside maps that it did not, as false.
        tangent_dim: d, 3 or 6.
        components: the numbers behind it.
        median_information: float64 [4], as stated, in the order of the factors.
        growth: odometry's errors by the length of loops.
    """

    odometry: Factors
    closures: Factors
    map_consistency: tuple[float | None, ...]
    accepted: Bool[np.ndarray, " m"]
    widened: float
    used: int
    left_out: int
    tangent_dim: int
    components: Components
    median_information: Float[np.ndarray, " 4"]
    growth: Growth = dataclasses.field(default_factory=Growth)

    def __repr__(self) -> str:
        return (
            f"Calibration(by {self.used} closures)\n"
            f"  odometry  translation {self.odometry.translation!r}, rotation"
            f" {self.odometry.rotation!r}\n"
            f"  closures  translation {self.closures.translation!r}, rotation"
            f" {self.closures.rotation!r}"
        )

    def _table(self) -> tuple[Sequence[str], Iterable[Sequence[object]]]:
        rows = (
            (kind, name, *_numbers(factor), _how(factor).partition(" (")[0])
            for kind, factors in (("odometry", self.odometry), ("closures", self.closures))
            for name, factor in factors._asdict().items()
        )
        return ("edges", "errors in", "factor on information", "90 % interval", "so"), rows

    def __str__(self) -> str:
        return "\n".join(self.advice())

    @property
    def factors(self) -> tuple[Factor, ...]:
        """All four, odometry's first, translation's first."""
        return (*self.odometry, *self.closures)

    def advice(self) -> list[str]:
        """Says in words what is misstated, and what to do about it; a line each."""
        told = [
            _in_words(kind, *factors)
            for kind, factors in (("odometry", self.odometry), ("closures", self.closures))
        ]
        if self.growth.uneven:
            told.append(self.growth.words)
        if self.widened > 1.0 and self._is_too_sure():
            told.append(
                f"with deviations as stated few of {len(self.accepted)} closures between robots"
                f" agree, under these factors {int(self.accepted.sum())} do"
            )
        if self.left_out:
            told.append(f"{self.left_out} closures inside maps contradict the others: left out")
        if self._is_square_root():
            told.append(
                "the factors are the information itself: the file holds its square root;"
                " --information sqrt would make them 1"
            )
        if self.components.tails.max() > 3.0:
            told.append(
                "a few residuals are far larger than the others: the factors are those of a mixture"
            )
        return told

    def apply(self, graph: Graph) -> Graph:
        """Multiplies the information of a graph by the factors; what is not known stays.

            merged = pcm_jax.merge(pcm_jax.calibrate(graph).apply(graph))

        Args:
            graph: maps, and closures between robots if it has any.
        """
        if isinstance(graph, PoseGraph):
            return _scaled_map(graph, np.array(self.factors))  # type: ignore[return-value]
        return scaled_graph(graph, np.array(self.factors))  # type: ignore[return-value]

    def as_dict(self) -> dict[str, Any]:
        """Plain data, as in `report.json`."""

        def of(factors: Factors) -> dict[str, Any]:
            return {
                name: {
                    "factor": float(factor) if factor.known else None,
                    "interval": list(factor.interval) if factor.known else None,
                }
                for name, factor in factors._asdict().items()
            }

        return {
            "odometry": of(self.odometry),
            "closures": of(self.closures),
            "map_consistency": list(self.map_consistency),
            "closures_used": self.used,
            "advice": str(self),
            "growth": self.growth.as_dict(),
            "quantiles": self.quantiles(),
        }

    def quantiles(self) -> dict[str, dict[str, list[float]]]:
        """Quantiles of chi-squared, and of squared residuals as stated; of many some of them."""
        drawn = {}
        names = ("odometry", "closures")
        for name, squared in zip(names, self.components.as_stated, strict=True):
            if len(squared):
                expected, observed = quantiles_of(squared, self.tangent_dim)
                drawn[name] = {"expected": expected.tolist(), "observed": observed.tolist()}
        return drawn

    def _is_too_sure(self) -> bool:
        """True where some information is stated too large."""
        return any(factor.known and factor.interval[1] < 1.0 for factor in self.factors)

    def _is_square_root(self) -> bool:
        """True where every factor that is known may be the information itself, and none is 1."""
        known = [row for row, factor in enumerate(self.factors) if factor.known]
        for row in known:
            low, high = self.factors[row].interval
            own = self.median_information[row]
            if low <= 1.0 <= high or not low / NEAR_IT <= own <= high * NEAR_IT:
                return False
        return bool(known)


def quantiles_of(
    squared: Float[np.ndarray, " n"], d: int
) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"]]:
    """Quantiles of chi-squared and of some numbers, ascending; of many some, with the ends.

    Args:
        squared: the numbers.
        d: degrees of freedom.
    """
    count = len(squared)
    rank = np.unique(np.round(np.linspace(0, count - 1, min(count, SHOWN))).astype(int))
    return chdtri(d, 1.0 - (rank + 0.5) / count), np.sort(squared)[rank]


def closing_edges(pose_graph: PoseGraph) -> Bool[np.ndarray, " e"]:
    """Marks the edges of a map that are loop closures: all but the first between neighbours."""
    tail, head = np.asarray(pose_graph.tail), np.asarray(pose_graph.head)
    steps = np.flatnonzero(np.abs(tail - head) == 1)
    _, first = np.unique(np.minimum(tail, head)[steps], return_index=True)
    closing = np.ones(len(tail), bool)
    closing[steps[first]] = False
    return closing


def scaled_graph(graph: MultiRobotGraph, factors: Float[np.ndarray, " 4"]) -> MultiRobotGraph:
    """Multiplies the information of maps and of the closures between them.

    Args:
        graph: the maps.
        factors: float64 [4], of odometry's translation and rotation, of closures' likewise.
    """
    closures = graph.closures
    information = np.asarray(closures.information)
    between = scaled_information(information, np.ones(len(closures), bool), factors)
    return dataclasses.replace(
        graph,
        maps=tuple(_scaled_map(one, factors) for one in graph.maps),
        closures=dataclasses.replace(closures, information=between),
    )


def _scaled_map(pose_graph: PoseGraph, factors: Float[np.ndarray, " 4"]) -> PoseGraph:
    information, closing = np.asarray(pose_graph.information), closing_edges(pose_graph)
    scaled = scaled_information(information, closing, factors)
    return dataclasses.replace(pose_graph, information=scaled)


def _in_words(kind: str, translation: Factor, rotation: Factor) -> str:
    said = [
        f"{name} {_how(factor)}"
        for name, factor in (("translation", translation), ("rotation", rotation))
    ]
    return f"{kind}: {', '.join(said)}"


def _numbers(factor: Factor) -> tuple[str, str]:
    """A factor and its interval, as text."""
    if not factor.known:
        return NOTHING, NOTHING
    low, high = factor.interval
    return f"{float(factor):.3g}", f"{low:.3g} to {high:.3g}"


def _how(factor: Factor) -> str:
    if not factor.known:
        return "errors cannot be told from these data"
    low, high = (f"{end:.3g}" for end in factor.interval)
    times = f"information times {float(factor):.3g}, {low} to {high}"
    honest = factor.interval[0] <= 1.0 <= factor.interval[1]
    if honest and factor.interval[1] > VAGUE * factor.interval[0]:
        return f"errors may be as stated ({times})"
    if honest or 1.0 / ALIKE < factor < ALIKE:
        return f"errors are about as stated ({times})"
    off = float(factor) ** 0.5
    if off > 1.0:
        return f"errors are stated {off:.3g} times too large ({times})"
    return f"errors are stated {1.0 / off:.3g} times too small ({times})"
