"""`pcm-jax merge --refine`."""

import json

import pytest

from pcm_jax.cli.merge import summary

A, B = ord("a") << 56, ord("b") << 56


@pytest.fixture(scope="module")
def with_a_near_miss(tmp_path_factory):
    """Two lines of 30 poses; nine closures to 0.1 m, of which two lie 0.26 m to either side."""
    lines = []
    for robot in (A, B):
        lines += [f"VERTEX_SE2 {robot + k} {k} 0 0" for k in range(30)]
        lines += [
            f"EDGE_SE2 {robot + k} {robot + k + 1} 1 0 0 1e4 0 0 1e4 0 1e6" for k in range(29)
        ]
    errors = [0.1, -0.1, 0.12, -0.12, 0.06, -0.06, 0.0, 0.26, -0.26]
    lines += [
        f"EDGE_SE2 {A + 3 * k} {B + 3 * k} {error} 0 0 100 0 0 100 0 1e4"
        for k, error in enumerate(errors)
    ]
    file = tmp_path_factory.mktemp("lines") / "lines.g2o"
    file.write_text("\n".join([*lines, ""]))
    return file


def test_recall_is_told(run, with_a_near_miss, tmp_path):
    report = tmp_path / "report.json"
    how = ["merge", with_a_near_miss, "--minimum-inliers=2"]
    alone = run(*how)
    assert "recalled" not in alone.out
    ran = run(*how, "--refine=recall", f"--report={report}")
    assert ran.status == 0
    assert "recalled 1 more that agree with the merged map" in ran.out
    refined = json.loads(report.read_text())["refine"]
    assert (refined["mode"], refined["dropped"], refined["settled"]) == ("recall", [], True)
    assert len(refined["recalled"]) == 1


def test_what_is_dropped_is_told(run, with_a_near_miss, tmp_path):
    """A report whose refinement dropped something, and had not settled."""
    path = tmp_path / "report.json"
    run("merge", with_a_near_miss, "--minimum-inliers=2", "--refine=recall", f"--report={path}")
    report = json.loads(path.read_text())
    report["refine"] |= {"recalled": [], "dropped": [3], "loops_dropped": [{}]}
    report["refine"] |= {"settled": False, "rounds": 20}
    text = summary(report)
    assert "recalled 0 more that agree with the merged map (not settled after 20 rounds)" in text
    assert "dropped 1 closures, and 1 loops inside the maps, that do not" in text


def test_an_unknown_refinement_is_refused(run, with_a_near_miss):
    ran = run("merge", with_a_near_miss, "--refine=best")
    assert ran.status == 2
    assert "argument --refine: invalid choice: 'best'" in ran.err


def test_a_robust_method_is_not_refined(run, with_a_near_miss):
    ran = run("merge", with_a_near_miss, "--method=dcs", "--refine=recall")
    assert (ran.status, ran.err.strip()) == (2, "error: refine: not an option of method 'dcs'")
