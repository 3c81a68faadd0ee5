"""The noise of real loop candidates (`pcm_jax.experiments.drives`), and factors that mend it."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import chi2

from pcm_jax import PoseGraph, lie
from pcm_jax.experiments.drives import TOLERANCE, Candidates, chained, errors, steps

if TYPE_CHECKING:
    from pcm_jax.selection import WithinSelection


TOLERANCES = ((0.5, 5.0), TOLERANCE, (3.0, 20.0))

NEAR = 15
"""Poses: candidates whose ends are no further apart than this close a short loop together."""

_STEPS = 10  # of odometry: enough to turn, too few to drift


class Factors(NamedTuple):
    """Factors of covariances: of odometry's, and of loop candidates'."""

    odometry: float = 1.0
    closures: float = 1.0


def rescaled(graph: PoseGraph, factors: Factors) -> PoseGraph:
    """The graph with all covariances multiplied by the factor of their kind."""
    factor = np.where(steps(graph), factors.odometry, factors.closures)
    information = np.asarray(graph.information) / factor[:, None, None]
    return dataclasses.replace(graph, information=information)


def factors_of_data(selection: WithinSelection, graph: PoseGraph) -> Factors:
    """The factors by which accepted candidates say that covariances are off, without the truth.

    Odometry's is that of the loops that accepted candidates close with odometry, which are long;
    the candidates' is that of the loops of two of them that are near each other at both ends. Both
    are medians over the expected median: sets of what passes a gate have no tails, so that means
    would shrink, the more the more often they are taken.

    Args:
        selection: of the graph, information as written.
        graph: what it was made of.
    """
    own, near = loop_ratios(selection, graph, selection.accepted)
    return Factors(_median_ratio(own), _median_ratio(near))


def factors_of_truth(selection: WithinSelection, candidates: Candidates) -> Factors:
    """The same by means over what is true: an upper bound for what can be known.

    Odometry's is the mean of the loops that right candidates close with it, the candidates' that of
    the right ones' errors against the truth (which has errors as well).
    """
    graph, right = candidates.graph, candidates.is_true
    own, _ = loop_ratios(selection, graph, right[selection.closures])
    return Factors(float(own.mean()), float(squared_errors(candidates)[right].mean()))


def loop_ratios(
    selection: WithinSelection, graph: PoseGraph, chosen: Bool[np.ndarray, " m"]
) -> tuple[np.ndarray, np.ndarray]:
    """Squared distances over d: of chosen candidates with odometry, and of pairs near each other.

    A factor of 1 would put the mean of both at 1 (and the median at that of chi-squared over d).
    """
    d, rows = graph.tangent_dim, np.flatnonzero(chosen)
    ends = np.stack([np.asarray(graph.tail), np.asarray(graph.head)])[:, selection.closures[rows]]
    near = (np.abs(ends[:, :, None] - ends[:, None]) <= NEAR).all(axis=0)
    first, second = np.nonzero(np.triu(near, 1))
    pairs = np.maximum(selection.squared, selection.squared.T)[rows[first], rows[second]]
    return selection.own_squared[rows] / d, pairs / d


def squared_errors(candidates: Candidates) -> Float[np.ndarray, " e"]:
    """Squared normalised errors of all edges against the truth, over d: 1 in the mean if honest."""
    error = errors(candidates.graph, candidates.truth)
    information = np.asarray(candidates.graph.information)
    return np.einsum("ei,eij,ej->e", error, information, error) / error.shape[1]


def noise(candidates: Candidates, selection: WithinSelection) -> dict[str, float | None]:
    """Measures of how honest the stated noise is, and how far labels can be trusted.

    Args:
        candidates: as written.
        selection: what is accepted of them as they are.

    Returns:
        Ratios of squared normalised errors to what is expected: 1 is honest, 4 means that errors
        are twice as large as stated. Medians are over the expected median.
    """
    graph, right = candidates.graph, candidates.is_true
    odometry, squared = steps(graph), squared_errors(candidates)
    own, near = loop_ratios(selection, graph, right[selection.closures])
    data, truth = (
        factors_of_data(selection, graph),
        factors_of_truth(selection, candidates),
    )
    return {
        "steps_against_truth_mean": float(squared[odometry].mean()),
        "steps_against_truth_median": _median_ratio(squared[odometry]),
        "right_against_truth_mean": float(squared[right].mean()),
        "right_against_truth_median": _median_ratio(squared[right]),
        "right_with_odometry_median": _median_ratio(own),
        "right_near_pairs_median": _median_ratio(near),
        "lever_arm_m": lever_arm(candidates),
        "factor_odometry": data.odometry,
        "factor_closures": data.closures,
        "factor_odometry_of_truth": truth.odometry,
        "factor_closures_of_truth": truth.closures,
        **_label_figures(candidates),
    }


def lever_arm(candidates: Candidates) -> float:
    """Distance from the point that odometry moves to the one whose true pose is known, m."""
    return float(np.linalg.norm(_offset(candidates)))


def without_lever_arm(candidates: Candidates) -> Any:
    """The true poses of the point that odometry moves, Lie `[n]`."""
    truth = candidates.truth
    back: Any = np.tile(np.eye(3), (candidates.graph.num_poses, 1, 1))
    back[:, :2, 2] = -_offset(candidates)
    return lie.compose(truth, lie.as_numpy(lie.from_matrix(back)))


def _offset(candidates: Candidates) -> Float[np.ndarray, " 2"]:
    """The place of the point whose true pose is known, seen from the one that odometry moves, m.

    With A a motion of odometry's frame and B the same motion of the truth's, a constant offset t
    has (R_A − 1) t = t_B − t_A: least squares over motions of ten steps.
    """
    ends = slice(None, -_STEPS), slice(_STEPS, None)
    moved, true = (
        np.asarray(lie.as_matrix(lie.between(*(lie.take(poses, end) for end in ends))))
        for poses in (chained(candidates.graph), candidates.truth)
    )
    turns = moved[:, :2, :2] - np.eye(2)
    shifts = true[:, :2, 2] - moved[:, :2, 2]
    offset, *_ = np.linalg.lstsq(turns.reshape(-1, 2), shifts.ravel(), rcond=None)
    return offset


def _label_figures(candidates: Candidates) -> dict[str, float | None]:
    graph, right = candidates.graph, candidates.is_true
    away = ~right & ~steps(graph)
    distance = np.linalg.norm(errors(graph, candidates.truth)[:, :2], axis=1)
    stored = np.abs(np.asarray(lie.log(lie.as_numpy(graph.measurement)))).max(axis=1)
    return {
        "candidates": float((right | away).sum()),
        "right": float(right.sum()),
        "false_stored_as_identity": float((away & (stored < 1e-9)).sum()),
        "largest_error_of_right_m": float(distance[right].max(initial=0.0)),
        "smallest_error_of_false_m": float(distance[away].min()) if away.any() else None,
    }


def _median_ratio(ratios: np.ndarray) -> float:
    """Median over that of chi-squared with 3 degrees of freedom over 3; 1 where there is none."""
    return float(np.median(ratios) / (chi2.ppf(0.5, 3) / 3.0)) if len(ratios) else 1.0
