"""`pcm-jax simulate` and `pcm-jax merge`: what they write and print."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

import pcm_jax
from pcm_jax import lie
from pcm_jax.cli._outputs import json_text
from pcm_jax.evaluation import ate_rmse
from pcm_jax.files import read_graph, read_tum
from pcm_jax.simulation import simulate_city

WORLD = {"poses": 60, "inliers": 6, "aliased_groups": 1, "aliased_size": 3, "random": 11}


@pytest.fixture(scope="module")
def merged(city, tmp_path_factory):
    """The folder with all results of merging the city, made once."""
    from pcm_jax.cli import main

    folder = tmp_path_factory.mktemp("merged")
    options = [f"--{name}={folder / file}" for name, file in RESULTS.items()]
    assert main(["merge", str(city / "graph.g2o"), "--seed", "3", *options]) == 0
    return folder


RESULTS = {
    "output": "merged.g2o",
    "report": "report.json",
    "html": "report.html",
    "plot": "merged.png",
}


@pytest.fixture
def report(merged):
    return json.loads((merged / "report.json").read_text())


def test_the_page_tells_every_closure(merged, report):
    text = (merged / "report.html").read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>")
    assert text.count('<tr id="closure-') == len(report["closures"])


def test_the_report_has_the_contracts_fields(report):
    assert list(report) == [
        *("version", "method", "confidence", "gate", "robots", "closures", "robot_pairs"),
        *("anchors", "solution", "groups", "team", "warnings", "seconds", "input", "hints"),
    ]
    assert report["version"] == pcm_jax.__version__
    assert (report["method"], report["confidence"]) == ("pcm-exact", 0.99)
    assert report["gate"] == pytest.approx(11.344866730144373)  # SciPy's chi2.ppf(0.99, 3)
    assert [list(robot) for robot in report["robots"]] == [["name", "poses", "edges"]] * 2
    assert [robot["poses"] for robot in report["robots"]] == [60, 60]
    fields = [
        *("index", "a", "b", "source", "accepted", "why", "standing", "agrees_with", "of", "among"),
        *("agreeing", "worst_conflict", "enters_at", "fit"),
    ]
    assert all(list(closure) == fields for closure in report["closures"])
    (pair,) = report["robot_pairs"]
    assert list(pair) == [
        *("a", "b", "measured", "accepted", "optimal", "upper_bound"),
        *("found", "places", "chance", "rival", "ambiguous", "joint", "why"),
    ]
    assert list(report["anchors"][1]) == ["x", "y", "theta"]
    assert list(report["solution"]) == ["cost", "normalized_chi2", "iterations", "converged"]
    assert report["groups"] == [["a", "b"]]
    stages = ["read", "optimize", "marginals", "consistency", "clique", "chance", "merge"]
    assert list(report["seconds"]) == [*stages, "compile"]
    assert all(seconds >= 0 for seconds in report["seconds"].values())


def test_the_report_names_the_true_closures(report, labels, city):
    accepted = [closure["index"] for closure in report["closures"] if closure["accepted"]]
    assert accepted == labels["true_closures"]
    (pair,) = report["robot_pairs"]
    expected = {"a": "a", "b": "b", "measured": 20, "accepted": 6, "found": 6, "upper_bound": 6}
    assert pair.items() >= (expected | {"optimal": True, "ambiguous": False}).items()
    assert pair["why"].startswith("6 of 20 closures agree, at ")
    lines = (city / "graph.g2o").read_text().splitlines()
    for closure in report["closures"]:
        file, number = closure["source"].rsplit(":", 1)
        assert file == str(city / "graph.g2o")
        keys = [int(key) for key in lines[int(number) - 1].split()[1:3]]
        names = [f"{chr(key >> 56)}{key & (2**56 - 1)}" for key in keys]
        assert names == [closure["a"], closure["b"]]


def test_the_merged_map_is_the_true_one(merged, report, city):
    graph, given = read_graph(merged / "merged.g2o"), read_graph(city / "graph.g2o")
    assert ate_rmse(graph.maps, simulate_city(**WORLD).truth, align="umeyama") < 0.1
    anchor = report["anchors"][1]
    c, s = np.cos(anchor["theta"]), np.sin(anchor["theta"])
    frame = np.array([[c, -s, anchor["x"]], [s, c, anchor["y"]], [0, 0, 1]])
    placed, own = (
        np.asarray(lie.as_matrix(lie.as_numpy(each.maps[1].poses)))[0] for each in (graph, given)
    )
    np.testing.assert_allclose(placed, frame @ own, atol=1e-9)


def test_the_true_trajectories_are_written(city):
    for name, truth in zip("ab", simulate_city(**WORLD).truth, strict=True):
        _, poses = read_tum(city / f"truth_{name}.txt")
        x, y, z = np.asarray(poses.wxyz_xyz)[:, 4:].T
        np.testing.assert_allclose(np.stack([x, y], axis=1), lie.parameters(truth)[:, 2:])
        assert not z.any()


def test_the_picture_is_one(merged):
    assert (merged / "merged.png").read_bytes().startswith(b"\x89PNG")


def test_plain_files_and_candidates_give_the_same(run, report, plain_city, tmp_path):
    """One file with closures inside, and two files with a CSV file, are the same world."""
    maps = plain_city / "a.g2o", plain_city / "b.g2o"
    candidates = plain_city / "candidates.csv"
    ran = run("merge", *maps, "--closures", candidates, "--report", tmp_path / "plain.json")
    assert (ran.status, ran.err) == (0, "")
    other = json.loads((tmp_path / "plain.json").read_text())
    assert other["solution"]["cost"] == pytest.approx(report["solution"]["cost"], rel=1e-9)
    for one, two in zip(report["closures"], other["closures"], strict=True):
        assert {**one, "source": ""} == {**two, "source": ""}
    assert other["closures"][4]["source"] == f"{candidates}:6"


def test_the_summary(run, city):
    ran = run("merge", city / "graph.g2o")
    assert (ran.status, ran.err) == (0, "")
    lines = ran.out.splitlines()
    assert lines[0].split()[:4] == ["robot", "poses", "edges", "group"]
    assert lines[1].split()[:2] == ["a", "60"]
    assert lines[5].split()[:10] == [
        "a",
        "-",
        "b",
        "20",
        "6",
        "proven",
        "6",
        "of",
        "20",
        "closures",
    ]
    assert lines[7].startswith("cost ") and "converged after" in lines[7]


def test_robots_apart(run, city, tmp_path):
    """No closure is enough: two groups, no anchors, and still exit status 0."""
    report = tmp_path / "apart.json"
    ran = run("merge", city / "graph.g2o", "--minimum-inliers", 7, "--report", report)
    assert ran.status == 0
    assert ran.out.count("no accepted closure leads to this robot") == 2
    apart = json.loads(report.read_text())
    assert (apart["groups"], apart["anchors"]) == ([["a"], ["b"]], [None, None])


def test_split(run, plain_city, tmp_path):
    """Cutting by the option is cutting by the function."""
    file, report = plain_city / "a.g2o", tmp_path / "split.json"
    assert run("merge", file, "--split", 30, "--report", report).status == 0
    halves = pcm_jax.split(read_graph(file).maps[0], [30])
    written = json.loads(report.read_text())
    assert [robot["poses"] for robot in written["robots"]] == [30, 30]
    assert [c["source"] for c in written["closures"]] == halves.closures.source.tolist()


@pytest.fixture(scope="module")
def city_with_a_false_loop(city, tmp_path_factory):
    """A pose of robot a said to be where another is, ten poses before."""
    lines = (city / "graph.g2o").read_text().splitlines()
    a = ord("a") << 56
    false = f"EDGE_SE2 {a + 40} {a + 10} 0.3 -2 1 2500 0 0 2500 0 10000"
    file = tmp_path_factory.mktemp("false") / "graph.g2o"
    file.write_text("\n".join([*lines, false, ""]))
    return file, len(lines) + 1


def test_cleaning_the_maps_first(run, report, city_with_a_false_loop, tmp_path):
    file, line = city_with_a_false_loop
    ran = run("merge", file, "--clean-maps", "--report", tmp_path / "clean.json")
    assert ran.status == 0
    clean = json.loads((tmp_path / "clean.json").read_text())
    a, b = clean["cleaned"]
    assert list(a) == [
        *("robot", "measured", "accepted", "optimal", "upper_bound"),
        *("odometry_scale", "found", "places", "chance", "why", "rejected"),
    ]
    assert (a["odometry_scale"], a["found"]) == (1.0, a["accepted"])
    assert a["chance"] < 0.01
    assert (a["robot"], b["robot"], a["optimal"], b["optimal"]) == ("a", "b", True, True)
    assert {"a": "a40", "b": "a10", "source": f"{file}:{line}"} in a["rejected"]
    assert a["measured"] == 1 + report["robots"][0]["edges"] - 59
    assert a["accepted"] == a["upper_bound"] == a["measured"] - len(a["rejected"])
    assert [r["edges"] for r in clean["robots"]] == [59 + r["accepted"] for r in (a, b)]
    accepted = [[c["accepted"] for c in each["closures"]] for each in (clean, report)]
    assert accepted[0] == accepted[1]
    assert clean["solution"]["normalized_chi2"] < 1.5
    assert clean["seconds"]["clean"] > 0
    lines = [text.split() for text in ran.out.splitlines()]
    assert lines[0] == ["inside", "robot", "measured", "accepted", "largest", "set"]
    assert lines[1] == ["a", str(a["measured"]), str(a["accepted"]), "proven"]


def test_maps_are_not_cleaned_unasked(run, city_with_a_false_loop, tmp_path):
    file, _ = city_with_a_false_loop
    ran = run("merge", file, "--report", tmp_path / "dirty.json")
    assert ran.status == 0
    assert "inside robot" not in ran.out
    dirty = json.loads((tmp_path / "dirty.json").read_text())
    assert "cleaned" not in dirty
    assert dirty["solution"]["normalized_chi2"] > 2


def test_maps_without_loops_have_nothing_to_clean(run, tmp_path):
    (tmp_path / "chains.g2o").write_text(CHAINS)
    report = tmp_path / "report.json"
    options = ["--minimum-inliers", 1, "--clean-maps", "--report", report]
    assert run("merge", tmp_path / "chains.g2o", *options).status == 0
    for row in json.loads(report.read_text())["cleaned"]:
        assert (row["measured"], row["accepted"], row["rejected"]) == (0, 0, [])


def test_a_broken_chain_cannot_be_cleaned(run, city_with_a_false_loop, tmp_path):
    file, _ = city_with_a_false_loop
    a = ord("a") << 56
    kept = [
        text
        for text in file.read_text().splitlines()
        if text.split()[1:3] != [str(a + 25), str(a + 26)]
    ]
    (tmp_path / "broken.g2o").write_text("\n".join([*kept, ""]))
    ran = run("merge", tmp_path / "broken.g2o", "--clean-maps")
    assert ran.status == 2
    (line,) = ran.err.splitlines()
    assert line.startswith("error: map 'a': no edge joins poses a25 and a26, expected odometry")


def test_no_degree_of_freedom(run, tmp_path):
    """Two chains and one closure determine every pose once; null stands for no chi-squared."""
    (tmp_path / "chains.g2o").write_text(CHAINS)
    report = tmp_path / "report.json"
    ran = run("merge", tmp_path / "chains.g2o", "--minimum-inliers", 1, "--report", report)
    assert ran.status == 0, ran.err
    assert json.loads(report.read_text())["solution"]["normalized_chi2"] is None
    assert "no degree of freedom left" in ran.out


def _chains() -> str:
    a, b = ord("a") << 56, ord("b") << 56
    information = "100 0 0 100 0 100"
    lines = [f"VERTEX_SE2 {robot + k} {k} 0 0" for robot in (a, b) for k in range(3)]
    for robot in (a, b):
        lines += [f"EDGE_SE2 {robot + k} {robot + k + 1} 1 0 0 {information}" for k in range(2)]
    return "\n".join([*lines, f"EDGE_SE2 {a} {b} 0 2 0 {information}", ""])


CHAINS = _chains()


def test_corrections_are_warned_of_in_a_line(run, city, tmp_path):
    text = (city / "graph.g2o").read_text()
    marked = tmp_path / "marked.g2o"
    marked.write_text(text + "VERTEX_XY 7 0 0\n")
    ran = run("merge", marked)
    assert ran.status == 0
    (line,) = ran.err.splitlines()
    assert line.startswith(f"warning: {marked}") and "VERTEX_XY" in line


def test_json_has_no_numbers_that_json_lacks():
    value = {"cost": float("nan"), "rows": [1.5, float("inf"), {"x": -float("inf")}], "n": 3}
    text = json_text(value)
    assert json.loads(text) == {"cost": None, "rows": [1.5, None, {"x": None}], "n": 3}


@pytest.mark.slow
def test_a_process_without_64_bit_types_gives_the_same_numbers(report, city, tmp_path):
    """`python -m pcm_jax`, in an environment that turns 64-bit types off."""
    command = [sys.executable, "-m", "pcm_jax", "merge", str(city / "graph.g2o")]
    command += ["--report", str(tmp_path / "report.json")]
    environment = {**os.environ, "JAX_ENABLE_X64": "0"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    assert all(line.endswith(" ...") for line in done.stderr.splitlines())
    other = json.loads((tmp_path / "report.json").read_text())
    assert other["solution"]["cost"] == pytest.approx(report["solution"]["cost"], rel=1e-12)
    for name, value in report["anchors"][1].items():
        assert other["anchors"][1][name] == pytest.approx(value, rel=1e-10)


def test_the_demo_on_a_small_world(tmp_path):
    from pcm_jax.cli import demo

    world = simulate_city(**WORLD)
    outcomes = demo.merged_both_ways(world)
    rows = [line.split() for line in demo.comparison(world, outcomes).splitlines()]
    assert rows[0][:4] == ["method", "accepted", "true", "false"]
    assert rows[1][:4] == ["PCM", "6", "6", "0"]
    assert rows[2][:5] == ["everything", "accepted", "20", "6", "14"]
    assert float(rows[1][4]) < 0.2 < 1.0 < float(rows[2][5])
    pcm = outcomes[demo.PCM].result
    assert float(ate_rmse(pcm.graph.maps, world.truth, align="umeyama")) < 0.2
    demo.draw(world, outcomes, tmp_path / "demo.png")
    assert (tmp_path / "demo.png").read_bytes().startswith(b"\x89PNG")
    assert "20 candidate closures" in demo.description(world)
