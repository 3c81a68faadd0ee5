"""What commands read, how they say so, and what `merge` writes."""

import json
from pathlib import Path

import numpy as np
import pytest

from pcm_jax.files import read_graph

FLAT = "2500 0 0 2500 0 10000"
KEY = {letter: ord(letter) << 56 for letter in "abc"}


def chain(start, count=3):
    ids = range(start, start + count)
    vertices = [f"VERTEX_SE2 {k} {k - start} 0 0" for k in ids]
    return [*vertices, *(f"EDGE_SE2 {k} {k + 1} 1 0 0 {FLAT}" for k in list(ids)[:-1])]


def closure(a, b, x=0, y=2):
    return f"EDGE_SE2 {a} {b} {x} {y} 0 {FLAT}"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def save(name, *lines):
        Path(name).write_text("\n".join(lines) + "\n")
        return name

    return save


@pytest.fixture
def three(folder):
    """Robots a and b meet twice; c only says so once, falsely."""
    lines = [line for letter in "abc" for line in chain(KEY[letter])]
    lines += [closure(KEY["a"] + k, KEY["b"] + k) for k in range(2)]
    return folder("three.g2o", *lines, closure(KEY["a"], KEY["c"], 9))


def test_inspect_says_how_files_were_read(run, folder):
    maps = [folder(f"{name}.g2o", *chain(start)) for name, start in (("p", 0), ("q", 100))]
    between = folder("between.g2o", closure(0, 100), closure(100, 0, 0, -2), closure(2, 102))
    ran = run("inspect", *maps, "--closures", between)
    assert ran.status == 0
    for line in (
        "p.g2o: g2o, 3 poses, 2 measurements",
        "  ids: plain ids, shared by the files: a pose is of the file that holds its odometry"
        " (p, q)",
        "  information: as-written",
        "between.g2o:2 says what between.g2o:1 says the other way round",
    ):
        assert line in ran.out.splitlines()
    assert "it defines no robot" in ran.out


def test_inspect_as_json(run, folder):
    path = folder("p.g2o", "VERTEX_XY 7 0 0", *chain(0), f"EDGE_PRIOR_SE2 0 0 0 0 {FLAT}")
    ran = run("inspect", path, "--json")
    told = json.loads(ran.out)
    (file,) = told["files"]
    assert (file["path"], file["format"], file["priors"]) == (path, "g2o", 1)
    assert file["left_out"] == {"VERTEX_XY": 1}
    assert told["robots"][0]["robot"] == "p" and told["group"] == "SE2"
    assert any("VERTEX_XY" in line for line in told["odd"])


def test_covariances_on_request(run, folder):
    lines = [*chain(KEY["a"]), *chain(KEY["b"]), closure(KEY["a"], KEY["b"])]
    weak = "0.0004 0 0 0.0004 0 0.0001"
    path = folder("weak.g2o", *(line.replace(FLAT, weak) for line in lines))
    assert "(--information covariance)" in run("inspect", path).out
    assert "(--information" not in run("inspect", path, "--information", "covariance").out
    assert "--information covariance" in run("merge", path).err


def test_a_cut_says_before_which_ids(run, folder):
    lines = [*chain(1), *chain(4), *(closure(k, k + 3) for k in (1, 2, 3))]
    path = folder("two.g2o", *lines)
    ran = run("merge", path, "--split-id", 4, "--minimum-inliers", 2, "--report", "r.json")
    assert ran.out.startswith("cut before the poses with ids 4\n")
    assert json.loads(Path("r.json").read_text())["robot_pairs"][0]["measured"] == 3
    ran = run("merge", path, "--split", 4)
    assert "dropped, as odometry across the cut: 4-5" in ran.out
    assert "have the ids 5, since the ids are not 0, 1, 2, ...; --split-id 4 cuts" in ran.err
    ran = run("merge", path, "--split", "components", "--report", "r.json")
    assert json.loads(Path("r.json").read_text())["robot_pairs"][0]["measured"] == 3
    for option, value, message in (
        ("--split-id", 9, "error: --split-id: pose 9 given, expected one of the poses 1 to 6"),
        ("--split", "half", "error: --split: 'half' given, expected poses or 'components'"),
    ):
        ran = run("merge", path, option, value)
        assert (ran.status, ran.err.strip()) == (2, message)


def test_groups_are_written_apart(run, three):
    ran = run("merge", three, "--minimum-inliers", 2, "--output", "m.g2o", "--rejected", "r.csv")
    assert ran.status == 0
    assert [path.name for path in sorted(Path().glob("m.*"))] == ["m.g2o", "m.group2.g2o"]
    joined, alone = read_graph("m.g2o"), read_graph("m.group2.g2o")
    assert (joined.names, alone.names) == (("a", "b"), ("c",))
    assert len(joined.closures) == 2
    assert "# pcm_jax frame a" in Path("m.g2o").read_text().splitlines()
    rejected = Path("r.csv").read_text().splitlines()
    assert len(rejected) == 2 and rejected[1].startswith(f"a,{KEY['a']},c,{KEY['c']},9.0")
    assert "connected by closures: a b\n" in run("inspect", "m.g2o").out


def test_ids_that_fit_no_symbol_key(run, folder):
    """Negative ones are written as 0, 1, 2, … with a table beside the file."""
    maps = [folder(f"{name}.g2o", *chain(start, 6)) for name, start in (("p", -9), ("q", -9))]
    rows = [f"p,{k},q,{k + 1},1,2,0,0.1,0.1,0.1" for k in range(-9, -4)]
    candidates = folder("c.csv", *rows)
    options = ("--closures", candidates, "--minimum-inliers", "2", "--output", "m.g2o")
    out = run("merge", *maps, *options).out
    assert "wrote m.ids.csv" in out and "wrote m.g2o" in out
    graph = read_graph("m.g2o")
    assert graph.names == ("p", "q")
    assert [one.ids.tolist() for one in graph.maps] == [list(range(-9, -3))] * 2
    assert len(graph.closures) == 5


def test_files_for_each_robot(run, three):
    ran = run("merge", three, "--minimum-inliers", 2, "--output", "out/")
    assert ran.status == 0
    names = {path.name for path in Path("out").iterdir()}
    assert names == {*(f"{n}.{s}" for n in "abc" for s in ("g2o", "tum")), "closures.csv"}
    again = read_graph("out/a.g2o", "out/b.g2o", "out/c.g2o", closures="out/closures.csv")
    assert again.names == ("a", "b", "c") and len(again.closures) == 2
    Path("file").write_text("")
    assert "this is a file, expected a folder" in run("merge", three, "--output", "file/").err


def test_other_formats_by_suffix(run, three):
    assert run("merge", three, "--minimum-inliers", 2, "--output", "m.jrl").status == 0
    assert read_graph("m.jrl").names == ("a", "b")


def test_trajectories_from_the_command_line(run, folder):
    rows = ["0 {} {} 0 0 0 0 1", "1 {} {} 0 0 0 0 1", "2 {} {} 0 0 0 0 1"]
    for name, y in (("a", 0), ("b", 5)):
        folder(f"{name}.txt", *(row.format(k, y) for k, row in enumerate(rows)))
    folder("c.csv", "a,0,b,0,0,5,0,0,0,0,1", "a,2,b,2,0,5,0,0,0,0,1")
    ran = run("merge", "a.txt", "b.txt", "--sigmas", 0.1, 0.01, "--closures", "c.csv")
    assert ran.status == 0
    assert "--sigmas M RAD" in run("merge", "a.txt", "b.txt", "--closures", "c.csv").err


def test_bad_candidates_on_request(run, folder):
    for name in "ab":
        folder(f"{name}.g2o", *chain(0))
    folder("c.csv", "a,0,b,0,0,2,0", "a,9,b,0,0,2,0", "a,2,b,2,0,2,0")
    arguments = ["merge", "a.g2o", "b.g2o", "--closures", "c.csv", "--report", "r.json"]
    arguments += ["--minimum-inliers", 2]
    assert run(*arguments).status == 2
    assert run(*arguments, "--skip-bad").status == 0
    told = json.loads(Path("r.json").read_text())
    assert told["robot_pairs"][0]["measured"] == 2
    assert any("1 bad candidates left out" in note for note in told["input"]["notes"])
    assert np.isclose(told["anchors"][1]["y"], 2.0)


def test_priors_place_a_merge_unless_they_are_ignored(run, city, tmp_path):
    """A fix of the first pose, 100 m away: the written map lies there, or where it was."""
    key = next(line for line in (city / "graph.g2o").read_text().splitlines()).split()[1]
    fixed = tmp_path / "fixed.g2o"
    line = f"EDGE_PRIOR_SE2 {key} 100 50 0.3 2500 0 0 2500 0 10000\n"
    fixed.write_text(line + (city / "graph.g2o").read_text())
    for options, place in (((), [100.0, 50.0]), (("--ignore-priors",), [0.0, 0.0])):
        ran = run("merge", fixed, "--output", tmp_path / "merged.g2o", *options)
        assert ran.status == 0, ran.err
        written = (tmp_path / "merged.g2o").read_text()
        (first,) = (x for x in written.splitlines() if x.startswith(f"VERTEX_SE2 {key} "))
        assert [float(word) for word in first.split()[2:4]] == pytest.approx(place, abs=0.1)
        assert ("EDGE_PRIOR_SE2" in written) == (not options)
