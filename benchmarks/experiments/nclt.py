"""Two sessions of NCLT: their own odometry and ground truth, synchronised, as keyframes.

A session is two text files, `NAME_gt_trajectory.txt` and `NAME_odom_trajectory.txt` (or `.xz`,
`.gz`), with lines `timestamp x y z` and four columns of orientation. What they hold is not always
what their first line says:

- the ground truth's columns `qx qy qz qw` are roll, pitch, yaw and a number made up to look like a
  quaternion where the angles are small. Each file is read both ways; the reading that moves as the
  odometry does is taken;
- times of the two differ by milliseconds, rates may differ by more: the truth is interpolated at
  the odometry's times, and where it has a gap the odometry is left out;
- odometry jumps by metres within 0.4 s. Faster than `TOP_SPEED` drives no Segway: such steps are
  kept, with deviations as large as the jump.

How wrong odometry is, is measured against the truth, robustly: see `drift_sigmas`.

NCLT (Carlevaris-Bianco, Ushani and Eustice 2016) is licensed under ODbL 1.0 and DbCL 1.0.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jaxlie
import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import FileFormatError, InputError, lie
from pcm_jax.files.source import read_lines
from pcm_jax.files.text import Rows, table_rows
from pcm_jax.graph.validation import raise_first
from pcm_jax.tables import is_number

COLUMNS = "timestamp x y z and four of orientation"
SUFFIXES = ("", ".xz", ".gz")

KEYFRAME_DISTANCE = 2.0  # m
KEYFRAME_ANGLE = np.deg2rad(30.0)
TOP_SPEED = 2.5  # m/s; NCLT's Segway drives 1.3, and 99 % of the time less than 2
HORIZON = 20  # keyframes, 40 m: the drift between two registrations that PCM compares

_LARGEST_GAP = 1.0  # s between two true poses that may be interpolated
_SAME_TIME = 0.02  # s from a true pose that is near enough, whatever lies beyond it
_READING_STEPS = 5  # of odometry, over which readings of the truth are compared
_LARGEST_DISAGREEMENT = 1.0  # m and rad over so many steps; 0.2 in NCLT
_MAD = 1.4826  # a normal's standard deviation over its median absolute value


class Table(NamedTuple):
    """The numbers of a trajectory file.

    Attributes:
        path: the file.
        seconds: increasing.
        places: m.
        turns: the four columns of orientation.
        lines: line of each row in the file.
        dropped: rows with a NaN, or not later than the one before.
    """

    path: Path
    seconds: Float[np.ndarray, " n"]
    places: Float[np.ndarray, "n 3"]
    turns: Float[np.ndarray, "n 4"]
    lines: Int[np.ndarray, " n"]
    dropped: int


class Session(NamedTuple):
    """One drive as keyframes.

    Attributes:
        name: as in its files' names.
        odometry, truth: SE(3) `[n]`, NumPy; the odometry starts anywhere, the truth is in a frame
            that all sessions share.
        covariance: of the odometry's steps `[n - 1, 6, 6]`, right perturbation, m² and rad².
        sigmas: standard deviations of a good step `[6]`, m and rad.
        about: what was read and found, for the record.
    """

    name: str
    odometry: Any
    truth: Any
    covariance: Float[np.ndarray, "s 6 6"]
    sigmas: Float[np.ndarray, " 6"]
    about: dict[str, Any]


def read_session(folder: Path, name: str, horizon: int = HORIZON) -> Session:
    """Both files of a session, synchronised and thinned to keyframes.

    Args:
        folder: where the files are.
        name: what their names start with.
        horizon: keyframes, see `drift_sigmas`.

    Raises:
        InputError: a file is missing, a line is no pose (named), or the files have no time in
            common or contradict each other.
    """
    given, measured = (read_table(find(folder, name, kind)) for kind in ("gt", "odom"))
    odometry = _poses(measured.places, _unit(measured))
    at, seconds = overlap(given, measured)
    odometry, readings = lie.take(odometry, at), _readings(given)
    truths = {kind: interpolated(given.seconds, poses, seconds) for kind, poses in readings.items()}
    misfits = {kind: _disagreement(odometry, truth) for kind, truth in truths.items()}
    reading = min(misfits, key=lambda kind: misfits[kind])
    if not misfits[reading] < _LARGEST_DISAGREEMENT:
        raise InputError(
            f"{given.path}: moves otherwise than {measured.path.name} (by {misfits[reading]:.2g} m "
            f"and rad over {_READING_STEPS} steps), expected the same drive"
        )
    about = {
        "orientation of the truth": reading,
        "rows": {"odometry": len(measured.seconds), "truth": len(given.seconds)},
        "rows dropped": {"odometry": measured.dropped, "truth": given.dropped},
        "rows of odometry without truth": len(measured.seconds) - len(at),
    }
    return keyframed(name, seconds, odometry, truths[reading], about, horizon)


def find(folder: Path, name: str, kind: str) -> Path:
    """The file of a session, plain or compressed."""
    base = f"{name}_{kind}_trajectory.txt"
    for suffix in SUFFIXES:
        if (folder / (base + suffix)).is_file():
            return folder / (base + suffix)
    raise FileFormatError(folder / base, None, "there is no such file, nor with .xz or .gz added")


def read_table(path: Path) -> Table:
    """The rows of a trajectory file in the order of time; those with a NaN are left out.

    Raises:
        FileFormatError: a line without eight numbers, or fewer than two rows are left.
    """
    lines = read_lines(path)
    rows = table_rows(str(path), lines)
    rows.check_width(8, COLUMNS, len(lines))
    values = _numbers(rows)
    raise_first(
        np.isinf(values).any(axis=1), rows.fault, lambda _: "infinite, expected finite numbers"
    )
    kept = np.flatnonzero(~np.isnan(values).any(axis=1))
    latest = np.maximum.accumulate(values[kept, 0])
    kept = kept[np.diff(latest, prepend=-np.inf) > 0]
    if len(kept) < 2:
        raise FileFormatError(path, None, f"{len(kept)} poses, expected two at least: {COLUMNS}")
    good = values[kept]
    return Table(
        path, good[:, 0], good[:, 1:4], good[:, 4:], rows.line[kept], len(rows) - len(kept)
    )


def overlap(truth: Table, odometry: Table) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the odometry at whose time the truth is known, and those times.

    Raises:
        InputError: fewer than `_READING_STEPS` + 2 such rows.
    """
    times, at = truth.seconds, odometry.seconds
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    before, later = at - times[after - 1], times[after] - at
    between = (before >= 0) & (later >= 0) & (before + later <= _LARGEST_GAP)
    near = np.minimum(np.abs(before), np.abs(later)) <= _SAME_TIME
    rows = np.flatnonzero(between | near)
    if len(rows) < _READING_STEPS + 2:
        raise InputError(
            f"{truth.path}: {len(rows)} poses at the times of {odometry.path.name}, expected at "
            f"least {_READING_STEPS + 2} ({times[0]:.3f} to {times[-1]:.3f} s against "
            f"{at[0]:.3f} to {at[-1]:.3f} s)"
        )
    return rows, at[rows]


def interpolated(seconds: Float[np.ndarray, " n"], poses: Any, at: Float[np.ndarray, " k"]) -> Any:
    """Poses at other times: along the screw from the one before to the one after.

    Outside of `seconds` the first and the last pose stand still.
    """
    after = np.clip(np.searchsorted(seconds, at), 1, len(seconds) - 1)
    share = (at - seconds[after - 1]) / (seconds[after] - seconds[after - 1])
    start = lie.take(poses, after - 1)
    way: Any = lie.log(lie.between(start, lie.take(poses, after)))
    return lie.compose(start, lie.exp(jaxlie.SE3, np.clip(share, 0.0, 1.0)[:, None] * way))


def keyframed(
    name: str,
    seconds: Float[np.ndarray, " k"],
    odometry: Any,
    truth: Any,
    about: dict[str, Any],
    horizon: int = HORIZON,
) -> Session:
    """A session of synchronised poses, and how far its odometry is to be believed.

    Raises:
        InputError: a drive that is shorter than the horizon.
    """
    frames = keyframes(odometry)
    if len(frames) < horizon + 2:
        raise InputError(
            f"{name}: {len(frames)} keyframes of {KEYFRAME_DISTANCE:g} m, expected at least "
            f"{horizon + 2}"
        )
    widened = _widened(seconds, odometry, frames)
    odometry, truth = lie.take(odometry, frames), lie.take(truth, frames)
    sigmas = drift_sigmas(odometry, truth, horizon)
    variances = widened + sigmas**2
    jumped = int(np.count_nonzero(widened.any(axis=1)))
    about = about | {"keyframes": len(frames), "steps that jump": jumped}
    return Session(name, odometry, truth, variances[:, :, None] * np.eye(6), sigmas, about)


def keyframes(poses: Any) -> Int[np.ndarray, " n"]:
    """The first pose, and each that is a keyframe's distance or angle from the last one taken."""
    parameters = lie.parameters(poses)
    turns, places = parameters[:, :4], parameters[:, 4:]
    least_cosine = np.cos(0.5 * KEYFRAME_ANGLE)  # of half the angle: a quaternion's product
    taken = [0]
    for k in range(1, len(parameters)):
        last = taken[-1]
        far = np.sum((places[k] - places[last]) ** 2) >= KEYFRAME_DISTANCE**2
        if far or abs(turns[k] @ turns[last]) <= least_cosine:
            taken.append(k)
    return np.array(taken)


def drift_sigmas(odometry: Any, truth: Any, horizon: int = HORIZON) -> Float[np.ndarray, " 6"]:
    """Standard deviations of a step, such that the drift over `horizon` steps is what it is.

    The errors of NCLT's steps are no white noise: 1.1 to 1.5° of rotation in one step, which is
    mostly the tilt of a Segway seen 0.1 s too late, have become no more than 2.5° after a hundred.
    A deviation that is right for one step is then several times too large for the drift between
    two places that a pair of closures compares. So that what is independent of step to step is the
    random walk alone:

    - translation: median absolute error of single steps, axis by axis;
    - rotation: median absolute error over `horizon` steps, over its root;
    - all scaled so that the median of the squared Mahalanobis distances over `horizon` steps is
      that of chi-squared with 6 degrees of freedom.

    Medians, since jumps are none of the noise.
    """
    steps, far = step_errors(odometry, truth, 1), step_errors(odometry, truth, horizon)
    sigmas = _MAD * np.median(np.abs(steps), axis=0)
    sigmas[3:] = _MAD * np.median(np.abs(far[:, 3:]), axis=0) / np.sqrt(horizon)
    return sigmas * np.sqrt(excess(odometry, truth, sigmas, horizon))


def excess(odometry: Any, truth: Any, sigmas: Float[np.ndarray, " 6"], horizon: int) -> float:
    """Median squared Mahalanobis distance of the drift over `horizon` steps, over that expected."""
    from scipy.stats import chi2

    error = step_errors(odometry, truth, horizon)
    ends = lie.inverse(lie.take(odometry, np.s_[horizon:]))
    covariance = np.zeros((len(error), 6, 6))
    for s in range(1, horizon + 1):
        step = lie.take(odometry, np.s_[s : len(error) + s])
        adjoint = lie.adjoint(lie.compose(ends, step)) * sigmas
        covariance += adjoint @ np.swapaxes(adjoint, 1, 2)
    squared = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    return float(np.median(squared) / chi2.ppf(0.5, 6))


def portion(session: Session, keyframes: slice) -> Session:
    """Part of a session; the noise of its odometry stays that of the whole."""
    rows = np.arange(len(lie.parameters(session.truth)))[keyframes]
    return session._replace(
        odometry=lie.take(session.odometry, rows),
        truth=lie.take(session.truth, rows),
        covariance=session.covariance[rows[:-1]],
    )


def step_errors(odometry: Any, truth: Any, horizon: int) -> Float[np.ndarray, "k 6"]:
    """Log of the true relative pose's inverse times the odometry's, `horizon` poses later."""
    moved, true = (
        lie.between(lie.take(poses, np.s_[:-horizon]), lie.take(poses, np.s_[horizon:]))
        for poses in (odometry, truth)
    )
    error: Any = lie.log(lie.between(true, moved))
    return error


def _numbers(rows: Rows) -> Float[np.ndarray, "n 8"]:
    """All words as numbers, NaN among them."""
    try:
        return np.array(rows.words, dtype=float).reshape(-1, 8)
    except ValueError:
        wrong = next(k for k, word in enumerate(rows.words) if not is_number(word))
        problem = f"{rows.words[wrong][:40]!r} given, expected a number"
        raise rows.fault(wrong // 8, problem) from None


def _unit(table: Table) -> Float[np.ndarray, "n 4"]:
    """The odometry's quaternions, x y z w, as they should be."""
    length = np.linalg.norm(table.turns, axis=1, keepdims=True)

    def fault(row: int, problem: str) -> FileFormatError:
        return FileFormatError(table.path, int(table.lines[row]), problem)

    def problem(row: int) -> str:
        return f"a quaternion of length {length[row, 0]:.3g}, expected x y z w of length 1"

    wrong: Bool[np.ndarray, " n"] = np.abs(length[:, 0] - 1.0) > 0.01
    raise_first(wrong, fault, problem)
    return table.turns / length


def _readings(truth: Table) -> dict[str, Any]:
    """The two meanings that the truth's four columns of orientation may have."""
    from scipy.spatial.transform import Rotation

    angles = Rotation.from_euler("xyz", truth.turns[:, :3]).as_quat()
    readings = {"roll pitch yaw": _poses(truth.places, angles)}
    length = np.linalg.norm(truth.turns, axis=1, keepdims=True)
    if np.all(length > 0):
        readings["quaternion"] = _poses(truth.places, truth.turns / length)
    return readings


def _poses(places: Float[np.ndarray, "n 3"], turns: Float[np.ndarray, "n 4"]) -> Any:
    """SE(3) of places and quaternions x y z w."""
    parameters: Any = np.concatenate([turns[:, 3:], turns[:, :3], places], axis=1)
    return jaxlie.SE3(parameters)


def _disagreement(odometry: Any, truth: Any) -> float:
    return float(np.median(np.linalg.norm(step_errors(odometry, truth, _READING_STEPS), axis=1)))


def _widened(
    seconds: Float[np.ndarray, " k"], odometry: Any, frames: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n-1 6"]:
    """Variances that jumps add to the steps from keyframe to keyframe: their own squares."""
    moves = lie.log(lie.between(lie.take(odometry, np.s_[:-1]), lie.take(odometry, np.s_[1:])))
    squared = np.stack([np.sum(part**2, axis=1) for part in (moves[:, :3], moves[:, 3:])], axis=1)
    squared[squared[:, 0] <= (TOP_SPEED * np.diff(seconds)) ** 2] = 0.0
    return np.repeat(np.add.reduceat(squared[: frames[-1]], frames[:-1], axis=0), 3, axis=1)
