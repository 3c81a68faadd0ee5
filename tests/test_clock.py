"""The wall clock decides nothing: it may jump, when a network sets it or a robot has none."""

from __future__ import annotations

import ast
import itertools
import random
import time
from pathlib import Path

import pytest

import pcm_jax as pcm
from pcm_jax.clique import maximum_clique
from pcm_jax.simulation import simulate_city
from pcm_jax.store import Store

PACKAGE = Path(pcm.__file__).parent
DAY = 86400.0
# Of the modules `time` and `datetime`: what does not read the wall clock.
STEADY = {"perf_counter", "monotonic", "sleep"}


def clocks_of(tree: ast.Module) -> set[str]:
    """Names of `time` and `datetime` that a module uses, but for steady ones."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module in ("time", "datetime"):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names if alias.name == "datetime"}
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            names |= {node.attr} if node.value.id == "time" else set()
    return names - STEADY


def test_no_module_reads_the_wall_clock():
    found = {
        path.relative_to(PACKAGE).as_posix(): clocks
        for path in PACKAGE.rglob("*.py")
        if (clocks := clocks_of(ast.parse(path.read_text(encoding="utf-8"))))
    }
    assert found == {}


@pytest.mark.parametrize(
    ("code", "clocks"),
    [
        ("import time\nwhile time.time() < end: pass", {"time"}),
        ("from time import perf_counter, time_ns", {"time_ns"}),
        ("import datetime", {"datetime"}),
        ("import time\ntime.monotonic()", set()),
    ],
)
def test_a_wall_clock_would_be_seen(code, clocks):
    assert clocks_of(ast.parse(code)) == clocks


@pytest.fixture
def jumps(monkeypatch):
    """A wall clock that jumps by a day, back and forth."""
    rng, real = random.Random(0), time.time
    monkeypatch.setattr(time, "time", lambda: real() + rng.choice((-DAY, 0.0, DAY)))


def test_a_clock_that_jumps_changes_no_answer(jumps, tmp_path):
    graph = simulate_city(seed=1, poses=30, inliers=6, random=8).graph
    first, second = (pcm.merge(graph, time_limit=60.0, minimum_inliers=4) for _ in range(2))
    assert (first.accepted == second.accepted).all() and first.accepted.sum() >= 4
    assert first.solution.cost == second.solution.cost
    clique = maximum_clique(pcm.consistency_graph([[0, 1], [1, 0]], 5.0), time_limit=60.0)
    assert clique.optimal and clique.size == 2 and 0.0 <= clique.seconds < DAY / 2
    counter = itertools.count()
    store = Store(tmp_path, "stamp")
    assert [store("one", lambda: next(counter)) for _ in range(3)] == [0, 0, 0]
