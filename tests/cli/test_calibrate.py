"""`pcm-jax calibrate`: factors printed, written, drawn; odometry without covariances."""

import json

import numpy as np
import pytest

from pcm_jax.cli.calibrate import without_covariances
from pcm_jax.files import read_graph, write_g2o
from pcm_jax.integrity.calibration import closing_edges, scaled_graph


def test_factors_and_advice_are_printed(run, city, tmp_path):
    output, picture = tmp_path / "calibrated.g2o", tmp_path / "qq.png"
    ran = run("calibrate", city / "graph.g2o", "--output", output, "--plot", picture)
    assert ran.status == 0, ran.err
    lines = ran.out.splitlines()
    assert lines[0].split() == [
        "edges",
        "errors",
        "in",
        "information",
        "times",
        "90",
        "%",
        "interval",
    ]
    assert [line.split()[:2] for line in lines[1:5]] == [
        ["odometry", "translation"],
        ["odometry", "rotation"],
        ["closures", "translation"],
        ["closures", "rotation"],
    ]
    assert "odometry: translation errors are" in ran.out
    assert f"wrote {output}" in ran.out
    assert picture.read_bytes()[1:4] == b"PNG"
    factor = float(lines[1].split()[2])
    given, written = read_graph(city / "graph.g2o").maps[0], read_graph(output).maps[0]
    odometry = ~closing_edges(given)
    after, before = (np.asarray(one.information)[odometry, 0, 0] for one in (written, given))
    assert after / before == pytest.approx(factor, rel=1e-3)


def test_json(run, city):
    ran = run("calibrate", city / "graph.g2o", "--json")
    told = json.loads(ran.out)
    assert list(told) == [
        *("odometry", "closures", "map_consistency", "closures_used", "advice", "growth"),
        "quantiles",
    ]
    low, high = told["closures"]["rotation"]["interval"]
    assert low < told["closures"]["rotation"]["factor"] < high


def test_files_without_covariances(city):
    graph = read_graph(city / "graph.g2o")
    found = without_covariances(graph, (2.0, 0.01), (0.1, 0.02))
    one = found.maps[0]
    closing = closing_edges(one)
    information = np.asarray(one.information)
    step = np.linalg.norm(one.measurement.translation(), axis=1)[~closing]
    np.testing.assert_allclose(information[~closing, 0, 0] ** -0.5, 0.02 * (100 * step) ** 0.5)
    expected = np.radians(0.01) * (100 * step) ** 0.5
    np.testing.assert_allclose(information[~closing, 2, 2] ** -0.5, expected)
    for each in (information[closing], np.asarray(found.closures.information)):
        np.testing.assert_allclose(
            each, np.tile(np.diag([100.0, 100.0, 2500.0]), (len(each), 1, 1))
        )
    assert without_covariances(graph, None, None).maps[0].information is not None


def test_bad_numbers(run, city):
    for options in (["--drift", 0, 1], ["--closure-sigmas", "nan", 1]):
        ran = run("calibrate", city / "graph.g2o", *options)
        assert ran.status == 2
        assert "expected a number above 0" in ran.err


def test_nothing_to_calibrate_by(run, tmp_path):
    information = "100 0 0 100 0 100"
    lines = [f"EDGE_SE2 {k} {k + 1} 1 0 0 {information}" for k in range(3)]
    (tmp_path / "chain.g2o").write_text("\n".join([*lines, ""]))
    ran = run("calibrate", tmp_path / "chain.g2o")
    assert (ran.status, ran.err.count("\n")) == (2, 1)
    assert "no map has a loop" in ran.err


@pytest.mark.slow
def test_a_calibrated_merge_keeps_what_one_as_stated_cannot(run, city, tmp_path):
    """Deviations stated ten times too small: right closures contradict each other."""
    graph, sure = read_graph(city / "graph.g2o"), tmp_path / "sure.g2o"
    write_g2o(sure, scaled_graph(graph, np.full(4, 100.0)))
    output, kept = tmp_path / "merged.g2o", {}
    hints = {}
    for options in ((), ("--calibrate", "--output", output)):
        ran = run("merge", sure, "--json", *options)
        assert ran.status == 0, ran.err
        told = json.loads(ran.out)
        kept[options] = sum(row["accepted"] for row in told["closures"])
        hints[options] = told["hints"]
    stated, calibrated = kept.values()
    assert stated < 3
    assert any("--calibrate" in hint for hint in hints[()])
    assert hints["--calibrate", "--output", output] == []
    assert calibrated >= 5
    assert 0.3 < told["solution"]["normalized_chi2"] < 3.0
    given, written = (
        np.asarray(read_graph(f).maps[0].information)[0, 0, 0] for f in (sure, output)
    )
    found = told["calibration"]["odometry"]["translation"]
    assert written / given == pytest.approx(found["factor"], rel=1e-6)
    assert found["interval"][0] < 0.01 < found["interval"][1]


@pytest.mark.slow
def test_a_merge_tells_its_calibration(run, city, tmp_path):
    report = tmp_path / "report.json"
    ran = run("merge", city / "graph.g2o", "--calibrate", "--report", report)
    assert ran.status == 0, ran.err
    written = json.loads(report.read_text())["calibration"]
    assert written["odometry"]["translation"]["factor"] > 0
    assert written["advice"] in ran.out
