"""Bad input: exit status 2, one line that says what is wrong, no traceback, nothing written."""

import gzip
from pathlib import Path

import pytest

from pcm_jax.files.output import check_target

INFORMATION = "100 0 0 100 0 100"
GOOD = [
    "VERTEX_SE2 0 0 0 0",
    "VERTEX_SE2 1 1 0 0",
    "VERTEX_SE2 2 2 0 0",
    "VERTEX_SE2 3 2 1 0",
    f"EDGE_SE2 0 1 1 0 0 {INFORMATION}",
    f"EDGE_SE2 1 2 1 0 0 {INFORMATION}",
    f"EDGE_SE2 2 3 0 1 0 {INFORMATION}",
    f"EDGE_SE2 0 2 2 0 0 {INFORMATION}",
    f"EDGE_SE2 1 3 1 1 0 {INFORMATION}",
]
SOLID = ["VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1"]
CLOSURES = ["robot_a,id_a,robot_b,id_b,x,y,theta", "a,1,b,2,0,0,0", "b,0,a,0,0,0,0"]


def lines(*text: str, replace: dict[int, str] | None = None) -> str:
    """A file's text, with some lines (counted from one) replaced."""
    rows = list(text or GOOD)
    for number, row in (replace or {}).items():
        rows[number - 1] = row
    return "\n".join(rows) + "\n"


BAD_MAPS = {
    "truncated in a line": (lines()[:-9], "bad.g2o:9: ", "is the file cut short?"),
    "empty": ("", "bad.g2o: ", "expected a pose graph"),
    "unknown tag": (lines(replace={2: "VERTEX_SE9 1 1 0 0"}), "bad.g2o:2: ", "'VERTEX_SE9'"),
    "column count": (
        lines(replace={2: "VERTEX_SE2 1 1 0"}),
        "bad.g2o:2: ",
        "4 columns, expected 5",
    ),
    "not a number": (lines(replace={2: "VERTEX_SE2 1 nan 0 0"}), "bad.g2o:2: ", "nan given"),
    "infinite": (lines(replace={2: "VERTEX_SE2 1 inf 0 0"}), "bad.g2o:2: ", "inf given"),
    "repeated vertex": (lines(replace={3: "VERTEX_SE2 1 5 0 0"}), "bad.g2o:3: ", "vertex 1 again"),
    "missing vertex": (
        lines(replace={5: f"EDGE_SE2 0 9 1 0 0 {INFORMATION}"}),
        "bad.g2o:5: ",
        "edge to pose 9",
    ),
    "self loop": (
        lines(replace={5: f"EDGE_SE2 1 1 1 0 0 {INFORMATION}"}),
        "bad.g2o:5: ",
        "to itself",
    ),
    "not definite": (
        lines(replace={5: "EDGE_SE2 0 1 1 0 0 1 0 0 -1 0 1"}),
        "bad.g2o:5: ",
        "--repair clip",
    ),
    "disconnected": (
        lines(*GOOD[:5], GOOD[6]),
        "bad.g2o: ",
        "the map falls into 2 parts",
    ),
    "groups mixed in a file": (lines(*GOOD, *SOLID), "bad.g2o:10: ", "SE(2) and SE(3)"),
    "groups mixed between files": (lines(*SOLID), "bad.g2o: ", "SE(2) and SE(3)"),
    "quaternion of norm 0": (lines("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 0"), "bad.g2o:1: ", "norm 0"),
}

BAD_CLOSURES = {
    "unknown robot": ("a,1,z,2,0,0,0", "bad.csv:2: ", "there is no robot 'z'"),
    "unknown pose": ("a,1,b,99,0,0,0", "bad.csv:2: ", "no pose with id 99"),
    "one robot": ("a,1,a,2,0,0,0", "bad.csv:2: ", "to itself"),
    "column count": ("a,1,b,2,0,0", "bad.csv:2: ", "6 columns"),
    "infinite": ("a,1,b,2,0,inf,0", "bad.csv:2: ", "inf given"),
    "standard deviation": ("a,1,b,2,0,0,0,1,0,1", "bad.csv:2: ", "0 given"),
}

BAD_OPTIONS = {
    "method": (["--method", "magic"], "'magic'", "pcm-exact"),
    "confidence": (["--confidence", "1.5"], "1.5", "between 0 and 1"),
    "not a number": (["--confidence", "high"], "--confidence", "'high'"),
    "minimum": (["--minimum-inliers", "-1"], "-1", "at least 0"),
    "time limit": (["--time-limit", "-1"], "--time-limit", "-1"),
    "information": (["--information", "squared"], "--information", "'squared'"),
    "split of two": (["--split", "2"], "--split", "2 robots"),
    "output folder": (
        ["--output", "none/merged.g2o"],
        "none/merged.g2o",
        "there is no folder none",
    ),
    "report folder": (["--report", "none/r.json"], "none/r.json", "there is no folder none"),
    "plot folder": (["--plot", "none/p.png"], "none/p.png", "there is no folder none"),
    "output is a folder": (["--output", "."], ".", "this is a folder"),
    "output is an input": (["--output", "a.g2o"], "a.g2o", "this file is read"),
    "two outputs": (["--output", "x", "--report", "x"], "x", "named for two results"),
    "picture": (["--plot", "merged.xyz"], "merged.xyz", "png"),
    "unknown option": (["--speed"], "--speed", "unrecognized"),
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, with two good maps and good candidates."""
    monkeypatch.chdir(tmp_path)
    for name in "ab":
        Path(f"{name}.g2o").write_text(lines())
    Path("good.csv").write_text(lines(*CLOSURES))
    return tmp_path


@pytest.fixture
def fails(run, folder):
    """Runs a command that must fail as all do, and gives its line."""

    def command(*arguments) -> str:
        before = {path.name for path in folder.iterdir()}
        ran = run(*arguments)
        assert (ran.status, ran.out) == (2, ""), ran
        (line,) = ran.err.splitlines()
        assert line.startswith("error: ")
        assert {path.name for path in folder.iterdir()} == before
        return line

    return command


@pytest.mark.parametrize("case", BAD_MAPS)
def test_bad_maps(fails, case):
    text, place, problem = BAD_MAPS[case]
    Path("bad.g2o").write_text(text)
    outputs = ["--output", "merged.g2o", "--report", "report.json", "--plot", "merged.png"]
    line = fails("merge", "a.g2o", "bad.g2o", "--closures", "good.csv", *outputs)
    assert place in line and problem in line


@pytest.mark.parametrize("command", ["merge", "inspect"])
def test_binary_and_damaged_files(fails, command):
    Path("bad.g2o").write_bytes(b"\x89PNG\r\n\x1a\n")
    assert "bad.g2o:1: binary data" in fails(command, "a.g2o", "bad.g2o")
    Path("bad.g2o.gz").write_bytes(gzip.compress(lines().encode())[:40])
    assert "bad.g2o.gz: damaged or truncated" in fails(command, "a.g2o", "bad.g2o.gz")


@pytest.mark.parametrize("case", BAD_CLOSURES)
def test_bad_closures(fails, case):
    row, place, problem = BAD_CLOSURES[case]
    Path("bad.csv").write_text(lines(CLOSURES[0], row))
    line = fails("merge", "a.g2o", "b.g2o", "--closures", "bad.csv", "--output", "merged.g2o")
    assert place in line and problem in line


@pytest.mark.parametrize("case", BAD_OPTIONS)
def test_bad_options(fails, case):
    options, *words = BAD_OPTIONS[case]
    line = fails("merge", "a.g2o", "b.g2o", "--closures", "good.csv", *options)
    assert all(word in line for word in words)


def test_no_such_file(fails):
    assert "none.g2o: there is no such file" in fails("merge", "a.g2o", "none.g2o")
    assert "none.csv: there is no such file" in fails("merge", "a.g2o", "--closures", "none.csv")


def test_one_robot_says_how_split_helps(fails):
    assert "--split 2" in fails("merge", "a.g2o", "--output", "merged.g2o")


def test_two_robots_without_closures_say_where_closures_come_from(fails):
    assert "--closures" in fails("merge", "a.g2o", "b.g2o", "--output", "merged.g2o")


@pytest.mark.parametrize("at", [["0"], ["4"], ["-1"], ["3", "2"], ["1", "1"]])
def test_bad_cuts(fails, at):
    assert fails("merge", "a.g2o", "--split", *at).startswith("error: --split: ")


def test_a_cut_that_leaves_a_piece_in_parts(fails):
    Path("bad.g2o").write_text(lines(*GOOD[:5], GOOD[7], GOOD[6]))  # no edge from 1 to 2
    line = fails("merge", "bad.g2o", "--split", "1")
    assert line.startswith("error: --split: piece 2 ")


def test_one_line_even_where_something_was_corrected_before(fails):
    Path("landmarks.g2o").write_text(lines(*GOOD, "VERTEX_XY 9 0 0"))
    fails("merge", "landmarks.g2o", "b.g2o")


def test_a_folder_that_must_not_be_written_to(folder, fails, monkeypatch):
    """Root may write anywhere, so the system's answer is made up."""
    monkeypatch.setattr("os.access", lambda path, mode: False)
    assert "permission denied" in fails("merge", "a.g2o", "--output", "merged.g2o")
    with pytest.raises(ValueError, match="permission denied"):
        check_target(folder / "any")


@pytest.mark.parametrize("world", ["city", "sessions"])
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--output", "none/deep"], "there is no folder none"),
        (["--output", "a.g2o"], "this is a file, expected a folder"),
        (["--output", "new", "--poses", "1"], "poses: 1 given, expected at least 2"),
        (["--output", "new", "--inliers", "100000"], "inliers: 100000"),
        (["--poses", "10"], "--output"),
    ],
)
def test_bad_worlds(fails, world, options, words):
    assert words in fails("simulate", world, *options)


@pytest.mark.parametrize(
    "arguments", [[], ["conquer"], ["simulate"], ["merge"], ["demo", "--fast"]]
)
def test_bad_command_lines(fails, arguments):
    assert "pcm-jax" in fails(*arguments)


def test_a_missing_extra_is_named_before_anything_is_computed(fails, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib", None)
    assert "pip install '.[plot]'" in fails("demo")
    assert "pip install '.[plot]'" in fails(
        *("merge", "a.g2o", "b.g2o", "--closures", "good.csv", "--plot", "merged.png")
    )
