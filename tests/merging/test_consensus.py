"""The map as it grows judges closures that agree pair by pair: innovations, stretches, the end."""

import dataclasses
from typing import Any

import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.consistency import chi2_gate, odometry_edges
from pcm_jax.errors import InputError
from pcm_jax.graph import PoseGraph
from pcm_jax.mapping import optimize
from pcm_jax.merging._innovation import Innovation, innovation
from pcm_jax.merging.consensus import STRETCH, _stretches, _Way, consensus, fitting_edges
from pcm_jax.pipeline import select_within

TURN, TURNS = 20, 8
"""Poses of a turn of the helix, and its turns."""
ODOMETRY, CLOSURE = (0.2, 0.15), (0.05, 0.02)
"""Standard deviations, m and rad."""
CONFIDENCE = 0.99


def helix(seed=0, false=60, group=jaxlie.SE3):
    """A helix of 4 m about; each pose closes with that a turn before; false ones say any two meet.

    Returns the map at poses that odometry gives, which edges are right, and the true poses.
    """
    rng = np.random.default_rng(seed)
    count = TURN * TURNS
    angle = 2 * np.pi * np.arange(count) / TURN
    flat = group is jaxlie.SE2
    tangent: Any = np.zeros((count, lie.tangent_dim(group)))
    tangent[:, -1] = angle
    turned = lie.as_numpy(lie.exp(group, tangent))
    # The place is put by a matrix: from the exponential it would be off along the turn.
    matrix: Any = np.array(lie.as_matrix(turned))
    place = [2 * np.cos(angle), 2 * np.sin(angle), 0.05 * np.arange(count)][: 2 if flat else 3]
    matrix[:, : len(place), -1] = np.transpose(place)
    truth = lie.as_numpy(lie.from_matrix(matrix))
    tail = np.concatenate([np.arange(count - 1), np.arange(count - TURN)])
    head = np.concatenate([np.arange(1, count), np.arange(TURN, count)])
    first = np.sort(rng.choice(count - 30, false, replace=True))
    last = np.minimum(first + rng.integers(30, count, false), count - 1)
    right = lie.between(lie.take(truth, tail), lie.take(truth, head))
    wrong = lie.as_numpy(lie.identity(group, (false,)))
    sigma = np.where(np.arange(len(tail))[:, None] < count - 1, ODOMETRY, CLOSURE)
    sigma = np.concatenate([sigma, np.tile(CLOSURE, (false, 1))])
    space = len(place)
    scale = np.repeat(sigma, (space, lie.tangent_dim(group) - space), axis=1)
    drawn: Any = scale * rng.standard_normal(scale.shape)
    noise = lie.exp(group, drawn)
    measured = lie.compose(lie.concatenate([right, wrong]), lie.as_numpy(noise))
    graph = PoseGraph.from_arrays(
        tail=np.concatenate([tail, first]),
        head=np.concatenate([head, last]),
        measurement=measured,
        covariance=scale[:, :, None] ** 2 * np.eye(scale.shape[1]),
    )
    chain = optimize(graph.with_edges(odometry_edges(graph))).graph
    return graph.with_poses(chain.poses), np.arange(graph.num_edges) < len(tail), truth


def odometry_of(graph):
    return np.isin(np.arange(graph.num_edges), odometry_edges(graph))


def test_the_width_is_that_of_the_loop_alone(group):
    """Of the first closure, against odometry: R + J Σ Jᵀ by products of adjoints along the loop."""
    graph, _, _ = helix(false=0, group=group)
    used = odometry_of(graph)
    edge = np.flatnonzero(~used)[:1]
    judged = innovation(graph, used, edge)
    whitening = np.linalg.cholesky(np.asarray(graph.information)[edge[0]]).T
    own, dim = np.linalg.inv(np.asarray(graph.information)[edge[0]]), graph.tangent_dim
    total, poses = own.copy(), lie.as_numpy(graph.poses)
    end = int(graph.head[edge[0]])
    for step in range(int(graph.tail[edge[0]]), end):
        covariance = np.linalg.inv(np.asarray(graph.information)[step])
        back = lie.between(lie.take(poses, end), lie.take(poses, step + 1))
        adjoint = np.asarray(lie.adjoint(back))
        total += adjoint @ covariance @ adjoint.T
    expected = np.linalg.det(whitening @ total @ whitening.T) ** (1 / (2 * dim))
    assert judged.width[0] == pytest.approx(expected, rel=0.2)  # the residual turns it a little
    assert judged.squared[0] >= 0.0


def test_an_edge_in_the_map_is_judged_as_if_it_were_not(group):
    """Small errors, so that the optimum hardly moves with it."""
    graph, _, _ = helix(false=0, group=group)
    held = np.ones(graph.num_edges, bool)
    whole = optimize(graph).graph
    edge = np.flatnonzero(~odometry_of(graph))[40:41]
    without = held.copy()
    without[edge] = False
    apart = optimize(graph.with_edges(without)).graph
    inside = innovation(whole, held, edge)
    outside = innovation(whole.with_poses(apart.poses), without, edge)
    assert inside.width[0] == pytest.approx(outside.width[0], rel=0.02)
    assert inside.squared[0] == pytest.approx(outside.squared[0], rel=0.15)


def test_an_edge_that_holds_the_map_together_alone():
    """I − P is zero but for rounding, or to the last bit: no width, and there is no residual."""
    unit = lie.identity(jaxlie.SE2, (4,))
    chain = PoseGraph.from_arrays(
        poses=unit,
        tail=np.arange(3),
        head=np.arange(1, 4),
        measurement=lie.take(unit, slice(3)),
        information=np.broadcast_to(np.eye(3), (3, 3, 3)),
    )
    squared, width = innovation(chain, np.ones(3, bool), np.arange(3))
    np.testing.assert_array_equal(squared, np.zeros(3))
    assert (np.isnan(width) | (width > 1e6)).all() and np.isnan(width).any()
    assert len(innovation(chain, np.ones(3, bool), np.zeros(0, np.int64)).squared) == 0


def test_false_closures_that_agree_with_all_others_leave():
    """Odometry says little of where turns lie, the map of the right ones where all poses do."""
    graph, right, _ = helix(false=30)
    kinds = {"minimum_inliers": 2, "recall": False, "time_limit": 5.0}
    alone = select_within(graph, **kinds)
    assert (alone.kept & ~right).sum() > 5
    found = select_within(graph, recheck=True, **kinds)
    assert not (found.kept & ~right).any()
    assert (found.kept & right).sum() >= 0.97 * (alone.kept & right).sum()
    np.testing.assert_array_equal(found.dropped, alone.accepted & ~found.accepted)
    assert "dropped by recheck" in repr(found)
    assert not alone.dropped.any()


def test_errors_stated_three_times_too_large_let_no_false_closure_in():
    """Under these, false closures agree with nearly all; the right ones say how well all fit."""
    graph, right, _ = helix(false=30)
    information = np.asarray(graph.information) / 9.0
    loose = dataclasses.replace(graph, information=information)
    kinds = {"minimum_inliers": 2, "recall": False, "time_limit": 5.0}
    alone = select_within(loose, **kinds)
    assert (alone.kept & ~right).sum() > 15
    found = select_within(loose, recheck=True, **kinds)
    assert not (found.kept & ~right).any()
    assert (found.kept & right).sum() >= 0.97 * (alone.kept & right).sum()


def test_a_sensor_that_overstates_its_errors_drives_none_of_another_out():
    """Six in ten closures state errors ten times too large."""
    graph, _, _ = helix(false=0)
    closures = np.flatnonzero(~odometry_of(graph))
    loose = closures[np.random.default_rng(0).random(len(closures)) < 0.6]
    information = np.array(graph.information)
    information[loose] /= 100.0
    graph = dataclasses.replace(graph, information=information)
    kinds = {"minimum_inliers": 2, "recall": False, "time_limit": 5.0}
    alone, found = (select_within(graph, recheck=recheck, **kinds) for recheck in (False, True))
    np.testing.assert_array_equal(found.kept, alone.kept)


def test_a_closure_that_fits_worse_than_all_others_leaves_in_the_end():
    """Off by three deviations of its test as stated, which are nine of those that errors have."""
    graph, _, _ = helix(false=0)
    odometry = odometry_of(graph)
    edge = np.flatnonzero(~odometry)[70]
    off: Any = np.zeros(6)
    off[0] = 10.0 * ODOMETRY[0]
    parameters = np.array(lie.parameters(lie.as_numpy(graph.measurement)))
    one = lie.compose(lie.take(graph.measurement, edge), lie.exp(jaxlie.SE3, off))
    parameters[edge] = lie.parameters(lie.as_numpy(one))
    loose = dataclasses.replace(
        graph,
        measurement=jaxlie.SE3(parameters),  # pyright: ignore[reportArgumentType]
        information=np.asarray(graph.information) / 9.0,
    )
    held, asked = np.ones(graph.num_edges, bool), np.flatnonzero(~odometry)
    gate = float(chi2_gate(CONFIDENCE, 6))
    assert fitting_edges(loose, held, asked, gate).all()
    left = fitting_edges(loose, held, asked, gate, narrow=True)
    assert np.flatnonzero(~left).tolist() == [edge]
    kinds = {"minimum_inliers": 2, "recall": False, "time_limit": 5.0}
    assert select_within(loose, **kinds).kept[edge]
    assert not select_within(loose, recheck=True, **kinds).kept[edge]


def test_a_map_that_went_astray_starts_anew():
    """From poses in a heap no step leads to the map that all closures agree with."""
    graph, _, _ = helix(false=0)
    odometry = odometry_of(graph)
    way = _Way(graph, odometry, ~odometry, CONFIDENCE)
    here = way._up_to(graph.num_poses)
    drawn: Any = 50.0 * np.random.default_rng(0).standard_normal((graph.num_poses, 6))
    heap = lie.exp(jaxlie.SE3, drawn)
    astray = here._replace(graph=here.graph.with_poses(heap))
    assert way._with(astray, np.flatnonzero(~odometry)).used.all()


def test_a_stretch_of_false_ones_meets_the_gate_that_others_made(monkeypatch):
    graph, _, _ = helix(false=0)
    odometry = odometry_of(graph)
    way = _Way(graph, odometry, ~odometry, CONFIDENCE)

    def judged(graph, used, edges):
        return Innovation(np.full(len(edges), value), np.ones(len(edges)))

    def believing(self, here, entering):
        used = here.used.copy()
        used[entering] = True
        return here._replace(used=used)

    monkeypatch.setattr("pcm_jax.merging.consensus.innovation", judged)
    monkeypatch.setattr(_Way, "_with", believing)
    value, half = 0.01, graph.num_poses // 2
    way.go(half)
    so_far = way.used & ~odometry
    assert so_far.sum() > 20
    value = 5.0
    way.go(half + 10)
    assert (way.used & ~odometry).sum() == so_far.sum()


def test_the_order_of_edges_decides_nothing():
    graph, _, _ = helix(false=25)
    odometry = odometry_of(graph)
    found, _ = consensus(graph, odometry, ~odometry, confidence=CONFIDENCE)
    order = np.random.default_rng(1).permutation(graph.num_edges)
    other = graph.with_edges(order)
    again, _ = consensus(other, odometry[order], ~odometry[order], confidence=CONFIDENCE)
    np.testing.assert_array_equal(again, found[order])


def test_each_closure_that_stays_fits_the_map_of_the_others():
    graph, right, _ = helix(seed=0, false=30)
    odometry = odometry_of(graph)
    used, grown = consensus(graph, odometry, ~odometry, confidence=CONFIDENCE)
    gate = float(chi2_gate(CONFIDENCE, graph.tangent_dim))
    asked = np.flatnonzero(~odometry)
    held = fitting_edges(grown, used, asked, gate, initial="chordal")
    solved = optimize(grown.with_edges(held), initial="given").graph
    squared = innovation(grown.with_poses(solved.poses), held, asked).squared
    np.testing.assert_array_equal(squared <= gate, held[asked])
    assert not (held & ~right).any()


@pytest.mark.parametrize("count", [1, 149, 301, 2000])
def test_stretches_end_with_the_map_and_share_the_closures(count):
    late = np.sort(np.random.default_rng(count).integers(5, 400, count))
    ends = _stretches(late, 400)
    assert ends[-1] == 400
    assert ends == sorted(set(ends))
    counts = np.diff(np.searchsorted(late, [0, *ends]))
    assert counts.sum() == count
    assert counts.max() <= 2 * STRETCH


def test_a_word_is_no_choice():
    graph, _, _ = helix(false=0)
    with pytest.raises(InputError, match="recheck: 'yes', expected True or False"):
        select_within(graph, recheck="yes")  # pyright: ignore[reportArgumentType]
