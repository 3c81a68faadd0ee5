"""Drives with the loop candidates of a real place-recognition front end, and their labels.

Two collections are read, each file as its public repository stores it, plain or xz-compressed.

KITTI odometry 00 (`kitti_robust/00/kitti_00_alpha_A.g2o`): visual odometry, and what bags of binary
words found at several thresholds A. The true poses are the chained edges of `kitti_00_GT.g2o`; the
right candidates are listed, a pair of ids a line, in `kitti_00_alpha_A_GT_LC.txt`. Whatever is not
listed is stored as the identity transform: a place taken for another without any registration.

Bicocca 2009-02-25b (`rrr/B25b_A.g2o`): wheel odometry, and what bags of words and a registration
found. The true poses are interpolated in `*-GT-extended.csv` (time, x, y, heading) at the times of
`B25b_timestamps.txt`. Labels do not exist: a candidate is called right if its measurement is within
a distance and an angle of the truth (`TOLERANCE`). Errors are spread without a gap from centimetres
to metres, so that no threshold is beyond dispute.

`simulated` stands in for either collection where its files are not at hand; `sessions` makes two
robots of one drive.
"""

from __future__ import annotations

import lzma
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.errors import InputError
from pcm_jax.files import read_graph
from pcm_jax.graph import MultiRobotGraph, PoseGraph, split
from pcm_jax.pipeline import select_within
from pcm_jax.simulation import simulate_city

TOLERANCE = (1.0, 10.0)
"""m, degrees: how far the measurement of a right candidate may be from the truth (Bicocca)."""


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


def simulated(seed: int, *, aliased: bool, poses: int = 1_200) -> Candidates:
    """Simulates a drive through a city whose wrong candidates are as in one of the collections.

    Args:
        seed: of the city and of the candidates.
        aliased: whether one street is taken for another, pose after pose, as Bicocca's corridors
            are; else wrong candidates say "the same pose", as KITTI's do.
        poses: of the drive.
    """
    world = simulate_city(seed=seed, poses=poses, sigma_translation=0.05, blocks=16)
    clean, truth = world.graph.maps[0], lie.as_numpy(world.truth[0])
    tail, head = _wrong_ends(seed, poses, aliased=aliased)
    wrong: Any = lie.identity(clean.group, (len(tail),))
    if aliased:
        aside: Any = np.tile([30.0, 20.0, 0.5], (len(tail), 1))
        moved = lie.as_numpy(lie.exp(clean.group, aside))
        wrong = lie.between(lie.take(truth, tail), lie.compose(moved, lie.take(truth, head)))
    graph = PoseGraph.from_arrays(
        poses=clean.poses,
        tail=np.concatenate([clean.tail, tail]),
        head=np.concatenate([clean.head, head]),
        measurement=lie.concatenate([lie.as_numpy(clean.measurement), lie.as_numpy(wrong)]),
        information=np.concatenate([clean.information, clean.information[: len(tail)]]),
    )
    right = (np.arange(graph.num_edges) < clean.num_edges) & ~steps(graph)
    return Candidates("aliased" if aliased else "same pose", graph, truth, right, listed=True)


def _wrong_ends(
    seed: int, poses: int, *, aliased: bool
) -> tuple[Int[np.ndarray, " w"], Int[np.ndarray, " w"]]:
    """The poses that wrong candidates of a simulated drive join."""
    if aliased:
        first = np.arange(poses // 12)
        return first + 9 * poses // 10, first + poses // 3
    head, tail = np.sort(np.random.default_rng(seed).choice(poses, (2, poses // 8)), axis=0)
    apart = tail - head > 50
    return tail[apart], head[apart]


@on_host
def sessions(graph: PoseGraph, cut: int, maps: str) -> MultiRobotGraph:
    """Two robots' maps, each in the frame of its first pose, and all candidates across the cut."""
    both = split(graph, cut)
    made = []
    for one in both.maps:
        first = lie.inverse(lie.take(lie.as_numpy(one.poses), 0))
        own = one.with_poses(lie.compose(first, lie.as_numpy(one.poses)))
        if maps == "odometry":
            own = own.with_edges(steps(own))
        elif maps == "cleaned" and not steps(own).all():
            own = select_within(own).graph
        made.append(own)
    return MultiRobotGraph(tuple(made), both.closures)


def sessions_truth(candidates: Candidates, cut: int) -> tuple[Any, Any]:
    """The two robots' true poses, in one frame."""
    parts = slice(None, cut), slice(cut, None)
    first, second = (lie.take(candidates.truth, part) for part in parts)
    return first, second


def across(graph: PoseGraph, cut: int) -> np.ndarray:
    """int64 `[m]`: the edges that `split` makes closures, in its order."""
    tail, head = np.asarray(graph.tail), np.asarray(graph.head)
    return np.flatnonzero(((tail < cut) != (head < cut)) & ~steps(graph))


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
