"""Worlds of different sizes filled up to one."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures, MultiRobotGraph, pad_graph

SIZES = {"poses": 15, "edges": 20, "closures": 4}


@pytest.fixture
def graph(make_graph, group):
    d = lie.tangent_dim(group)
    closures = LoopClosures.from_arrays(
        robot_a=[0],
        pose_a=[3],
        robot_b=[1],
        pose_b=[5],
        measurement=lie.exp(group, np.full((1, d), 0.3)),
        information=2.0 * np.eye(d)[None],
    )
    return MultiRobotGraph((make_graph(group), make_graph(group)), closures)


def test_what_was_there_stays_and_what_is_added_says_nothing(graph):
    padded = pad_graph(graph, **SIZES)
    for own, longer in zip(
        (*graph.maps, graph.closures), (*padded.maps, padded.closures), strict=True
    ):
        for one, other in zip(jax.tree.leaves(own), jax.tree.leaves(longer), strict=True):
            np.testing.assert_array_equal(one, other[: len(one)])
            assert one.dtype == other.dtype
        assert not np.any(longer.information[len(own.information) :])
    assert [one.num_poses for one in padded.maps] == [15, 15]
    assert [one.num_edges for one in padded.maps] == [20, 20]
    assert len(padded.closures) == 4


def test_worlds_of_one_size_stack(graph):
    longer = pad_graph(graph, **SIZES)
    stack = jax.tree.map(lambda *x: jnp.stack(x), longer, longer)
    assert stack.maps[0].tail.shape == (2, 20)


@pytest.mark.parametrize("name", SIZES)
def test_what_does_not_fit_is_refused(graph, name):
    with pytest.raises(InputError, match=f"{name}: .* has .*, expected at most the 0 given"):
        pad_graph(graph, **(SIZES | {name: 0}))


def test_none_at_all(make_graph):
    own = make_graph(jaxlie.SE2)
    sizes = {"poses": own.num_poses, "edges": own.num_edges, "closures": 2}
    assert len(pad_graph(MultiRobotGraph((own,)), **sizes).closures) == 2
