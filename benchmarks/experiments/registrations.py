"""Scan registrations that stand in for GICP's: right, poor and false ones.

The paper's own are not public. What is known of such registrations is how GICP did on Duderstadt: a
median of 0.07 to 0.11 m and 1°, 0.21 to 0.28 m and 2.4 to 3° at 95 %. Student's t with 4 degrees of
freedom has both quantiles (a normal has not), so a registration is the true relative pose times the
exponential of such noise; recorded is the noise's covariance, its tails included.

Every fourth keyframe of the first session is a candidate, matched with the nearest keyframe of the
second. As in the paper, right is what the truth says is within a threshold, and the right ones are
thinned (to 1/16 there, leaving 10; here to 10) and put among 98 outliers:

- *poor*: registrations of the same places that the threshold calls wrong. Their error is a few
  sigmas, so that PCM may well keep them: the paper's found 10 + 3 such;
- *aliased*: two groups of four that share one wrong alignment;
- *near identity*: the optimiser stayed where it started, at places far apart;
- *swapped*: the registration of another pair of keyframes; half of the rest each.

Inside a session, keyframes that return to a place are registered with an earlier one: the paper's
sessions are pose graphs with loop closures, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jaxlie
import numpy as np
from jaxtyping import Bool, Float, Int

from benchmarks.experiments.nclt import Session
from pcm_jax import InputError, LoopClosures, MultiRobotGraph, PoseGraph, lie
from pcm_jax.graph.multi_robot import letter_names
from pcm_jax.simulation.measurements import diagonal_covariance, measure, revisits
from pcm_jax.simulation.outliers import aliased_closures

INLIERS, OUTLIERS = 10, 98  # as in the paper
EVERY = 4  # keyframes from one candidate to the next
REACH = 3.0  # m between two scans that can be registered
SAME_SPOT = 2.0  # m

_TAIL = 4  # degrees of freedom of Student's t
_SCALE = diagonal_covariance(jaxlie.SE3, 0.0536, np.deg2rad(0.595))  # median 0.09 m, 1°
COVARIANCE = _SCALE * _TAIL / (_TAIL - 2)
"""Of a registration, right perturbation; m² and rad²."""

RIGHT_DISTANCE, RIGHT_ANGLE = 0.5, np.deg2rad(5.0)  # m, rad: beyond either a registration is wrong
ALIASED_GROUPS, ALIASED_SIZE = 2, 4
STUCK = diagonal_covariance(jaxlie.SE3, 0.5, 0.1)  # of registrations that stayed near the identity
FAR = 10.0  # m at least between two places that have nothing to do with each other

KINDS = ("true", "poor", "aliased", "near_identity", "swapped")


class Version(NamedTuple):
    """Two maps, candidate closures between them, and the truth.

    Attributes:
        graph: maps at raw odometry, each in its first pose's frame.
        is_true: bool `[m]`, within the threshold.
        kinds: for each closure one of `KINDS`.
        truth: true poses of each robot in one frame.
    """

    graph: MultiRobotGraph
    is_true: Bool[np.ndarray, " m"]
    kinds: np.ndarray
    truth: tuple[Any, ...]


class _Closures(NamedTuple):
    """Candidates of one kind."""

    kind: str
    pose_a: Int[np.ndarray, " m"]
    pose_b: Int[np.ndarray, " m"]
    measurement: Any


def draw_version(generator: np.random.Generator, sessions: Sequence[Session]) -> Version:
    """Everything that is simulated of two sessions, drawn anew.

    Raises:
        InputError: the sessions share fewer than two places, or are shorter than the outliers need.
    """
    a, b = sessions
    maps = tuple(
        session_map(generator, each, name)
        for each, name in zip(sessions, letter_names(), strict=False)
    )
    near = neighbours(a.truth, b.truth)
    measurement = register(generator, _relative(a, b, *near))
    right = is_right(measurement, _relative(a, b, *near))
    if np.count_nonzero(right) < 2:
        raise InputError(
            f"sessions: {a.name} and {b.name} have {np.count_nonzero(right)} places in common, "
            "expected at least 2"
        )
    kept = _some(generator, np.flatnonzero(right), INLIERS)
    poor = _some(generator, np.flatnonzero(~right), OUTLIERS - ALIASED_GROUPS * ALIASED_SIZE)
    parts = [
        _Closures(kind, near[0][rows], near[1][rows], lie.take(measurement, rows))
        for kind, rows in (("true", kept), ("poor", poor))
    ]
    parts += _aliased(generator, a, b)
    rest = OUTLIERS + len(kept) - sum(len(part.pose_a) for part in parts)
    parts += _mistaken(generator, a, b, rest, measurement)
    return _version(generator, maps, parts, (a.truth, b.truth))


def session_map(generator: np.random.Generator, session: Session, name: str) -> PoseGraph:
    """A session's odometry, and simulated registrations where it returns to a place."""
    places = lie.translation(session.truth)
    loops = revisits(generator, places, spot=SAME_SPOT, reach=REACH, most=1)
    steps = np.arange(len(places) - 1)
    measured = lie.between(lie.take(session.odometry, steps), lie.take(session.odometry, steps + 1))
    exact = lie.between(lie.take(session.truth, loops[:, 0]), lie.take(session.truth, loops[:, 1]))
    tail, head = np.concatenate([np.stack([steps, steps + 1], axis=-1), loops]).T
    return PoseGraph.from_arrays(
        tail=tail,
        head=head,
        measurement=lie.normalize(lie.concatenate([measured, register(generator, exact)])),
        covariance=np.concatenate([session.covariance, _repeated(len(loops))]),
        name=name,
    )


def register(generator: np.random.Generator, exact: Any) -> Any:
    """Registrations of some true relative poses `[m]`."""
    stretch = _TAIL / generator.chisquare(_TAIL, len(lie.parameters(exact)))
    return measure(generator, exact, stretch[:, None, None] * _SCALE)


def number_of_candidates(truth: Any) -> int:
    """Every fourth keyframe of a session."""
    return -(-len(lie.parameters(truth)) // EVERY)


def neighbours(truth_a: Any, truth_b: Any) -> tuple[np.ndarray, np.ndarray]:
    """Every fourth pose of a that is near b, and the nearest pose of b."""
    from scipy.spatial import KDTree

    candidates = EVERY * np.arange(number_of_candidates(truth_a))
    tree = KDTree(lie.translation(truth_b))
    distance, nearest = map(np.asarray, tree.query(lie.translation(truth_a)[candidates]))
    return candidates[distance <= REACH], nearest[distance <= REACH]


def is_right(measurement: Any, exact: Any) -> Bool[np.ndarray, " m"]:
    """Marks registrations within the threshold of the true relative poses."""
    error = lie.log(lie.between(exact, measurement))
    off, turned = (np.linalg.norm(part, axis=1) for part in (error[:, :3], error[:, 3:]))
    return (off <= RIGHT_DISTANCE) & (turned <= RIGHT_ANGLE)


def counts_by_kind(kinds: np.ndarray, accepted: Bool[np.ndarray, " m"]) -> Mapping[str, int]:
    """Counts accepted closures by kind."""
    return {kind: int(np.count_nonzero(accepted & (kinds == kind))) for kind in KINDS}


def _aliased(generator: np.random.Generator, a: Session, b: Session) -> list[_Closures]:
    candidates = lie.take(a.truth, np.s_[::EVERY])
    groups = [
        aliased_closures(
            generator,
            candidates,
            b.truth,
            size=ALIASED_SIZE,
            label=group,
            reach=REACH,
            covariance=COVARIANCE[None],
        )
        for group in range(ALIASED_GROUPS)
    ]
    return [_Closures("aliased", EVERY * g.pose_a, g.pose_b, g.measurement) for g in groups]


def _mistaken(
    generator: np.random.Generator, a: Session, b: Session, count: int, registered: Any
) -> list[_Closures]:
    """Places far apart that were taken for one: stuck at the identity, or another pair's."""
    pose_a, pose_b = _far_apart(generator, a, b, count)
    stuck = count // 2
    nothing = measure(generator, lie.identity(jaxlie.SE3, (stuck,)), STUCK[None])
    others = generator.integers(len(lie.parameters(registered)), size=count - stuck)
    return [
        _Closures("near_identity", pose_a[:stuck], pose_b[:stuck], nothing),
        _Closures("swapped", pose_a[stuck:], pose_b[stuck:], lie.take(registered, others)),
    ]


def _far_apart(
    generator: np.random.Generator, a: Session, b: Session, count: int
) -> tuple[np.ndarray, np.ndarray]:
    places = lie.translation(a.truth), lie.translation(b.truth)
    chosen = np.zeros((2, 0), int)
    for _ in range(100):
        pose_a = EVERY * generator.integers(number_of_candidates(a.truth), size=count)
        pose_b = generator.integers(len(places[1]), size=count)
        apart = np.linalg.norm(places[0][pose_a] - places[1][pose_b], axis=1) >= FAR
        chosen = np.concatenate([chosen, np.stack([pose_a, pose_b])[:, apart]], axis=1)
        if chosen.shape[1] >= count:
            return chosen[0, :count], chosen[1, :count]
    raise InputError(f"sessions: {a.name} and {b.name} have no places {FAR:g} m apart")


def _version(
    generator: np.random.Generator,
    maps: tuple[PoseGraph, ...],
    parts: Sequence[_Closures],
    truth: tuple[Any, ...],
) -> Version:
    """All candidates in shuffled order."""
    kinds = np.concatenate([np.full(len(part.pose_a), part.kind, object) for part in parts])
    order = generator.permutation(len(kinds))
    closures = LoopClosures.from_arrays(
        robot_a=np.zeros(len(kinds), int),
        pose_a=np.concatenate([part.pose_a for part in parts]),
        robot_b=np.ones(len(kinds), int),
        pose_b=np.concatenate([part.pose_b for part in parts]),
        measurement=lie.normalize(lie.concatenate([part.measurement for part in parts])),
        covariance=_repeated(len(kinds)),
    )
    kinds = kinds[order]
    return Version(MultiRobotGraph(maps, closures[order]), kinds == "true", kinds, truth)


def _relative(a: Session, b: Session, pose_a: np.ndarray, pose_b: np.ndarray) -> Any:
    return lie.between(lie.take(a.truth, pose_a), lie.take(b.truth, pose_b))


def _repeated(count: int) -> Float[np.ndarray, "m 6 6"]:
    return np.broadcast_to(COVARIANCE, (count, 6, 6))


def _some(
    generator: np.random.Generator, rows: Int[np.ndarray, " r"], most: int
) -> Int[np.ndarray, " c"]:
    return generator.choice(rows, size=min(most, len(rows)), replace=False)
