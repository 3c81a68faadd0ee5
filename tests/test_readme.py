"""Everything on the README's page is run: its code, its commands, its links."""

import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

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
SETUPS = [line for line in SHELL if line not in COMMANDS]
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
            if "import gtsam" in block:
                pytest.importorskip("gtsam")
            if "import torch" in block:
                continue  # test_dlpack.py runs it where PyTorch is installed
            exec(compile(block, "README.md", "exec"), names)
    finally:
        os.chdir(here)
    return names


def test_the_first_screen():
    """A sentence, the picture, the install line, five lines of Python."""
    screen = TEXT[: TEXT.index("\n## ")]
    places = [screen.index(mark) for mark in ("closures that agree", "![", "```sh", "```python")]
    assert places == sorted(places)
    assert len(PYTHON[0].splitlines()) == 5
    assert PYTHON[0].startswith('import jax; jax.config.update("jax_enable_x64", True)\n')


def test_python(names):
    world = simulate_city(**WORLD)
    accepted = names["result"].accepted
    assert not (accepted & ~world.is_true).any()
    assert accepted.sum() >= 12  # of 15
    assert ate_rmse(names["result"].graph.maps, world.truth, align="umeyama") < 0.2
    assert read_graph("merged.g2o").names == ("a", "b")


def test_python_by_hand_is_what_merge_does(names):
    by_hand, at_once = names["merged"].solution, names["result"].solution
    assert by_hand.cost == pytest.approx(at_once.cost, rel=1e-9)
    np.testing.assert_array_equal(names["merged"].accepted, names["result"].accepted)
    np.testing.assert_array_equal(names["chosen"], names["clique"].members)


def test_python_of_learning(names):
    """Only closures that PCM accepts, or nearly does, can move the map."""
    slope = np.asarray(names["slope"])
    assert np.isfinite(slope).all()
    assert np.abs(slope[names["clique"].members.nonzero()]).max() > 1e-3


def test_python_recipes(names):
    assert names["small"].accepted.tolist() == [True, True, False]
    assert [one.num_poses for one in names["sessions"].maps] == [150, 150]
    by_gtsam = names["pcm"].squared_mahalanobis(names["problem"])
    np.testing.assert_allclose(by_gtsam, names["squared"], rtol=1e-3)  # its gauge is a prior


def test_python_past_one_device(names, folder):
    assert names["rows"].num_rows == 200 * 2 * 2
    assert len(list((folder / "sweep").glob("*.parquet"))) == 2
    m = len(names["squared"])
    by_gtsam = names["pcm"].squared_mahalanobis(names["problem"])
    np.testing.assert_allclose(names["shared"][:m, :m], by_gtsam, rtol=1e-12)


def test_commands():
    """In the page's order, and so in one test: later ones use what earlier ones wrote."""
    for line in COMMANDS:
        words = shlex.split(line)[1:]
        assert main(words) == 0, line
        options = vars(parser().parse_args(words))
        for name in ("output", "report", "plot"):
            if options.get(name):
                assert options[name].exists(), line


def test_two_setups_one_for_the_demo_and_one_for_the_tests():
    """Those are run by `.ci/run` and by hand: they install from the network."""
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


def test_links():
    for target in re.findall(r"\]\(([^)]+)\)", TEXT):
        if target.startswith("#"):
            assert f"\n## {target[1:].capitalize()}\n" in TEXT
        elif "://" not in target:
            path, _, section = target.partition("#")
            assert (ROOT / path).exists()
            headings = re.findall(r"^## (.+)$", (ROOT / path).read_text(), re.M) if section else []
            anchors = [re.sub(r"[^\w -]", "", name.lower()).replace(" ", "-") for name in headings]
            assert not section or section in anchors
