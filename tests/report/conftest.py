"""Merges whose pages are read: with a rival, in space, refused, of given closures."""

import dataclasses

import numpy as np
import pytest

import pcm_jax
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.report import page
from pcm_jax.simulation import simulate_city, simulate_sessions

WORLD = {"poses": 60, "inliers": 6, "aliased_groups": 1, "aliased_size": 3, "random": 11}
NAMES = "<script>alert(1)</script>", "\"'><img src=x onerror=alert(2)>&amp;"


@pytest.fixture(scope="session")
def world():
    return simulate_city(seed=0, **WORLD)


@pytest.fixture(scope="session")
def result(world):
    """Two robots joined by six of twenty closures, three others in a rival set."""
    return pcm_jax.merge(world.graph)


@pytest.fixture(scope="session")
def hostile(world):
    """The same with robots named by somebody who means ill."""
    maps = [
        dataclasses.replace(one, name=name)
        for one, name in zip(world.graph.maps, NAMES, strict=True)
    ]
    closures = dataclasses.replace(
        world.graph.closures, source=np.full(len(world.graph.closures), "</script>:3", object)
    )
    return pcm_jax.merge(MultiRobotGraph(tuple(maps), closures))


@pytest.fixture(scope="session")
def given(world):
    """The same by given closures: no evidence of who agrees with whom."""
    return pcm_jax.merge(world.graph, accepted=world.is_true)


@pytest.fixture(scope="session")
def refused():
    """Two robots whose closures are all wrong: two sets of four, one as good as the other."""
    false = {"inliers": 0, "aliased_groups": 2, "aliased_size": 4}
    return pcm_jax.merge(simulate_city(seed=5, **{**WORLD, **false}).graph)


@pytest.fixture(scope="session")
def spatial():
    """Two sessions in space."""
    return pcm_jax.merge(simulate_sessions(seed=1, **WORLD).graph)


@pytest.fixture(scope="session")
def document(result):
    return page(result, result.report())
