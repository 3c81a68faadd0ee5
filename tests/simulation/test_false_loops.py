"""The four laws of false loop closures inside one map."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.stats import kstest

from pcm_jax import lie
from pcm_jax.consistency import odometry_edges
from pcm_jax.errors import InputError
from pcm_jax.simulation import LAWS, add_false_loops, simulate_city, simulate_sessions


@pytest.fixture(scope="module")
def graph():
    return simulate_city(seed=3, poses=200).graph.maps[0]


def closures(graph):
    return graph.num_edges - graph.num_poses + 1


def added(graph, **options):
    """Ends and measurements of the false closures."""
    spoiled = add_false_loops(graph, **options)
    rows = np.flatnonzero(~spoiled.is_true)
    np.testing.assert_array_equal(rows, np.arange(graph.num_edges, spoiled.graph.num_edges))
    measured = np.asarray(lie.log(lie.take(spoiled.graph.measurement, rows)))
    return spoiled.graph.tail[rows], spoiled.graph.head[rows], measured


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5])
def test_as_many_as_the_share_of_the_maps_own(graph, law, share):
    tail, head, _ = added(graph, share=share, law=law)
    assert len(tail) == round(share * closures(graph))
    assert (head - tail >= 2).all() and tail.min(initial=0) >= 0
    assert head.max(initial=0) < graph.num_poses


def test_the_maps_own_edges_stay(graph):
    spoiled = add_false_loops(graph, share=0.3)
    own = spoiled.graph.with_edges(spoiled.is_true)
    for name in ("tail", "head", "information", "source"):
        np.testing.assert_array_equal(getattr(own, name), getattr(graph, name))
    np.testing.assert_array_equal(odometry_edges(spoiled.graph), odometry_edges(graph))
    given = {row.tobytes() for row in np.asarray(graph.information)}
    assert {row.tobytes() for row in np.asarray(spoiled.graph.information)} <= given


def test_random_pairs_are_uniform(graph):
    """Of a pair drawn from all, the gap g has (n − g) ways; the start is uniform given the gap."""
    tail, head, measured = added(graph, share=20.0, law="random", seed=1)
    n, gap = graph.num_poses, head - tail
    below = lambda g: 1.0 - (n - g) * (n - 1.0 - g) / ((n - 2.0) * (n - 1.0))  # noqa: E731
    smeared = gap - np.random.default_rng(0).random(len(gap))
    assert kstest(smeared, below).pvalue > 1e-3
    smeared = (tail + np.random.default_rng(1).random(len(tail))) / (n - gap)
    assert kstest(smeared, "uniform").pvalue > 1e-3
    for axis, sigma in enumerate((0.3, 0.3, 0.17)):
        assert kstest(measured[:, axis] / sigma, "norm").pvalue > 1e-3


def test_local_ones_reach_a_few_steps(graph):
    tail, head, _ = added(graph, share=5.0, law="local", reach=6)
    assert sorted(set(head - tail)) == [2, 3, 4, 5, 6]


@pytest.mark.parametrize("law", ["grouped", "local-grouped"])
def test_a_group_says_the_same_of_poses_in_a_row(graph, law):
    tail, head, measured = added(graph, share=1.0, law=law, group_size=7, reach=9)
    whole = len(tail) // 7 * 7
    for ends in (tail, head):
        rows = ends[:whole].reshape(-1, 7)
        np.testing.assert_array_equal(rows - rows[:, :1], np.tile(np.arange(7), (len(rows), 1)))
    groups = measured[:whole].reshape(-1, 7, 3)
    np.testing.assert_array_equal(groups, np.repeat(groups[:, :1], 7, axis=1))
    assert len(np.unique(groups[:, 0, 0])) == len(groups)
    assert ((head - tail).max() <= 9) == (law == "local-grouped")


def test_in_space_and_by_the_seed():
    one = simulate_sessions(seed=1, poses=80, sessions=2).graph.maps[0]
    looped = add_false_loops_to_chain(one)
    first, again, other = (added(looped, share=1.0, seed=seed)[2] for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert first.shape[1] == 6 and not np.array_equal(first, other)


def add_false_loops_to_chain(chain):
    """A chain has no closure that a share could be taken of: two are put there by hand."""
    return dataclasses.replace(
        chain,
        tail=np.append(chain.tail, [0, 3]),
        head=np.append(chain.head, [40, 70]),
        measurement=lie.concatenate(
            [lie.as_numpy(chain.measurement), lie.take(chain.measurement, np.arange(2))]
        ),
        information=np.concatenate([chain.information, chain.information[:2]]),
        source=np.append(chain.source, ["", ""]),
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"law": "clustered"}, "law: 'clustered', expected one of random, grouped, local"),
        ({"share": -0.1}, "share: -0.1"),
        ({"group_size": 0}, "group_size: 0"),
        ({"reach": 1}, "reach: 1"),
        ({"sigma_rotation": -1.0}, "sigma_rotation: -1"),
        ({"law": "grouped", "group_size": 199}, "group_size: 199 given, expected less"),
    ],
)
def test_bad_arguments_are_named(graph, options, message):
    with pytest.raises(InputError, match=message):
        add_false_loops(graph, **{"share": 0.5} | options)


def test_a_map_without_a_closure_is_refused(graph):
    with pytest.raises(InputError, match="no closure given"):
        add_false_loops(graph.with_edges(odometry_edges(graph)), share=0.5)
