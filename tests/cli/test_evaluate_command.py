"""`pcm-jax evaluate`: trajectories in files against true ones, with known answers."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

HEAD = ["rmse", "mean", "median", "max"]


def places_of(seed, count=20):
    return np.cumsum(np.random.default_rng(seed).normal(size=(count, 3)), axis=0)


def write_tum(path, places, turns=None, start=0.0):
    turns = Rotation.identity(len(places)) if turns is None else turns
    rows = np.column_stack([start + 0.5 * np.arange(len(places)), places, turns.as_quat()])
    path.write_text("\n".join(" ".join(map(repr, row)) for row in rows.tolist()))
    return path


def write_kitti(path, places, turns):
    matrices = np.concatenate([turns.as_matrix(), places[:, :, None]], axis=2)
    path.write_text(
        "\n".join(" ".join(map(repr, row)) for row in matrices.reshape(-1, 12).tolist())
    )
    return path


def tables(out):
    """The rows of both tables: robot, count, four lengths and four angles."""
    lines = out.splitlines()
    starts = [k for k, line in enumerate(lines) if line.startswith("robot  ")]
    assert [lines[k].split()[2::2] for k in starts] == [[*HEAD, *HEAD]] * 2
    found = []
    for start in starts:
        rows = (line.split() for line in lines[start + 1 :])
        table = {}
        for row in rows:
            if not row:
                break
            table[row[0]] = [int(row[1]), *map(float, row[2:])]
        found.append(table)
    return found


@pytest.fixture
def two(tmp_path):
    """Two robots in space: as estimated, in another frame, and as they were."""
    frame = Rotation.from_rotvec([0.3, -0.2, 1.0])
    files = []
    for seed, name in enumerate("ab"):
        places, turns = places_of(seed), Rotation.random(20, rng=np.random.default_rng(seed))
        (tmp_path / "truth").mkdir(exist_ok=True)
        truth = write_tum(tmp_path / "truth" / f"{name}.txt", places, turns)
        moved = frame.apply(places) + np.array([5.0, -3.0, 2.0])
        estimate = write_tum(tmp_path / f"{name}.tum", moved, frame * turns)
        files.append((estimate, truth))
    return [[one[k] for one in files] for k in (0, 1)]


def test_a_rigid_shift_is_no_error(run, two):
    estimate, truth = two
    ran = run("evaluate", *estimate, "--truth", *truth)
    assert (ran.status, ran.err) == (0, "")
    assert ran.out.splitlines()[:3] == [
        "robots matched by name",
        "  a with a: 20 of 20 poses, by time stamp",
        "  b with b: 20 of 20 poses, by time stamp",
    ]
    assert "(ATE), after one rigid motion of all robots, without scale\n" in ran.out
    assert "(RPE), steps of 1 frame\n" in ran.out
    absolute, relative = tables(ran.out)
    assert [absolute[name][0] for name in ("a", "b", "all")] == [20, 20, 40]
    assert [relative[name][0] for name in ("a", "b", "all")] == [19, 19, 38]
    for table in (absolute, relative):
        np.testing.assert_allclose([row[1:] for row in table.values()], 0.0, atol=1e-6)


def test_one_robot_off_by_a_metre(run, tmp_path):
    """Without alignment it is off by 1 m everywhere, with one of each robot nowhere."""
    for name, shift in (("a", 0.0), ("b", 1.0)):
        places = places_of(ord(name))
        write_tum(tmp_path / f"truth_{name}.txt", places)
        write_tum(tmp_path / f"{name}.txt", places + np.array([0.0, shift, 0.0]))
    sides = [tmp_path / "a.txt", tmp_path / "b.txt", "--truth"]
    sides += [tmp_path / "truth_a.txt", tmp_path / "truth_b.txt"]
    ran = run("evaluate", *sides, "--align", "none")
    assert "robots matched by order\n  a with truth_a: 20 of 20 poses" in ran.out
    assert "(ATE), in the frames given\n" in ran.out
    absolute, relative = tables(ran.out)
    assert absolute["a"] == [20, *[0.0] * 8]
    assert absolute["b"] == [20, *[1.0] * 4, *[0.0] * 4]
    assert absolute["all"] == [40, 0.7071, 0.5, 0.5, 1.0, *[0.0] * 4]
    np.testing.assert_allclose(relative["all"][1:], 0.0, atol=1e-12)
    joint, _ = tables(run("evaluate", *sides).out)
    assert 0.05 < joint["b"][1] < 0.7 and 0.05 < joint["a"][1] < 0.7
    each, _ = tables(run("evaluate", *sides, "--align", "each").out)
    np.testing.assert_allclose(each["all"][1:], 0.0, atol=1e-9)


def test_json_and_steps(run, two):
    estimate, truth = two
    ran = run("evaluate", *estimate, "--truth", *truth, "--json", "--delta", 6)
    told = json.loads(ran.out)
    assert (told["align"], told["delta"], told["robots_matched_by"]) == ("joint", 6, "name")
    assert [one["relative"]["count"] for one in told["robots"]] == [3, 3]
    assert told["all"]["absolute"]["translation"]["max"] < 1e-9
    ran = run("evaluate", *estimate, "--truth", *truth, "--json", "--delta-metres", 1e3)
    assert (ran.status, ran.out) == (2, "")
    assert ran.err.startswith("error: delta_metres: 1000 given, expected a step")


def test_stamps_may_differ_a_little(run, tmp_path):
    places = places_of(1)
    truth = write_tum(tmp_path / "truth.txt", places)
    late = write_tum(tmp_path / "late.txt", places[2:], start=1.02)
    ran = run("evaluate", late, "--truth", truth)
    assert ran.status == 2
    assert "stamps 1.02 to 9.52 against 0.0 to 9.5; expected stamps within 0.01 s" in ran.err
    ran = run("evaluate", late, "--truth", truth, "--max-difference", 0.03, "--align", "none")
    absolute, _ = tables(ran.out)
    assert absolute["all"] == [18, *[0.0] * 8]


def test_kitti_has_no_times(run, tmp_path):
    places, turns = places_of(2), Rotation.random(20, rng=np.random.default_rng(5))
    truth = write_kitti(tmp_path / "07.txt", places, turns)
    estimate = write_tum(tmp_path / "estimate.txt", places, turns)
    ran = run("evaluate", estimate, "--truth", truth)
    assert "  estimate with 07: 20 of 20 poses, by id\n" in ran.out
    np.testing.assert_allclose(tables(ran.out)[0]["all"][1:], 0.0, atol=1e-5)


def test_g2o_with_poses_alone(run, tmp_path):
    """True poses often come without edges; of two robots in one file too."""
    a, b = (ord(letter) << 56 for letter in "ab")
    rows = [f"VERTEX_SE2 {k} {x} {y} 0.5" for k, x, y in ((a, 0, 0), (a + 1, 1, 0), (a + 2, 1, 2))]
    rows += [f"VERTEX_SE2 {k} {x} {y} 0" for k, x, y in ((b, 0, 4), (b + 1, 1, 4))]
    (tmp_path / "truth.g2o").write_text("\n".join(rows))
    shifted = [row if row.split()[1] < str(b) else f"{row[:-4]} 5 0" for row in rows]
    (tmp_path / "estimate.g2o").write_text("\n".join(shifted))
    ran = run(
        "evaluate", tmp_path / "estimate.g2o", "--truth", tmp_path / "truth.g2o", "--align=none"
    )
    assert (ran.status, ran.err) == (0, "")
    absolute, relative = tables(ran.out)
    assert absolute["a"] == [3, *[0.0] * 8]
    assert absolute["b"] == [2, *[1.0] * 4, *[0.0] * 4]
    assert relative["all"] == [3, *[0.0] * 8]


def test_a_merged_map_against_the_simulated_truth(run, city, tmp_path):
    """Planar maps of both robots in one file, and true poses in space, as trajectories."""
    merged = tmp_path / "merged.g2o"
    ran = run("merge", city / "graph.g2o", "--minimum-inliers", 2, "--output", merged)
    assert ran.status == 0
    ran = run("evaluate", merged, "--truth", city / "truth_a.txt", city / "truth_b.txt")
    assert (ran.status, ran.err) == (0, "")
    absolute, relative = tables(ran.out)
    assert [absolute[name][0] for name in ("a", "b", "all")] == [60, 60, 120]
    assert 0.01 < absolute["all"][1] < 1.0
    assert relative["all"][1] < 0.1


def test_what_cannot_be_compared(run, two, city):
    estimate, truth = two
    ran = run("evaluate", *estimate, "--truth", truth[0])
    assert (ran.status, ran.err) == (
        2,
        "error: truth: 1 robot (a) given, expected 2 robots (a, b) like the estimate\n",
    )
    ran = run("evaluate", city / "graph.g2o", "--truth", *truth)
    assert ran.err.startswith("error: truth: SE3 poses that leave the plane given, expected SE2")
    assert "the following arguments are required: --truth" in run("evaluate", estimate[0]).err
    assert "there is no such file" in run("evaluate", "nothing.g2o", "--truth", truth[0]).err
    ran = run("evaluate", truth[0], "--truth", truth[0], "--delta=2", "--delta-metres=3")
    assert "not allowed with argument" in ran.err
