"""Answers that do not flicker, and the log of what entered and left them."""

from __future__ import annotations

import dataclasses
from typing import Any

import jaxlie
import numpy as np
import pytest
from online_worlds import without_closures

from pcm_jax import lie
from pcm_jax.consistency import odometry_edges
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures, PoseGraph
from pcm_jax.online import IncrementalPcm, IncrementalWithin
from pcm_jax.online._steady import Change, changes, steadied
from pcm_jax.pipeline import select
from pcm_jax.selection import Choice
from pcm_jax.simulation import simulate_city

RULE = {"minimum_inliers": 2, "confidence": 0.99}


def cliques(*sizes):
    """Disjoint cliques of some sizes, one after another."""
    of = np.repeat(np.arange(len(sizes)), sizes)
    return (of[:, None] == of) & ~np.eye(len(of), dtype=bool)


def mask(count, rows):
    found = np.zeros(count, bool)
    found[rows] = True
    return found


@pytest.mark.parametrize(("hysteresis", "stays"), [(0.0, False), (1.0, False), (2.0, True)])
def test_a_set_gives_way_only_to_one_that_is_clearly_better(hysteresis, stays):
    agree, ones = cliques(3, 5), np.ones(8)
    best = Choice(mask(8, slice(3, 8)), True, 5)
    found = steadied(best, agree, mask(8, [0, 1, 2]), hysteresis, ones)
    if not stays:
        assert found is best
        return
    np.testing.assert_array_equal(found.members, mask(8, [0, 1, 2]))
    assert (found.optimal, found.upper_bound, found.weight) == (False, 5, None)


def test_what_has_come_and_agrees_with_all_is_added():
    agree, ones = cliques(4, 5), np.ones(9)
    best = Choice(mask(9, slice(4, 9)), True, 5)
    found = steadied(best, agree, mask(9, [0, 1]), 1.0, ones)
    np.testing.assert_array_equal(found.members, mask(9, slice(0, 4)))
    agree[3, 2] = agree[2, 3] = False  # of two that disagree the earlier one
    assert steadied(best, agree, mask(9, [0, 1]), 1.0, ones) is best
    found = steadied(best, agree, mask(9, [0, 1]), 2.0, ones)
    np.testing.assert_array_equal(found.members, mask(9, [0, 1, 2]))


def test_a_set_that_is_none_any_more_goes():
    agree = cliques(3, 3)
    agree[0, 1] = agree[1, 0] = False
    best = Choice(mask(6, slice(3, 6)), True, 3)
    assert steadied(best, agree, mask(6, [0, 1, 2]), 9.0, np.ones(6)) is best
    assert steadied(best, agree, np.zeros(6, bool), 9.0, np.ones(6)) is best


def test_the_same_set_keeps_its_proof():
    agree, best = cliques(4), Choice(np.ones(4, bool), True, 4)
    found = steadied(best, agree, mask(4, [0, 1]), 1.0, np.ones(4))
    assert found.members.all() and found.optimal


def test_weights_decide_by_weight():
    agree, weight = cliques(2, 3), np.array([5.0, 5.0, 4.0, 4.0, 4.0])
    best = Choice(mask(5, slice(2, 5)), True, 3, 12.0, 12.0)
    found = steadied(best, agree, mask(5, [0]), 2.0, weight)
    np.testing.assert_array_equal(found.members, mask(5, [0, 1]))
    assert (found.weight, found.weight_bound) == (10.0, 12.0)
    assert steadied(best, agree, mask(5, [0]), 1.9, weight) is best
    weight[1] = 0.0
    assert steadied(best, agree, mask(5, [0]), 7.0, weight).members.tolist()[:2] == [True, False]


def test_reasons():
    agree = cliques(3, 2)
    agree[2, 3] = agree[3, 2] = True
    before, now = mask(5, [3, 4]), mask(5, [0, 1, 2])
    found = list(changes(before, now, agree, "3 found"))
    assert found == [
        (0, "entered", "agrees with 2 of the 2 others"),
        (1, "entered", "agrees with 2 of the 2 others"),
        (2, "entered", "agrees with 2 of the 2 others"),
        (3, "left", "disagrees with 2 of the 3 believed now"),
        (4, "left", "disagrees with 3 of the 3 believed now"),
    ]
    none = np.zeros(5, bool)
    assert next(changes(before, none, agree, "by chance"))[2] == (
        "none is believed any more: by chance"
    )
    agree[3, :3] = agree[:3, 3] = True
    assert "is not of the set chosen" in list(changes(before, now, agree, ""))[3][2]
    contradicted = list(changes(before, now, agree, "", mask(5, [3])))[3]
    assert contradicted == (3, "left", "the map of the 3 believed now contradicts it")


@pytest.fixture(scope="module")
def graph():
    """Two robots whose closures are 4 that agree and, behind them, 6 others that agree."""
    made = simulate_city(seed=2, poses=60, inliers=6, aliased_groups=1, aliased_size=4, random=0)
    order = np.argsort(made.is_true, kind="stable")
    assert not made.is_true[order[:4]].any()
    return dataclasses.replace(made.graph, closures=made.graph.closures[order])


def streamed(graph, **options):
    """The answers after each closure."""
    online = IncrementalPcm(without_closures(graph), **RULE, **options)
    answers = []
    for row in range(len(graph.closures)):
        online.add(graph.closures[[row]])
        answers.append(np.flatnonzero(online.result().accepted).tolist())
    return online, answers


def test_what_was_accepted_leaves_as_evidence_grows(graph):
    online, answers = streamed(graph)
    assert answers[3] == [0, 1, 2, 3] and answers[9] == [4, 5, 6, 7, 8, 9]
    left = [change for change in online.log if change.event == "left"]
    assert sorted(change.closure for change in left) == [0, 1, 2, 3]
    assert {change.why for change in left} == {"disagrees with 5 of the 5 believed now"}
    assert {change.step for change in left} == {9}
    names = [graph.maps[0].pose_name(int(graph.closures.pose_a[0]))]
    names.append(graph.maps[1].pose_name(int(graph.closures.pose_b[0])))
    first = online.log[0]
    assert (first.closure, first.event, first.a, first.b) == (0, "entered", *names)
    assert str(first) == f"step 2: {names[0]} – {names[1]} entered: agrees with 1 of the 1 others"
    assert len(online.log) == 4 + 4 + 6


@pytest.mark.parametrize("hysteresis", [1, 2])
def test_hysteresis_holds_an_answer(graph, hysteresis):
    online, answers = streamed(graph, hysteresis=hysteresis)
    gives_way = 4 + 4 + hysteresis
    assert answers[gives_way - 1] == [0, 1, 2, 3]
    if hysteresis == 1:
        assert answers[9] == [4, 5, 6, 7, 8, 9]
        return
    assert answers[9] == [0, 1, 2, 3]
    pair = online.result().pairs[0]
    assert (pair.optimal, pair.upper_bound) == (False, 6)
    batch = select(graph, **RULE)
    assert batch.accepted.sum() == 6


def test_the_log_and_the_last_answer_are_saved(graph, tmp_path):
    online, _ = streamed(dataclasses.replace(graph, closures=graph.closures[:4]), hysteresis=2)
    online.save(tmp_path / "state.npz")
    other = IncrementalPcm.load(tmp_path / "state.npz")
    assert other.log == online.log and isinstance(other.log[0], Change)
    other.add(graph.closures[4:])
    assert np.flatnonzero(other.result().accepted).tolist() == [0, 1, 2, 3]
    other.remove([1])
    assert len(other.log) == len(online.log)
    assert np.flatnonzero(other.result().accepted).tolist() == [3, 4, 5, 6, 7, 8]
    assert {change.closure for change in other.log if change.event == "left"} == {0, 1, 2}


def test_a_loop_in_a_map_may_put_closures_out(graph):
    """A map that changes moves distances: what does not agree any more is told to leave."""
    online, _ = streamed(graph)
    one = graph.maps[0]
    turn: Any = np.tile([0.0, 0.0, 0.05], (one.num_edges, 1))
    bent = lie.compose(lie.as_numpy(one.measurement), lie.exp(one.group, turn))
    online.replace_maps([dataclasses.replace(one, measurement=bent), online.graph.maps[1]])
    batch = select(online.graph, **RULE)
    np.testing.assert_array_equal(online.result().accepted, batch.accepted)
    left = {change.closure for change in online.log if change.step == 11}
    assert left and left == set(np.flatnonzero(batch.accepted != select(graph, **RULE).accepted))


def ring():
    """A drive round a ring twice, and closures: 3 of one mistake, then 5 right ones."""
    angle = np.linspace(0.0, 4.0 * np.pi, 41)
    round_it: Any = np.stack(
        [np.cos(angle), np.sin(angle), 10.0 * np.cos(angle), 10.0 * np.sin(angle)], axis=1
    )
    truth = jaxlie.SE2(round_it)
    tail = np.array([3, 4, 5, 0, 1, 2, 6, 7])
    head = tail + 20
    wrong: Any = np.zeros((8, 3))
    wrong[:3] = (0.7, 0.45, 0.0)
    closing = lie.compose(
        lie.between(lie.take(truth, tail), lie.take(truth, head)),
        lie.exp(jaxlie.SE2, wrong),
    )
    steps = lie.between(lie.take(truth, np.arange(40)), lie.take(truth, np.arange(1, 41)))
    scale = np.append(np.full(40, 200.0), np.full(8, 5000.0))
    return PoseGraph.from_arrays(
        poses=truth,
        tail=np.append(np.arange(40), tail),
        head=np.append(np.arange(1, 41), head),
        measurement=lie.concatenate([steps, closing]),
        information=scale[:, None, None] * np.eye(3),
        name="r",
    )


@pytest.mark.parametrize("hysteresis", [0, 9])
def test_one_robot_likewise(hysteresis, tmp_path):
    graph = ring()
    online = IncrementalWithin(
        graph.with_edges(odometry_edges(graph)), hysteresis=hysteresis, minimum_inliers=2
    )
    answers = []
    for row in range(40, 48):
        online.add(
            graph.tail[[row]],
            graph.head[[row]],
            measurement=lie.take(graph.measurement, np.array([row])),
            information=np.asarray(graph.information)[[row]],
        )
        answers.append(np.flatnonzero(online.result().accepted).tolist())
        online.save(tmp_path / "state.npz")
        online = IncrementalWithin.load(tmp_path / "state.npz")
    assert answers[2] == [0, 1, 2]
    left = [change for change in online.log if change.event == "left"]
    if hysteresis:
        assert answers[7] == [0, 1, 2, 7] and not left  # the last one agrees with the three
        return
    assert answers[7] == [3, 4, 5, 6, 7]
    assert sorted(change.closure for change in left) == [0, 1, 2]
    assert (left[0].a, left[0].b) == ("r3", "r23")
    online.remove([0])
    assert np.flatnonzero(online.result().accepted).tolist() == [2, 3, 4, 5, 6]


@pytest.mark.parametrize("hysteresis", [-1, np.nan, "two"])
def test_a_hysteresis_that_cannot_be_meant(graph, hysteresis):
    with pytest.raises(InputError, match="hysteresis"):
        IncrementalPcm(graph, hysteresis=hysteresis)
    with pytest.raises(InputError, match="hysteresis"):
        IncrementalWithin(graph.maps[0], hysteresis=hysteresis)


def test_closures_that_go_take_their_mark_along(graph):
    online, _ = streamed(graph)
    before = len(online.log)
    online.remove(np.arange(4))
    assert online.result().accepted.all() and len(online.log) == before
    online.add(LoopClosures.empty(graph.group))
    assert online.result().accepted.all() and len(online.log) == before
