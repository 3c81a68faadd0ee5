"""Help, versions, `inspect`, progress, and what a command does when it is stopped."""

import io
import subprocess
import sys
import time

import pytest

import pcm_jax
from pcm_jax.cli import _progress as progress
from pcm_jax.cli import inspect, main
from pcm_jax.files import read_graph


def test_version_and_help(run):
    assert run("--version").out == f"pcm-jax {pcm_jax.__version__}\n"
    for arguments in (
        [],
        ["demo"],
        ["merge"],
        ["inspect"],
        ["explain"],
        ["stream"],
        ["evaluate"],
        ["simulate"],
        ["simulate", "city"],
    ):
        ran = run(*arguments, "--help")
        assert ran.status == 0
        assert ran.out.startswith(f"usage: {' '.join(['pcm-jax', *arguments])}")


def test_help_answers_without_jax():
    code = "import sys; from pcm_jax.cli import main\ntry: main(['--help'])\n"
    code += "except SystemExit: sys.exit('jax' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_inspect(run, city):
    ran = run("inspect", city / "graph.g2o")
    assert (ran.status, ran.err) == (0, "")
    graph = read_graph(city / "graph.g2o")
    rows = [line.split() for line in ran.out.splitlines()]
    for one in graph.maps:
        (row,) = (row for row in rows if row[:1] == [one.name] and "-" not in row)
        assert row[1:6] == ["60", "0", "to", "59", str(one.num_edges)]
        assert int(row[6]) + int(row[7]) == one.num_edges and row[6] == "59"
        assert float(row[8]) == pytest.approx(59.0, abs=1.0)
    assert ["a", "-", "b", "20"] in rows
    assert "connected by closures: a b" in ran.out
    assert "nothing odd found" in ran.out


def test_inspect_finds_what_is_odd(run, city, tmp_path):
    """Each oddity is planted once; none stops the inspection."""
    rows = (city / "graph.g2o").read_text().splitlines()
    a, b = (ord(letter) << 56 for letter in "ab")
    information, edge = "2500 0 0 2500 0 10000", "EDGE_SE2"
    rows = [row for row in rows if not row.startswith(f"{edge} {a + 7} {a + 8} ")]
    rows += [
        f"{edge} {a} {a + 59} 0 0 0 {information}",
        f"{edge} {a} {a + 1} 1 0 0 {information}",
        f"{edge} {a} {b} 0 0 0 1 0.9999999999 0 1 0 1",
        f"VERTEX_SE2 {a + 70} 0 0 0",
        f"{edge} {a + 59} {a + 70} 1 0 0 {information}",
        f"{edge} {b} {b + 1} 1 0 0 1 0 0 1 0 -1",
        "VERTEX_XY 7 0 0",
    ]
    (tmp_path / "odd.g2o").write_text("\n".join(rows) + "\n")
    ran = run("inspect", tmp_path / "odd.g2o")
    assert ran.status == 0
    findings = [line for line in ran.out.splitlines() if line.startswith("- ")]
    for words in (
        "VERTEX_XY",
        "1 information matrices clipped",
        "robot a: consecutive poses without an edge between them: 1",
        "robot a: loop closures that measure exactly the identity: 1",
        "robot b: edges between poses that another edge joins already: 1",
        "robot a: gaps in the poses' ids: 1",
        "between robots: closures that measure exactly the identity: 1",
        "between robots: information matrices that are nearly singular: 1",
    ):
        assert any(words in finding for finding in findings), (words, ran.out)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(progress, "PATIENCE", 0.05)
    monkeypatch.setattr(progress, "TICK", 0.01)


def announce(pause: float) -> None:
    with progress.Progress("reading") as tell:
        for stage in ("selecting", "merging"):
            time.sleep(pause)
            tell(stage)
        time.sleep(pause)


def test_progress_in_a_log_is_a_line_for_each_stage_but_reading(impatient, capsys):
    announce(0.2)
    assert capsys.readouterr().err == "selecting ...\nmerging ...\n"


def test_progress_on_a_terminal_is_one_line_that_vanishes(impatient, monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    announce(0.2)
    written = terminal.getvalue()
    assert "\r\033[Kreading (0 s)" in written and "\r\033[Kmerging (0 s)" in written
    assert written.endswith("\r\033[K") and "\n" not in written


def test_quick_work_is_silent(capsys):
    announce(0.0)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (KeyboardInterrupt(), 130, ""),
        (OSError(28, "No space left on device", "m.g2o"), 2, "error: m.g2o: No space left"),
        (BrokenPipeError(), 0, ""),
    ],
)
def test_what_the_system_does(monkeypatch, capsys, error, status, line):
    def stopped(_):
        raise error

    monkeypatch.setattr(inspect, "run", stopped)
    monkeypatch.setattr(sys, "stdout", sys.stdout)  # restored: a broken pipe takes it away
    assert main(["inspect", "any.g2o"]) == status
    assert capsys.readouterr().err.startswith(line)


def test_faults_of_our_own_are_not_hidden(monkeypatch):
    def broken(_):
        raise RuntimeError("a fault in the package")

    monkeypatch.setattr(inspect, "run", broken)
    with pytest.raises(RuntimeError, match="a fault in the package"):
        main(["inspect", "any.g2o"])
