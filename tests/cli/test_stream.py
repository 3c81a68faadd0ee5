"""`pcm-jax stream`: a line whenever the answer changes, and at the end that of the batch."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import time

import numpy as np
import pytest

from pcm_jax.cli._drives import OneRobot, Team, in_order, loops_in_order
from pcm_jax.errors import InputError
from pcm_jax.files import read_graph, write_g2o
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.online import IncrementalPcm, IncrementalWithin
from pcm_jax.pipeline import select, select_within
from pcm_jax.simulation import simulate_city


def lines_of(ran):
    assert (ran.status, ran.err) == (0, "")
    return [json.loads(line) for line in ran.out.splitlines()]


def test_ends_with_the_batch_answer(run, city, tmp_path):
    ran = run("stream", city / "graph.g2o", "--json", "--save", tmp_path / "state.npz")
    *changes, end = lines_of(ran)
    graph = read_graph(city / "graph.g2o")
    batch = select(graph)
    believed = set()
    for line in changes:
        assert line["event"] == "changed"
        believed |= {one["source"] for one in line["entered"]}
        believed -= {one["source"] for one in line["left"]}
        assert len(believed) == line["accepted"]
    assert believed == set(graph.closures.source[batch.accepted])
    assert (end["event"], end["closures"]) == ("end", len(graph.closures))
    assert end["robot_pairs"][0]["why"] == batch.pairs[0].verdict.why
    state = IncrementalPcm.load(tmp_path / "state.npz")
    np.testing.assert_array_equal(state.result().accepted, batch.accepted)


def test_says_it_in_words(run, city):
    every = run("stream", city / "graph.g2o", "--minimum-inliers", "2").out.splitlines()
    last = run("stream", city / "graph.g2o", "--minimum-inliers", "2", "--every", "99")
    assert every[0].startswith("3 closures, 2 believed (+2 −0): a-b 2 of 3") or len(every) > 3
    changed, end, why = last.out.splitlines()
    assert changed.startswith("20 closures, 6 believed (+6 −0): a-b 6 of 20")
    assert end == "end: 20 closures, 6 believed: a-b 6 of 20"
    assert why == "  a-b: 6 of 20 closures found that agree, 2 asked for"


def test_closures_come_with_the_later_of_their_poses(city):
    graph = read_graph(city / "graph.g2o")
    closures = graph.closures
    assert in_order(graph, "auto") is closures
    with pytest.raises(InputError, match=r"pose a.* of closure 0 has no time"):
        in_order(graph, "stamps")
    stamped = [
        dataclasses.replace(one, stamps=np.arange(one.num_poses) * step)
        for one, step in zip(graph.maps, (1.0, 3.0), strict=True)
    ]
    found = in_order(dataclasses.replace(graph, maps=tuple(stamped)), "auto")
    times = np.maximum(np.asarray(found.pose_a), 3.0 * np.asarray(found.pose_b))
    assert (np.diff(times) >= 0.0).all() and len(found) == len(closures)
    lines = in_order(dataclasses.replace(graph, maps=tuple(stamped)), "lines")
    assert lines is closures


@pytest.mark.slow
def test_follows_a_file_that_grows(city, tmp_path):
    graph = read_graph(city / "graph.g2o")
    path = tmp_path / "growing.g2o"
    write_g2o(path, dataclasses.replace(graph, closures=graph.closures[:8]))
    rest = (city / "graph.g2o").read_text()
    options = ["--json", "--follow", "--patience", "8"]
    command = [sys.executable, "-m", "pcm_jax", "stream", str(path), *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        time.sleep(4.0)
        path.write_text(rest)
        out, _ = process.communicate(timeout=100)
    *_, end = map(json.loads, out.splitlines())
    assert process.returncode == 0
    assert end["closures"] == len(graph.closures)
    assert end["accepted"] == int(select(graph).accepted.sum())


@pytest.mark.slow
@pytest.mark.parametrize("as_json", [True, False])
def test_a_robot_that_comes_makes_a_team(city, tmp_path, as_json):
    graph = read_graph(city / "graph.g2o")
    path = tmp_path / "growing.g2o"
    write_g2o(path, dataclasses.replace(graph, maps=graph.maps[:1], closures=graph.closures[:0]))
    options = ["--follow", "--patience", "8", *["--json"] * as_json]
    command = [sys.executable, "-m", "pcm_jax", "stream", str(path), *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        time.sleep(4.0)
        path.write_text((city / "graph.g2o").read_text())
        out, _ = process.communicate(timeout=100)
    assert process.returncode == 0
    if not as_json:
        assert "robots a, b: closures between them from here on" in out.splitlines()
        return
    lines = [json.loads(line) for line in out.splitlines()]
    assert [one for one in lines if one["event"] == "robots"] == [
        {"event": "robots", "robots": ["a", "b"]}
    ]
    assert lines[-1]["closures"] == len(graph.closures)
    assert lines[-1]["accepted"] == int(select(graph).accepted.sum())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--every", "0"], "--every: 0 given, expected at least 1"),
        (["--patience", "3"], "--patience: given without --follow"),
        (["--follow", "--patience", "-1"], "--patience: -1.0 given"),
        (["--minimum-inliers", "few"], "'few', expected chance or a number"),
        (["--order", "stamps"], "--order: stamps given, but pose a"),
        (["--confidence", "1.5"], "confidence: 1.5; expected"),
        (["--save", "/nowhere/state.npz"], "/nowhere"),
    ],
)
def test_bad_options(run, city, options, words):
    ran = run("stream", city / "graph.g2o", *options)
    assert ran.status == 2
    assert ran.err.startswith("error: ") and ran.err.count("\n") == 1
    assert words in ran.err


@pytest.fixture(scope="module")
def one_robot():
    return simulate_city(seed=3, poses=120).graph.maps[0]


@pytest.fixture(scope="module")
def one_robots_file(one_robot, tmp_path_factory):
    path = tmp_path_factory.mktemp("one") / "robot.g2o"
    write_g2o(path, MultiRobotGraph((one_robot,)))
    return path


def test_one_robot_ends_with_the_answer_within_its_map(run, one_robots_file, tmp_path):
    state = tmp_path / "state.npz"
    options = ["--json", "--minimum-inliers", "3", "--save", state]
    *changes, end = lines_of(run("stream", one_robots_file, *options))
    given = read_graph(one_robots_file).maps[0]
    batch = select_within(given, minimum_inliers=3)
    believed = set()
    for line in changes:
        assert line["event"] == "changed"
        believed |= {one["source"] for one in line["entered"]}
        believed -= {one["source"] for one in line["left"]}
        assert len(believed) == line["accepted"]
    accepted = batch.closures[batch.accepted]
    assert believed == set(given.source[accepted]) and len(changes) > 3
    assert (end["event"], end["closures"]) == ("end", len(batch.closures))
    assert (end["why"], end["odometry_scale"]) == (batch.verdict.why, 1.0)
    first = changes[0]["entered"][0]
    row = batch.closures[first["index"]]
    assert (first["a"], first["b"]) == (
        given.pose_name(int(given.tail[row])),
        given.pose_name(int(given.head[row])),
    )
    loaded = IncrementalWithin.load(state)
    np.testing.assert_array_equal(loaded.result().accepted, batch.accepted)


def test_one_robot_in_words(run, one_robots_file):
    changed, end, why = run("stream", one_robots_file, "--every", "99").out.splitlines()
    count = len(select_within(read_graph(one_robots_file).maps[0]).closures)
    assert changed.startswith(f"{count} closures, ") and changed.endswith(" −0)")
    assert end.startswith(f"end: {count} closures, ") and "agree with each other and odo" in why


def test_one_robots_closures_come_with_the_later_of_their_poses(one_robot):
    lines = loops_in_order(one_robot, "auto")
    np.testing.assert_array_equal(lines, loops_in_order(one_robot, "lines"))
    with pytest.raises(InputError, match=r"pose a\d+ of edge \d+ has no time"):
        loops_in_order(one_robot, "stamps")
    later = dataclasses.replace(one_robot, stamps=-1.0 * np.arange(one_robot.num_poses))
    found = loops_in_order(later, "stamps")
    assert sorted(found) == sorted(lines)
    assert (np.diff(np.minimum(one_robot.tail, one_robot.head)[found]) <= 0).all()


def test_one_robot_without_a_loop_is_told(run, one_robot, tmp_path):
    path = tmp_path / "chain.g2o"
    step = np.abs(one_robot.tail - one_robot.head) == 1
    write_g2o(path, MultiRobotGraph((one_robot.with_edges(step),)))
    ran = run("stream", path)
    assert ran.status == 2 and "one robot, expected at least two" in ran.err


def test_one_robots_file_that_grows(one_robot):
    graph = MultiRobotGraph((one_robot,))
    size = 80
    early = np.maximum(one_robot.tail, one_robot.head) < size
    begun = dataclasses.replace(
        one_robot.with_edges(early),
        poses=type(one_robot.poses)(np.asarray(one_robot.poses.unit_complex_xy)[:size]),
        ids=one_robot.ids[:size],
    )
    drive = OneRobot(MultiRobotGraph((begun,)), {})
    for arrives in drive.arrivals(MultiRobotGraph((begun,)), "lines"):
        arrives()
    before = len(drive.online)
    assert drive.go_on(graph) is drive
    for arrives in drive.arrivals(graph, "lines"):
        arrives()
    batch = select_within(one_robot)
    assert (drive.online.repeated, len(drive.online)) == (before, len(batch.closures))
    assert drive.online.result().accepted.sum() == batch.accepted.sum()
    other = dataclasses.replace(one_robot, name="b")
    team = drive.go_on(MultiRobotGraph((one_robot, other)))
    assert isinstance(team, Team) and len(team.online) == 0
