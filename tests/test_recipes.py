"""Recipes in modules' docstrings: each module's Python blocks are run, as one program."""

import ast
import contextlib
import re
from pathlib import Path

import jax
import numpy as np
import pytest

import pcm_jax as pcm

pytestmark = pytest.mark.slow


PACKAGE = Path(pcm.__file__).parent
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks_of(path):
    return BLOCK.findall(ast.get_docstring(ast.parse(path.read_text())) or "")


MODULES = {
    path.relative_to(PACKAGE).with_suffix("").as_posix(): blocks
    for path in sorted(PACKAGE.rglob("*.py"))
    if (blocks := blocks_of(path))
}


@pytest.fixture(scope="module")
def world():
    """The names that recipes take for given, as in the README's four steps."""
    graph = pcm.simulation.simulate_city(seed=1, poses=150).graph
    maps = [pcm.optimize(one).graph for one in graph.maps]
    closures, _ = graph.closures.between(0, 1)
    problem = pcm.consistency_problem(*maps, closures)
    squared = pcm.squared_mahalanobis(problem)
    given = {"graph": graph, "maps": maps, "closures": closures, "problem": problem}
    gate = pcm.chi2_gate(0.99, dof=3)
    return given | {"squared": squared, "gate": gate, "pcm": pcm, "jax": jax, "np": np}


@pytest.fixture(scope="module")
def run(world, tmp_path_factory):
    """Runs a module's recipes in a folder of their own, and gives the names they define."""

    def run(module):
        names = dict(world)
        for block in MODULES[module]:
            for package in re.findall(r"^import (gtsam|torch|pyarrow)\b", block, re.MULTILINE):
                pytest.importorskip(package)
            with contextlib.chdir(folder):
                exec(compile(block, module, "exec"), names)
        return names

    folder = tmp_path_factory.mktemp("recipes")
    return run


def test_every_recipe_is_run_by_a_test_of_its_own():
    assert list(MODULES) == [
        "consistency/problem",
        "experiments/sweep",
        "merging/differentiable",
        "selection/soft",  # by test_dlpack.py
    ]


def test_covariances_of_gtsam(run, world):
    by_gtsam = pcm.squared_mahalanobis(run("consistency/problem")["problem"])
    np.testing.assert_allclose(by_gtsam, world["squared"], rtol=1e-3)  # its gauge is a prior


def test_sweeps_and_meshes(run, world):
    names = run("experiments/sweep")
    assert names["rows"].num_rows == 200 * 2 * 2
    m = len(world["squared"])
    np.testing.assert_allclose(names["shared"][:m, :m], world["squared"], rtol=1e-12)


def test_training(run, world):
    """Only closures that PCM accepts, or nearly does, can move the map."""
    slope = np.asarray(run("merging/differentiable")["slope"])
    assert np.isfinite(slope).all()
    accepted = pcm.select_from(world["squared"], float(world["gate"]))
    assert np.abs(slope[accepted.nonzero()]).max() > 1e-3
