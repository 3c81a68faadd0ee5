"""Trajectories with the loop candidates of a real place-recognition front end, and their labels.

Two collections are read, each file as its public repository stores it, plain or xz-compressed.

KITTI odometry 00 (`kitti_robust/00/kitti_00_alpha_A.g2o`): visual odometry, and what bags of binary
words found at several thresholds A. The true poses are the chained edges of `kitti_00_GT.g2o`; the
right candidates are listed, a pair of ids a line, in `kitti_00_alpha_A_GT_LC.txt`. Whatever is not
listed is stored as the identity transform: a place taken for another without any registration.

Bicocca 2009-02-25b (`rrr/B25b_A.g2o`): wheel odometry, and what bags of words and a registration
found. The true poses are interpolated in `*-GT-extended.csv` (time, x, y, heading) at the times of
`B25b_timestamps.txt`. Labels do not exist: a candidate is called right if its measurement is within
a distance and an angle of the truth (`TOLERANCE`). Errors are spread without a gap from centimetres
to metres, so that no threshold is beyond dispute; the experiment counts with several.
"""

from __future__ import annotations

import dataclasses
import lzma
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import chi2

from pcm_jax import InputError, PoseGraph, lie, read_graph

if TYPE_CHECKING:
    from pcm_jax.selection import WithinSelection

TOLERANCE = (1.0, 10.0)
"""m, degrees: how far the measurement of a right candidate may be from the truth (Bicocca)."""

TOLERANCES = ((0.5, 5.0), TOLERANCE, (3.0, 20.0))

NEAR = 15
"""Poses: candidates whose ends are no further apart than this close a short loop together."""

_STEPS = 10  # of odometry: enough to turn, too few to drift


class Candidates(NamedTuple):
    """One robot's odometry and loop candidates, and what is true of them.

    Attributes:
        name: the file's, without its endings.
        graph: n poses, e edges; edges between consecutive poses are odometry.
        truth: true poses, Lie `[n]`.
        is_true: bool `[e]`, the right candidates; false for odometry.
        listed: whether the labels come from a list (KITTI) or from the truth (Bicocca).
    """

    name: str
    graph: PoseGraph
    truth: Any
    is_true: Bool[np.ndarray, " e"]
    listed: bool


class Factors(NamedTuple):
    """Factors of covariances: of odometry's, and of loop candidates'."""

    odometry: float = 1.0
    closures: float = 1.0


def found(data: Path) -> list[str]:
    """The names of all files of candidates below a folder, each collection by threshold.

    Args:
        data: a folder with `kitti_robust` or `rrr` in it.
    """
    return sorted(_files(data))


def spread(names: list[str]) -> list[str]:
    """The loosest, the middle and the strictest threshold of each collection."""
    chosen = []
    for collection in dict.fromkeys(name.rpartition("_")[0] for name in names):
        group = [name for name in names if name.rpartition("_")[0] == collection]
        chosen += [group[k] for k in sorted({0, (len(group) - 1) // 2, len(group) - 1})]
    return chosen


def load(data: Path, name: str) -> Candidates:
    """Reads one file of candidates, its truth and its labels.

    Args:
        data: as for `found`.
        name: one of those found.

    Raises:
        InputError: for a file that is not there, or a truth of another number of poses.
    """
    path = _files(data).get(name)
    if path is None:
        raise InputError(f"name: {name!r}, expected one of {', '.join(found(data)) or 'no file'}")
    (graph,) = read_graph(path).maps
    prefix, alpha, _ = name.partition("_alpha_")
    if alpha:
        (truth,) = read_graph(_beside(path, f"{prefix}_GT.g2o")).maps
        poses, is_true = lie.as_numpy(truth.poses), _listed(graph, path, f"{name}_GT_LC.txt")
    else:
        poses = _interpolated(path, f"{name.rpartition('_')[0]}_timestamps.txt")
        is_true = None
    if len(lie.parameters(poses)) != graph.num_poses:
        raise InputError(
            f"name: {name!r} has {graph.num_poses} poses, but its truth "
            f"{len(lie.parameters(poses))}, expected as many"
        )
    if is_true is None:
        is_true = within_tolerance(graph, poses, TOLERANCE)
    return Candidates(name, graph, poses, is_true, bool(alpha))


def steps(graph: PoseGraph) -> Bool[np.ndarray, " e"]:
    """Marks the edges that are odometry: those between consecutive poses."""
    return np.abs(np.asarray(graph.tail) - np.asarray(graph.head)) == 1


def errors(graph: PoseGraph, truth: Any) -> Float[np.ndarray, "e d"]:
    """Errors of the edges' measurements, each in its own right perturbation: m, rad."""
    ends = (lie.take(truth, np.asarray(end)) for end in (graph.tail, graph.head))
    return np.asarray(lie.log(lie.between(lie.as_numpy(graph.measurement), lie.between(*ends))))


def within_tolerance(
    graph: PoseGraph, truth: Any, tolerance: tuple[float, float]
) -> Bool[np.ndarray, " e"]:
    """Marks candidates that measure what is true to so many metres and degrees; no odometry."""
    error, (metres, degrees) = errors(graph, truth), tolerance
    near = np.linalg.norm(error[:, :2], axis=1) <= metres
    return near & (np.abs(error[:, 2]) <= np.radians(degrees)) & ~steps(graph)


def chained(graph: PoseGraph) -> Any:
    """The poses that odometry alone adds up to, Lie `[n]`."""
    odometry = graph.with_edges(steps(graph))
    ends = {"tail": odometry.tail, "head": odometry.head}
    measured = {"measurement": odometry.measurement, "information": odometry.information}
    return lie.as_numpy(PoseGraph.from_arrays(**ends, **measured).poses)


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
    """Distance from the point that odometry moves to the one whose true pose is known, m.

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
    return float(np.linalg.norm(offset))


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


def _files(data: Path) -> dict[str, Path]:
    patterns = ("kitti_robust/*/*_alpha_*.g2o*", "rrr/*_[0-9]*.[0-9]*.g2o*")
    paths = [path for pattern in patterns for path in data.glob(pattern)]
    return {path.name.partition(".g2o")[0]: path for path in paths}


def _beside(path: Path, name: str) -> Path:
    """A file of the same folder, plain or compressed."""
    plain = path.parent / name
    compressed = path.parent / f"{name}.xz"
    if not plain.exists() and not compressed.exists():
        raise InputError(f"name: {name} not found beside {path.name}")
    return plain if plain.exists() else compressed


def _table(path: Path, **options: Any) -> np.ndarray:
    opened = lzma.open(path, "rt") if path.suffix == ".xz" else path.open()  # noqa: SIM115
    with opened as lines:
        return np.loadtxt(lines, ndmin=2, **options)


def _listed(graph: PoseGraph, path: Path, name: str) -> Bool[np.ndarray, " e"]:
    """Marks the edges that join a pair of ids that is listed, in either order."""
    listed = {frozenset(pair) for pair in _table(_beside(path, name), dtype=int).tolist()}
    ends = zip(graph.ids[graph.tail].tolist(), graph.ids[graph.head].tolist(), strict=True)
    return np.array([frozenset(pair) in listed for pair in ends]) & ~steps(graph)


def _interpolated(path: Path, stamps: str) -> Any:
    """True poses at the times of the odometry's; held at either end of the truth."""
    names = sorted(path.parent.glob("*GT-extended.csv*"))
    if not names:
        raise InputError(f"name: no *GT-extended.csv found beside {path.name}")
    when = _table(_beside(path, stamps)).ravel()
    time, x, y, heading = _table(names[0], delimiter=",").T
    values = [np.interp(when, time, each) for each in (x, y, np.unwrap(heading))]
    cosine, sine = np.cos(values[2]), np.sin(values[2])
    matrices: Any = np.tile(np.eye(3), (len(when), 1, 1))
    matrices[:, :2, :2] = np.stack([cosine, -sine, sine, cosine], axis=-1).reshape(-1, 2, 2)
    matrices[:, :2, 2] = np.stack(values[:2], axis=-1)
    return lie.from_matrix(matrices)
