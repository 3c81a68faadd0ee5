"""Every method on the same maps, the same closures and the same Q, beside the truth.

`compare_methods` makes what the paper's tables and threshold sweeps are made of: the maps are
optimised once, Q is computed once, and the closures that several methods agree on are merged once.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.consistency import Evidence
from pcm_jax.errors import InputError, InputWarning
from pcm_jax.evaluation.metrics import (
    false_positive_rate,
    pose_error,
    precision,
    relative_map_pose_error,
    relative_pose_error,
    true_positive_rate,
)
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.graph.checked import as_mask
from pcm_jax.pipeline import merge, select, weigh
from pcm_jax.selection import METHODS

REFERENCE = "no-outliers"


class Method(NamedTuple):
    """A row of a comparison.

    Attributes:
        name: a method of `merge`, by name or as a function; "all", every closure accepted; or
            "true", the right ones only.
        confidence: of its gate.
        options: the method's own, as (name, value) pairs.
        true_start: whether a robust method starts from the true alignment of the maps.
    """

    name: Any
    confidence: float = 0.99
    options: tuple[tuple[str, Any], ...] = ()
    true_start: bool = False


PAPER: dict[str, Method] = {
    REFERENCE: Method("true"),
    "dcs": Method("dcs"),
    "scgp": Method("scgp"),
    "ransac-1": Method("ransac", 0.01),
    "ransac-3.5": Method("ransac", 0.035),
    "pcm-exact-11": Method("pcm-exact", 0.11),
    "pcm-heuristic-11": Method("pcm-heuristic", 0.11),
}
"""The rows of the paper's Table I: numbers are the percentage inside the gate."""

CALIBRATED: dict[str, Method] = {
    "pcm-exact-99": Method("pcm-exact"),
    "pcm-heuristic-99": Method("pcm-heuristic"),
    "ransac-99": Method("ransac"),
}
"""The same methods where covariances are what they say: 99 % of right pairs pass."""

BEYOND_THE_PAPER: dict[str, Method] = {
    "scgp-binary": Method("scgp", options=(("affinity", "binary"),)),
    "clipper": Method("clipper"),
    "dcs-true-start": Method("dcs", true_start=True),
    "gnc": Method("gnc"),
    "switchable": Method("switchable"),
    "max-mixture": Method("max-mixture"),
    "everything": Method("all"),
}
"""What users meet elsewhere. `dcs-true-start` is told the true alignment of the maps."""


_CALLED = {
    "pcm-exact": "PCM",
    "pcm-heuristic": "PCM-HeuPatt",
    "ransac": "RANSAC",
    "scgp": "SCGP",
    "scgp-binary": "SCGP, binary",
    "dcs": "DCS",
    "dcs-true-start": "DCS, true start",
    "gnc": "GNC",
    "clipper": "CLIPPER",
    "combinatorial": "enumeration",
    "no-outliers": "no outliers",
}


def called(label: str) -> str:
    """A method's name as people write it, of the label of a row, its gate in percent behind.

        called("pcm-exact-11")  # "PCM, 11 %"

    Args:
        label: such as those of `PAPER`; one that is not known stays.
    """
    name, _, percent = label.rpartition("-")
    if name in _CALLED and percent.replace(".", "").isdigit():
        return f"{_CALLED[name]}, {percent} %"
    return _CALLED.get(label, label)


def _selects(method: Method) -> bool:
    """True if a method selects from the evidence, a function of one's own included."""
    return callable(method.name) or method.name in METHODS


class Compared(NamedTuple):
    """The result of one method.

    Attributes:
        accepted: bool `[m]`.
        maps: the robots' maps where the solve left them, in the frame of the first robot if it was
            tied to the others. A robust method's are in one frame even where it accepted nothing.
        figures: numbers by name, the columns of a table. `tpr`, `fpr`, `precision`; with a truth
            `translation_mse` (m²), `rotation_mse` (rad), `ate_rmse` (m) against it in the frame of
            the first true pose, `map_translation_mse`, `map_rotation_mse` of the maps' first poses
            seen from the first map's, `step_translation_mse`, `step_rotation_mse` of consecutive
            poses; the first four also `..._from_reference`, against the merge by the right closures
            alone; `residual` Σ rᵀΩr; `chi2`, normalised; `iterations`; `converged`; `seconds` of
            selecting from Q and merging, compilation apart.
    """

    accepted: Bool[np.ndarray, " m"]
    maps: tuple[Any, ...]
    figures: dict[str, float]


@on_host
def compare_methods(
    graph: MultiRobotGraph | Evidence,
    is_true: Any,
    truth: Sequence[Any] | None = None,
    *,
    methods: Mapping[str, Method] | None = None,
    optimized: bool = False,
    minimum_inliers: int = 2,
    engine: str = "blocks",
) -> dict[str, Compared]:
    """Runs methods on one graph and holds each against the truth.

    Args:
        graph: maps and candidate closures, or what `weigh` found of them.
        is_true: bool `[m]`, which closures are right.
        truth: true poses of each robot in one frame, Lie `[n]` each; None: no map errors.
        methods: rows by label; by default the paper's, and its three at a calibrated gate. The
            merge by the right closures alone, the reference, is always made.
        optimized: whether the maps are at their optimum already; evidence's are.
        minimum_inliers: as in `merge`, of the selectors.
        engine: "blocks" or "cholmod".

    Returns:
        Results by label, in the order of `methods`. Merges that do not converge, which false
        closures make common, are no reason to warn here: `figures["converged"]` says so.

    Raises:
        InputError: an unknown method, `is_true` of a wrong shape, a truth of other robots, and
            what `merge` raises.
    """
    rows = dict(PAPER | CALIBRATED if methods is None else methods)
    given = graph.graph if isinstance(graph, Evidence) else graph
    right = as_mask(is_true, "is_true", len(given.closures))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        bench = _Bench(graph, right, truth, rows, optimized, minimum_inliers, engine)
        return {label: bench.result(label, method) for label, method in rows.items()}


def mean_figures(results: Iterable[Mapping[str, Compared]]) -> dict[str, dict[str, float]]:
    """Means over several graphs of every figure, by method."""
    many = list(results)
    return {
        label: {
            name: float(np.mean([each[label].figures[name] for each in many]))
            for name in many[0][label].figures
        }
        for label in many[0]
    }


class _Selected(NamedTuple):
    """The closures that a method selects from Q, and how long that took."""

    accepted: np.ndarray
    seconds: float


class _Bench:
    """All that methods share on one graph: maps, Q, merges by the same closures, the reference.

    All merges share one symbolic plan, with room for whatever a method selects; but for the merge
    by every closure, whose plan is large.
    """

    def __init__(
        self,
        graph: MultiRobotGraph | Evidence,
        is_true: np.ndarray,
        truth: Sequence[Any] | None,
        rows: Mapping[str, Method],
        optimized: bool,
        minimum_inliers: int,
        engine: str,
    ):
        known = isinstance(graph, Evidence)
        weighing: Any = {"optimized": optimized, "memory_limit": np.inf}
        self.evidence = graph if known else weigh(graph, **weighing)
        self.graph = self.evidence.optimized
        self.is_true, self.truth = is_true, truth
        self.minimum_inliers, self.engine = minimum_inliers, engine
        self.selected = {
            label: self._selected(method) for label, method in rows.items() if _selects(method)
        }
        chosen = [each.accepted for each in self.selected.values()]
        self.room = np.any([is_true, *chosen], axis=0)
        self.merges: dict[bytes, Any] = {}
        self.reference = self._merged(is_true)

    def result(self, label: str, method: Method) -> Compared:
        if _selects(method):
            accepted, selecting = self.selected[label]
            merged = self._merged(accepted)
        elif method.name in ("true", "all"):
            accepted, selecting = self.is_true | (method.name == "all"), 0.0
            merged = self._merged(accepted)
        else:
            merged, selecting = self._robust(method), 0.0
            accepted = merged.accepted
        maps = merged.robust.maps if merged.robust else merged.graph.maps
        seconds = selecting + merged.seconds["merge"] - merged.seconds["compile"]
        return Compared(accepted, maps, self._figures(merged, accepted, maps, seconds))

    def _selected(self, method: Method) -> _Selected:
        start = time.perf_counter()
        chosen = select(
            self.evidence,
            method=method.name,
            confidence=method.confidence,
            minimum_inliers=self.minimum_inliers,
            **dict(method.options),
        )
        return _Selected(chosen.accepted, time.perf_counter() - start)

    def _merged(self, accepted: np.ndarray) -> Any:
        key = accepted.tobytes()
        if key not in self.merges:
            room = self.room if not np.any(accepted & ~self.room) else None
            self.merges[key] = merge(
                self.evidence, accepted=accepted, room_for=room, engine=self.engine
            )
        return self.merges[key]

    def _robust(self, method: Method) -> Any:
        options = dict(method.options)
        if method.true_start:
            options["anchors"] = self._true_anchors()
        return merge(
            self.evidence,
            method=method.name,
            confidence=method.confidence,
            engine=self.engine,
            **options,
        )

    def _true_anchors(self) -> Any:
        """T_r that put each map's first pose where it truly is, seen from the first map's."""
        if self.truth is None:
            raise InputError("truth: None given, expected true poses for a start from the truth")
        own = lie.stack([lie.take(lie.as_numpy(one.poses), 0) for one in self.graph.maps])
        true = lie.stack([lie.take(lie.as_numpy(poses), 0) for poses in self.truth])
        first = np.zeros(len(self.graph.maps), int)
        into_map = lie.compose(lie.take(own, first), lie.inverse(lie.take(true, first)))
        return lie.compose(lie.compose(into_map, true), lie.inverse(own))

    def _figures(self, merged: Any, accepted: Any, maps: Any, seconds: float) -> dict[str, float]:
        is_true: Any = self.is_true
        figures: dict[str, Any] = {
            "tpr": true_positive_rate(accepted, is_true),
            "fpr": false_positive_rate(accepted, is_true),
            "precision": precision(accepted, is_true) if accepted.any() else 1.0,
        }
        if self.truth is not None:
            figures |= _map_errors(maps, self.truth)
        reference = [one.poses for one in self.reference.graph.maps]
        figures |= {f"{k}_from_reference": v for k, v in _map_errors(maps, reference).items()}
        chi2 = merged.solution.normalized_chi2
        figures |= {
            "residual": 2.0 * merged.solution.cost,
            "chi2": np.nan if chi2 is None else chi2,
            "iterations": merged.solution.iterations,
            "converged": merged.solution.converged,
            "accepted": np.count_nonzero(accepted),
            "seconds": seconds,
        }
        return {name: float(value) for name, value in figures.items()}


def _map_errors(maps: Sequence[Any], truth: Sequence[Any]) -> dict[str, Any]:
    whole = pose_error(maps, truth)
    between = relative_map_pose_error(maps, truth)
    steps = relative_pose_error(maps, truth)
    return {
        "translation_mse": whole.translation_mse,
        "rotation_mse": whole.rotation_mse,
        "ate_rmse": whole.translation_mse**0.5,
        "map_translation_mse": between.translation_mse,
        "map_rotation_mse": between.rotation_mse,
        "step_translation_mse": steps.translation_mse,
        "step_rotation_mse": steps.rotation_mse,
    }
