"""NCLT's files with all that is wrong about them, in small ones written here, and the real ones."""

from __future__ import annotations

import lzma
from typing import Any, NamedTuple

import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.experiments import nclt
from pcm_jax import InputError, lie

RATE, SPEED = 2.5, 1.3  # rows a second, m/s
NAME = "2000-01-01"


class Drive(NamedTuple):
    """A smooth drive: seconds, places, and roll, pitch, yaw."""

    seconds: np.ndarray
    places: np.ndarray
    angles: np.ndarray

    @property
    def quaternions(self):
        return Rotation.from_euler("xyz", self.angles).as_quat()

    @property
    def poses(self):
        return jaxlie.SE3(np.concatenate([self.quaternions[:, [3, 0, 1, 2]], self.places], axis=1))


def drive(seconds, *, turn=0.02):
    """Round a circle of a radius of SPEED / turn metres on swaying ground."""
    t = np.asarray(seconds, float)
    heading = 0.3 + turn * t
    radius = SPEED / turn
    places = np.stack(
        [radius * np.sin(heading), -radius * np.cos(heading), 0.5 * np.sin(0.1 * t)], axis=1
    )
    angles = np.stack([0.03 * np.sin(0.5 * t), 0.05 * np.cos(0.4 * t), heading], axis=1)
    return Drive(1.3e9 + t, places, angles)


def times(count=400, rate=RATE):
    return np.arange(count) / rate


def as_nclt_writes(true):
    """Angles in the columns of a quaternion, and a last number that often makes it a unit one."""
    squared = np.sum(true.angles**2, axis=1)
    return np.column_stack([true.angles, np.sqrt(np.clip(1.0 - squared, 0.0, None))])


def odometry_of(true, *, sigma=0.002, seed=0):
    """The drive seen from its own first pose, with a little noise on every row."""
    poses = lie.compose(lie.inverse(lie.take(true.poses, 0)), true.poses)
    noise = sigma * np.random.default_rng(seed).standard_normal((len(true.seconds), 6))
    return lie.compose(poses, lie.exp(jaxlie.SE3, noise))


@pytest.fixture
def write(tmp_path):
    """Writes both files of a session, and gives their folder."""

    def table(kind, seconds, places, turns, suffix=""):
        rows = np.column_stack([seconds, places, turns])
        text = "# timestamp x y z qx qy qz qw\n" + "".join(
            " ".join(f"{x:.6f}" for x in row) + "\n" for row in rows
        )
        path = tmp_path / f"{NAME}_{kind}_trajectory.txt{suffix}"
        path.write_bytes(lzma.compress(text.encode()) if suffix else text.encode())
        return path

    def make(true, odometry, *, seconds=None, turns=None, suffix=""):
        table("gt", true.seconds, true.places, as_nclt_writes(true) if turns is None else turns)
        parameters = np.asarray(odometry.wxyz_xyz)
        places, turns = parameters[:, 4:], parameters[:, [1, 2, 3, 0]]
        table("odom", true.seconds if seconds is None else seconds, places, turns, suffix)
        return tmp_path

    return make


def at_keyframes(true, odometry):
    return lie.take(true.poses, nclt.keyframes(odometry))


def assert_same_poses(poses, expected, atol):
    error: Any = lie.log(lie.between(expected, poses))
    np.testing.assert_allclose(error, 0.0, atol=atol)


@pytest.mark.parametrize("turn", [0.02, 0.001], ids=["all headings", "unit rows only"])
@pytest.mark.parametrize("suffix", ["", ".xz"])
def test_angles_called_quaternions(write, turn, suffix):
    true = drive(times(), turn=turn)
    odometry = odometry_of(true)
    lengths = np.linalg.norm(as_nclt_writes(true), axis=1)
    assert (lengths.max() > 1.1) == (turn == 0.02)
    session = nclt.read_session(write(true, odometry, suffix=suffix), NAME)
    assert session.about["orientation of the truth"] == "roll pitch yaw"
    assert_same_poses(session.truth, at_keyframes(true, odometry), 1e-5)


def test_quaternions_that_are_some(write):
    true = drive(times())
    odometry = odometry_of(true)
    session = nclt.read_session(write(true, odometry, turns=true.quaternions), NAME)
    assert session.about["orientation of the truth"] == "quaternion"
    assert_same_poses(session.truth, at_keyframes(true, odometry), 1e-5)


def test_rows_without_numbers_and_rows_out_of_order(write):
    true = drive(times())
    odometry = odometry_of(true)
    folder = write(true, odometry)
    path = folder / f"{NAME}_gt_trajectory.txt"
    lines = path.read_text().split("\n")
    lines[101] = " ".join([lines[101].split()[0], *["nan"] * 7])
    lines.insert(202, lines[150])
    path.write_text("\n".join(lines))
    session = nclt.read_session(folder, NAME)
    assert session.about["rows dropped"] == {"odometry": 0, "truth": 2}
    assert session.about["rows of odometry without truth"] == 0
    assert_same_poses(session.truth, at_keyframes(true, odometry), 3e-3)  # one is interpolated


def test_truth_at_other_times(write):
    coarse, fine = times(600, 3.7), times()
    true, wanted = drive(coarse - 0.05), drive(fine)
    odometry = odometry_of(wanted)
    session = nclt.read_session(write(true, odometry, seconds=wanted.seconds), NAME)
    assert session.about["rows of odometry without truth"] == 0
    assert_same_poses(session.truth, at_keyframes(wanted, odometry), 5e-3)


def test_odometry_in_a_gap_of_the_truth(write):
    true = drive(times())
    odometry = odometry_of(true)
    seen = np.ones(400, bool)
    seen[100:110] = False
    there = Drive(*(column[seen] for column in true))
    session = nclt.read_session(write(there, odometry, seconds=true.seconds), NAME)
    assert session.about["rows of odometry without truth"] == 10
    assert_same_poses(session.truth, at_keyframes(there, lie.take(odometry, seen)), 1e-5)


def test_a_jump_is_not_believed(write):
    true = drive(times())
    smooth = odometry_of(true)
    plain = nclt.read_session(write(true, smooth), NAME)
    jump = lie.exp(jaxlie.SE3, np.array([4.0, 0.0, 1.0, 0.0, 0.0, 0.8]))
    start, rest = lie.take(smooth, np.s_[:200]), lie.take(smooth, np.s_[200:])
    last = lie.take(start, -1)
    moved = lie.compose(lie.compose(last, jump), lie.compose(lie.inverse(last), rest))
    session = nclt.read_session(write(true, lie.concatenate([start, moved])), NAME)
    assert np.all(np.abs(np.log(session.sigmas / plain.sigmas)) < np.log(1.5))
    sigmas = np.sqrt(np.diagonal(session.covariance, axis1=1, axis2=2))
    wide = np.flatnonzero(sigmas[:, 0] > 2 * session.sigmas[0])
    assert len(wide) == 1
    assert session.about["steps that jump"] == 1
    assert np.all(sigmas[wide[0]] > [3.9] * 3 + [0.7] * 3)
    assert np.all(sigmas[wide[0]] < [5.2] * 3 + [1.0] * 3)
    error = np.linalg.norm(nclt.step_errors(session.odometry, session.truth, 1)[:, :3], axis=1)
    assert wide[0] == np.argmax(error)


def test_keyframes_by_distance_and_by_angle():
    ahead = np.zeros((40, 6))
    ahead[:20, 0], ahead[20:, 5] = 0.6, np.deg2rad(7.0)
    poses = [lie.identity(jaxlie.SE3)]
    for move in ahead:
        poses.append(lie.compose(poses[-1], lie.exp(jaxlie.SE3, move)))
    frames = nclt.keyframes(lie.stack(poses))
    np.testing.assert_array_equal(frames, [0, 4, 8, 12, 16, 20, 25, 30, 35, 40])


def walk(rng, count, sigmas, jitter):
    """Truth and odometry that errs by a random walk, and by `jitter` (rad) on every pose alone."""
    true = drive(times(count, 0.65)).poses
    moves = lie.between(lie.take(true, np.s_[:-1]), lie.take(true, np.s_[1:]))
    noise = rng.standard_normal((count - 1, 6)) * sigmas
    moves = lie.compose(moves, lie.exp(jaxlie.SE3, noise))
    poses = [lie.identity(jaxlie.SE3)]
    for k in range(count - 1):
        poses.append(lie.compose(poses[-1], lie.take(moves, k)))
    shaken = np.concatenate([np.zeros((count, 3)), jitter * rng.standard_normal((count, 3))], 1)
    return true, lie.compose(lie.stack(poses), lie.exp(jaxlie.SE3, shaken))


def test_noise_is_that_of_the_drift():
    sigmas = np.array([0.08, 0.06, 0.05, 0.004, 0.005, 0.006])
    true, odometry = walk(np.random.default_rng(0), 2_000, sigmas, 0.0)
    found = nclt.drift_sigmas(odometry, true)
    np.testing.assert_allclose(found, sigmas, rtol=0.25)
    for horizon in (1, 5, 40):
        assert 0.75 < nclt.excess(odometry, true, found, horizon) < 1.3


def test_noise_of_poses_is_not_taken_for_drift():
    sigmas = np.array([0.08, 0.06, 0.05, 0.004, 0.004, 0.004])
    true, odometry = walk(np.random.default_rng(1), 2_000, sigmas, 0.01)
    assert np.all(nclt.drift_sigmas(odometry, true, 1)[3:] > 3 * sigmas[3:])
    assert np.all(nclt.drift_sigmas(odometry, true)[3:] < 2 * sigmas[3:])


def spoiled(folder, kind, line, text):
    path = folder / f"{NAME}_{kind}_trajectory.txt"
    lines = path.read_text().split("\n")
    lines[line - 1] = text
    path.write_text("\n".join(lines))


@pytest.mark.parametrize(
    ("kind", "text", "message"),
    [
        ("gt", "1300000001.2 1 2 three 0 0 0 1", "gt_trajectory.txt:5: 'three' given, expected a"),
        ("odom", "1300000001.2 1 2 3 0 0 0", "odom_trajectory.txt:5: 7 columns, expected 8"),
        ("odom", "1300000001.2 1 2 3 0 0 2 1", "odom_trajectory.txt:5: a quaternion of length"),
        ("gt", "1300000001.2 1 2 inf 0 0 0 1", "gt_trajectory.txt:5: infinite"),
    ],
)
def test_a_bad_line_is_named(write, kind, text, message):
    true = drive(times())
    folder = write(true, odometry_of(true))
    spoiled(folder, kind, 5, text)
    with pytest.raises(InputError, match=message):
        nclt.read_session(folder, NAME)


def test_sessions_that_are_none(write, tmp_path):
    with pytest.raises(InputError, match=r"gt_trajectory\.txt: there is no such file"):
        nclt.read_session(tmp_path, NAME)
    true = drive(times())
    odometry = odometry_of(true)
    with pytest.raises(InputError, match="0 poses at the times of"):
        nclt.read_session(write(true, odometry, seconds=true.seconds + 1e5), NAME)
    other = odometry_of(drive(times(), turn=0.4))
    with pytest.raises(InputError, match="moves otherwise than"):
        nclt.read_session(write(true, other), NAME)
    short = drive(times(60))
    with pytest.raises(InputError, match="15 keyframes of 2 m, expected at least 22"):
        nclt.read_session(write(short, odometry_of(short)), NAME)


def test_real_sessions(shared_data):
    session = nclt.read_session(shared_data / "nclt", "2012-08-04")
    assert session.about["orientation of the truth"] == "roll pitch yaw"
    assert session.about["steps that jump"] == 7
    assert len(lie.parameters(session.truth)) == len(session.covariance) + 1 == 2_515
    drift = np.median(np.abs(nclt.step_errors(session.odometry, session.truth, 50)), axis=0)
    assert 0.5 < np.linalg.norm(drift[:3]) < 3.0  # m in 100 m
    assert np.rad2deg(np.linalg.norm(drift[3:])) < 3.0
    assert np.all(np.abs(session.sigmas[:3] - 0.08) < 0.02)
    assert np.all(np.abs(session.sigmas[3:] - 0.006) < 0.003)
    # What is right for the drift of 40 m is too little for a step, too much for 200 m.
    poses = session.odometry, session.truth
    assert nclt.excess(*poses, session.sigmas, 1) > 2.0
    assert nclt.excess(*poses, session.sigmas, 100) < 0.5
