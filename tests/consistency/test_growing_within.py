"""`GrowingWithin` against `squared_mahalanobis` of the same closures, all at once."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.compiling import ALWAYS
from pcm_jax.consistency import (
    GrowingWithin,
    odometry_edges,
    squared_mahalanobis,
    squared_own_loops,
    with_odometry_errors,
    within_problem,
)
from pcm_jax.graph import PoseGraph
from pcm_jax.simulation import simulate_city, simulate_sessions


def edges(graph, rows):
    """What `append` and `extend` are told of some edges."""
    return (
        np.asarray(graph.tail)[rows],
        np.asarray(graph.head)[rows],
        lie.take(lie.as_numpy(graph.measurement), rows),
        np.asarray(graph.information)[rows],
    )


def looped(graph, seed, count=25):
    """The map's odometry and loops between poses drawn at random, half of them backwards."""
    generator = np.random.default_rng(seed)
    poses, size = lie.as_numpy(graph.poses), graph.num_poses
    tail, head = (generator.integers(0, size, count) for _ in range(2))
    tail = np.where(tail == head, (tail + 2) % size, tail)
    spread: Any = generator.normal(0.0, 0.3, (count, graph.tangent_dim))
    noise = lie.exp(graph.group, spread)
    exact = lie.between(lie.take(poses, tail), lie.take(poses, head))
    odometry = odometry_edges(graph)
    parts = edges(graph, odometry)
    return PoseGraph.from_arrays(
        poses=poses,
        tail=np.append(parts[0], tail),
        head=np.append(parts[1], head),
        measurement=lie.concatenate([parts[2], lie.compose(exact, noise)]),
        information=np.concatenate([parts[3], parts[3][:count] * 0.5]),
    )


@pytest.fixture(scope="module", params=["city", "sessions"])
def graph(request):
    if request.param == "city":
        one = simulate_city(seed=3, poses=70).graph.maps[0]
    else:
        one = simulate_sessions(seed=1, poses=50, sessions=2).graph.maps[0]
    return looped(one, seed=5)


def grown(graph, at_first):
    """The closures of a map, taken in one by one while its odometry comes."""
    steps = odometry_edges(graph)
    loops = np.setdiff1d(np.arange(graph.num_edges), steps)
    last = np.maximum(graph.tail, graph.head)[loops]
    begun = dataclasses.replace(
        graph.with_edges(steps[:at_first]),
        poses=lie.take(lie.as_numpy(graph.poses), np.arange(at_first + 1)),
    )
    found, order = GrowingWithin(begun), loops[np.argsort(last, kind="stable")]
    at = at_first
    for row in order.tolist():
        needed = int(max(graph.tail[row], graph.head[row]))
        if needed > at:
            found.extend(*edges(graph, steps[at:needed]))
            at = needed
        found.append(*edges(graph, [row]))
    return found, graph.with_edges(np.concatenate([steps, order]))


def table(found, factor):
    count = len(found)
    squared = np.zeros((count, count))
    for slot in range(count):
        squared[:slot, slot], squared[slot, :slot] = found.row(slot, factor)
    return squared, np.array([found.own(slot, factor) for slot in range(count)])


def assert_equal_to_batch(found, graph, factor=1.0):
    problem = with_odometry_errors(within_problem(graph), factor)
    squared, own = table(found, factor)
    np.testing.assert_allclose(squared, squared_mahalanobis(problem), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(own, squared_own_loops(problem), rtol=1e-9)


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_rows_are_those_of_the_batch(graph, factor):
    found, same = grown(graph, at_first=graph.num_poses - 1)
    assert_equal_to_batch(found, same, factor)


@pytest.mark.parametrize("at_first", [0, 7])
def test_odometry_that_comes_changes_nothing(graph, at_first):
    assert_equal_to_batch(*grown(graph, at_first))


def test_a_compiled_row_is_the_same(graph, monkeypatch):
    found, same = grown(graph, at_first=graph.num_poses - 1)
    monkeypatch.setenv(ALWAYS, "always")
    assert_equal_to_batch(found, same, 2.0)


def test_those_behind_one_that_goes_move_up(graph):
    found, same = grown(graph, at_first=graph.num_poses - 1)
    before = found.copy()
    for slot in (20, 3):
        found.remove(slot)
        same = same.with_edges(np.delete(np.arange(same.num_edges), same.num_poses - 1 + slot))
    assert_equal_to_batch(found, same)
    assert len(before) == len(found) + 2
    assert len(before.row(20)[0]) == 20


def test_there_is_room_for_any_number(graph):
    found, _ = grown(graph, at_first=graph.num_poses - 1)
    loops = np.arange(graph.num_poses - 1, graph.num_edges)
    last = found.row(24)
    for _ in range(5):
        found.append(*edges(graph, loops))
    np.testing.assert_array_equal(found.row(24), last)
    assert (found.row(149)[0].shape, len(found)) == ((149,), 150)
