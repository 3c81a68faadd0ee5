"""Ctrl-C, closed streams, and text that a stream cannot encode."""

import importlib
import os
import re
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest

from pcm_jax.cli import entry, formats, main
from pcm_jax.clique import maximum_clique

EDGES = "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"

SWALLOWED = """
import signal, sys
from pcm_jax.cli import console
from pcm_jax.cli import formats

class Swallows:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)  # what is raised here is told and dropped

def run(options):
    Swallows()
    print("went on")
    while {forever}:
        pass

formats.run = run
sys.argv = ["pcm-jax", "formats"]
console()
"""


@pytest.mark.parametrize("forever", [False, True])
def test_an_interrupt_that_a_callback_swallows_is_heeded(forever):
    code = SWALLOWED.format(forever=forever)
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert (done.returncode, done.stderr, done.stdout) == (130, "interrupted\n", "went on\n")


def test_an_interrupt_is_one_line_and_restores_what_was_there(monkeypatch, capsys):
    before = signal.getsignal(signal.SIGINT), sys.unraisablehook

    def imported(name):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise ImportError("NumPy says that it is not installed well") from None

    monkeypatch.setattr(entry.importlib, "import_module", imported)
    assert main(["formats"]) == 130
    assert capsys.readouterr().err == "interrupted\n"
    assert (signal.getsignal(signal.SIGINT), sys.unraisablehook) == before


def test_an_interrupt_waits_until_a_module_is_imported(tmp_path, monkeypatch, capsys):
    (tmp_path / "imports_slowly.py").write_text(
        "import signal\nsignal.raise_signal(signal.SIGINT)\nwhole = True\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    modules = []

    def imports(options):
        del options
        modules.append(importlib.import_module("imports_slowly"))
        while True:
            pass

    monkeypatch.setattr(formats, "run", imports)
    assert main(["formats"]) == 130
    assert capsys.readouterr().err == "interrupted\n"
    assert modules[0].whole


def test_an_interrupt_does_not_wait_for_the_module_that_calls_the_command_line(tmp_path):
    lines = ["import signal", "from pcm_jax.cli import formats, main"]
    lines += ["formats.run = lambda _: (signal.raise_signal(signal.SIGINT), print('went on'))"]
    (tmp_path / "calls.py").write_text("\n".join([*lines, "status = main(['formats'])"]))
    done = subprocess.run(
        [sys.executable, "-c", "import calls; raise SystemExit(calls.status)"],
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr, done.stdout) == (130, "interrupted\n", "")


def test_an_interrupted_search_says_what_it_had_found(monkeypatch, capsys):
    graph = np.random.default_rng(0).uniform(size=(400, 400)) < 0.85

    def searched(options):
        del options
        threading.Timer(0.5, os.kill, [os.getpid(), signal.SIGINT]).start()
        maximum_clique(graph & graph.T & ~np.eye(400, dtype=bool))

    monkeypatch.setattr(formats, "run", searched)
    assert main(["formats"]) == 130
    told = capsys.readouterr().err
    assert re.fullmatch(r"interrupted: a clique of \d\d was found, none has \d+\n", told)


@pytest.mark.slow
def test_names_that_standard_output_cannot_encode(tmp_path):
    path = tmp_path / "u.g2o"
    path.write_text(EDGES + "# pcm_jax robot - id Z\u00fcrich\n", encoding="utf-8")
    ascii_only = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = subprocess.run(
        [sys.executable, "-m", "pcm_jax", "inspect", str(path)],
        check=False,
        env=ascii_only,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and "Z\\xfcrich" in done.stdout, done.stderr


def test_a_path_that_is_no_text(tmp_path, capsys):
    name = os.fsdecode(bytes(tmp_path) + b"/x\xff\n.g2o")
    assert main(["inspect", name]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ") and line.endswith("there is no such file")


@pytest.mark.parametrize("closed", ["stdout", "stderr"])
def test_streams_that_are_closed(closed, tmp_path, monkeypatch):
    path = tmp_path / "a.g2o"
    path.write_text(EDGES)
    monkeypatch.setattr(sys, closed, None)
    assert main(["inspect", str(path)]) == 0
    assert main(["inspect", str(tmp_path / "none.g2o")]) == 2
    assert getattr(sys, closed) is None
