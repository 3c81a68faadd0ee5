"""Everything on the README's page is run: its code, its commands, its links, its figures."""

import importlib.util
import json
import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from benchmarks.suite import headlines, report
from pcm_jax.cli import main
from pcm_jax.cli._arguments import parser
from pcm_jax.evaluation import ate_rmse
from pcm_jax.files import read_graph, write_g2o
from pcm_jax.graph import LoopClosures, MultiRobotGraph
from pcm_jax.simulation import simulate_city

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)
PYTHON = [text for language, text in BLOCKS if language == "python"]
SHELL = [line for language, text in BLOCKS if language == "sh" for line in text.splitlines()]
COMMANDS = [line for line in SHELL if line.startswith("pcm-jax ")]
SETUPS = [line for line in SHELL if line.startswith("python3 ")]
TOOLS = [line for line in SHELL if line not in COMMANDS + SETUPS]
DOCUMENTS = [ROOT / "README.md", *(ROOT / "benchmarks").glob("*.md")]
MOST_WORDS = 1_300
WORLD = {"seed": 1, "poses": 150}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The files that the page speaks of."""
    folder = tmp_path_factory.mktemp("readme")
    options = [f"--{name}={value}" for name, value in WORLD.items()]
    assert main(["simulate", "city", "--csv", "--output", str(folder), *options]) == 0
    write_g2o(folder / "trajectory.g2o", simulate_city(poses=300).graph.maps[0])
    graph = simulate_city(**WORLD).graph
    empty = LoopClosures.empty(graph.group)
    write_g2o(folder / "robot_a.g2o", graph)
    write_g2o(folder / "robot_b.g2o", MultiRobotGraph(graph.maps, empty))
    return folder


@pytest.fixture(autouse=True)
def in_folder(folder, monkeypatch):
    monkeypatch.chdir(folder)


@pytest.fixture(scope="module")
def names(folder):
    """What the page's Python has defined at its end; its blocks are one program."""
    here, names = Path.cwd(), {}
    os.chdir(folder)
    try:
        for block in PYTHON:
            exec(compile(block, "README.md", "exec"), names)
    finally:
        os.chdir(here)
    return names


def test_the_first_screen():
    """A sentence, the picture, why, the install line, five lines of Python."""
    screen = TEXT[: TEXT.index("\n## ")]
    marks = ("closures that agree", "![", "**Why.**", "```sh", "```python")
    places = [screen.index(mark) for mark in marks]
    assert places == sorted(places)
    assert len(PYTHON[0].splitlines()) == 5
    assert PYTHON[0].startswith('import jax; jax.config.update("jax_enable_x64", True)\n')


def test_short_enough_to_be_read():
    """Words of prose, parted by white space: no code, no tables, no comments."""
    prose = re.sub(r"^```.*?^```$|<!--.*?-->|^\|.*?$", "", TEXT, flags=re.M | re.S)
    assert 800 < len(prose.split()) <= MOST_WORDS


def test_six_figures_are_the_committed_ones():
    table = headlines.six(report.read_baseline())
    assert report.with_block(TEXT, headlines.TOP_MARKERS, table) == TEXT
    assert len(table.splitlines()) == 2 + 6


def test_the_reason_why_is_the_committed_table():
    summary = json.loads((ROOT / "benchmarks/results/city/summary.json").read_text())
    rows = ("pcm-exact-11", "no-outliers", "dcs", "everything")
    pcm, true, dcs, everything = (summary[row]["ate_rmse"] for row in rows)
    said = (
        f"off by {pcm:.2f} m when PCM chooses the closures, {true:.2f} m with the true ones alone, "
        f"{dcs:.0f} m with dynamic covariance scaling and {everything:.0f} m with all of them"
    )
    assert said in " ".join(TEXT.split())


@pytest.mark.slow
def test_python(names):
    world = simulate_city(**WORLD)
    accepted = names["result"].accepted
    assert not (accepted & ~world.is_true).any()
    assert accepted.sum() >= 12  # of 15
    assert ate_rmse(names["result"].graph.maps, world.truth, align="umeyama") < 0.2
    assert read_graph("merged.g2o").names == ("a", "b")


@pytest.mark.slow
def test_python_by_hand_is_what_merge_does(names):
    by_hand, at_once = names["merged"].solution, names["result"].solution
    assert by_hand.cost == pytest.approx(at_once.cost, rel=1e-9)
    np.testing.assert_array_equal(names["merged"].accepted, names["result"].accepted)


@pytest.mark.slow
def test_python_recipes(names):
    assert names["small"].accepted.tolist() == [True, True, False]
    np.testing.assert_array_equal(names["cleaned"].graph.ids, names["graph"].maps[0].ids)


@pytest.mark.slow
def test_python_of_evidence(names):
    strict, again, mine = (names[name].accepted for name in ("strict", "again", "mine"))
    assert 2 <= strict.sum() <= names["result"].accepted.sum()
    np.testing.assert_array_equal(again, names["result"].accepted)
    assert mine[names["result"].accepted].all()
    np.testing.assert_array_equal(names["chosen"], names["clique"].members)


@pytest.mark.slow
def test_commands():
    """In the page's order, and so in one test: later ones use what earlier ones wrote."""
    for line in COMMANDS:
        words = shlex.split(line)[1:]
        assert main(words) == 0, line
        options = vars(parser().parse_args(words))
        for name in ("output", "report", "plot"):
            if options.get(name):
                assert Path(options[name]).exists(), line


def test_two_setups_one_for_the_demo_and_one_for_the_tests():
    """They install from the network: `.ci/run` runs the second, people the first."""
    demo, tests = SETUPS
    assert demo == (
        "python3 -m venv .venv && .venv/bin/pip install '.[plot]' && .venv/bin/pcm-jax demo"
    )
    assert tests.startswith("python3 -m venv .venv && .venv/bin/pip install ")
    assert tests.endswith(" && .venv/bin/pytest -n 2")


def test_ci_runs_the_readmes_line():
    """The script holds no line of its own: it finds the one that ends in pytest here."""
    script = (ROOT / ".ci" / "run").read_text()
    (pattern,) = re.findall(r"sed -n '(.*)p' README\.md", script)
    found = [line for line in TEXT.splitlines() if re.search(pattern.strip("/"), line)]
    assert found == [SETUPS[1]]
    assert os.access(ROOT / ".ci" / "run", os.X_OK)


def test_tools_of_development_exist():
    quick, reference, files = (shlex.split(line) for line in TOOLS)
    assert quick[0] == ".venv/bin/pytest"
    assert quick[-3:] == ["-m", "not slow", "tests"]
    assert reference[:3] == [".venv/bin/pdoc", "-d", "google"]
    folders = re.fullmatch(r"pcm_jax\{,(.*)\}", reference[3])[1].split(",")
    assert all(importlib.util.find_spec(f"pcm_jax{folder}") for folder in folders)
    assert (ROOT / files[1]).exists()


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.parent.name + "/" + path.name)
def test_links(document):
    for target in re.findall(r"\]\(([^)]+)\)", document.read_text()):
        if "://" in target:
            continue
        path, _, section = target.partition("#")
        linked = (document.parent / path).resolve() if path else document
        assert linked.exists(), target
        if section:
            headings = re.findall(r"^#+ (.+)$", linked.read_text(), re.M)
            anchors = [re.sub(r"[^\w -]", "", name.lower()).replace(" ", "-") for name in headings]
            assert section in anchors, target
