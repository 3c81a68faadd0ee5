"""Merges at the same time, which share plans and memory, are those of one after another."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import jax
import numpy as np
import pytest

from pcm_jax.pipeline import merge
from pcm_jax.simulation import simulate_city
from pcm_jax.sparse import registry

THREADS, TIMES = 8, 3


@pytest.fixture(scope="module")
def graphs():
    """Of eight sizes and patterns, in few padded sizes; the last two have one pattern."""
    law = {"inliers": 6, "aliased_groups": 1, "aliased_size": 3, "random": 6}
    sizes = (50, 55, 60, 65, 70, 75, 80, 80)
    worlds = [simulate_city(seed=max(k, 1), poses=n, **law) for k, n in enumerate(sizes[:-1])]
    again = simulate_city(seed=6, poses=80, **law)
    return [world.graph for world in (*worlds, again)]


def answer(graph):
    result = merge(graph)
    numbers = result.graph, result.anchors, result.anchor_covariance, result.solution.cost
    return [np.asarray(leaf) for leaf in jax.tree.leaves((result.accepted, numbers))]


@pytest.mark.slow
def test_eight_threads_give_the_bits_of_one_after_another(graphs):
    expected = [answer(graph) for graph in graphs]
    together = Barrier(THREADS)

    def merged(graph):
        together.wait()
        return [answer(graph) for _ in range(TIMES)]

    with ThreadPoolExecutor(THREADS) as pool:
        found = list(pool.map(merged, graphs))
    for times, right in zip(found, expected, strict=True):
        assert len(right) > 10
        for values in times:
            for one, other in zip(values, right, strict=True):
                np.testing.assert_array_equal(one, other, strict=True)


@pytest.mark.slow
def test_threads_that_start_with_no_plan_agree_on_one(graphs):
    """Each makes plans of its own where none is kept yet: the same ones."""
    expected = answer(graphs[-1])
    for kept in (registry.trees, registry.plans, registry.systems):
        kept.clear()
    together = Barrier(THREADS)

    def merged(graph):
        together.wait()
        return answer(graph)

    with ThreadPoolExecutor(THREADS) as pool:
        found = list(pool.map(merged, [graphs[-1]] * THREADS))
    for values in found:
        for one, other in zip(values, expected, strict=True):
            np.testing.assert_array_equal(one, other, strict=True)
