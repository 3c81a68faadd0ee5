"""`IncrementalWithin`: the answer of `select_within` at every step, what it refuses and keeps."""

from __future__ import annotations

import dataclasses
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from online_worlds import begun

import pcm_jax
from pcm_jax import lie
from pcm_jax.consistency import odometry_edges
from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files import read_graph
from pcm_jax.graph import PoseGraph
from pcm_jax.online import IncrementalPcm, IncrementalWithin, _held_within
from pcm_jax.pipeline import select_within
from pcm_jax.pipeline.within_trials import Trials
from pcm_jax.simulation import simulate_city

KITTI = "kitti_robust/00/kitti_00_alpha_1.00.g2o.xz"


def world(seed=3, poses=60, right=14, wrong=12, sure=1.0):
    """A map with right closures and wrong ones, some of which agree; odometry first."""
    made = simulate_city(seed=seed, poses=poses)
    one, truth, generator = made.graph.maps[0], made.truth[0], np.random.default_rng(seed)
    odometry = odometry_edges(one)
    tail, head = np.sort(generator.integers(0, poses, (2, 400)), axis=0)
    apart = np.flatnonzero(head - tail > 8)[: right + wrong]
    tail, head = tail[apart], head[apart]
    exact = lie.between(lie.take(truth, tail), lie.take(truth, head))
    spread: Any = generator.normal(0.0, 0.02, (len(tail), 3))
    noise = lie.exp(one.group, spread)
    shift: Any = np.zeros((len(tail), 3))
    shift[right : right + wrong // 2] = (1.5, -1.0, 0.4)
    shift[right + wrong // 2 :] = generator.uniform(-4.0, 4.0, (wrong - wrong // 2, 3))
    measured = lie.compose(lie.compose(exact, lie.exp(one.group, shift)), noise)
    order = generator.permutation(len(tail))
    information = np.asarray(one.information)
    factor = np.append(np.full(len(odometry), sure**2), np.ones(len(tail)))[:, None, None]
    steps = lie.take(lie.as_numpy(one.measurement), odometry)
    return PoseGraph.from_arrays(
        poses=truth,
        tail=np.append(np.asarray(one.tail)[odometry], tail[order]),
        head=np.append(np.asarray(one.head)[odometry], head[order]),
        measurement=lie.concatenate([steps, lie.take(measured, order)]),
        information=factor
        * np.concatenate([information[odometry], np.tile(2000.0 * np.eye(3), (len(tail), 1, 1))]),
        name="carol",
        source=[f"edge {row}" for row in range(len(odometry) + len(tail))],
    )


def edges(graph, rows):
    """What `add` and `extend` are told of some edges."""
    return {
        "tail": np.asarray(graph.tail)[rows],
        "head": np.asarray(graph.head)[rows],
        "measurement": lie.take(lie.as_numpy(graph.measurement), rows),
        "information": np.asarray(graph.information)[rows],
    }


def turned(part):
    """The same edges, said from the other end."""
    inverse = lie.inverse(part["measurement"])
    back = np.asarray(lie.adjoint(inverse))
    return {
        "tail": part["head"],
        "head": part["tail"],
        "measurement": inverse,
        "information": back.swapaxes(1, 2) @ part["information"] @ back,
    }


def loops_of(graph):
    return np.setdiff1d(np.arange(graph.num_edges), odometry_edges(graph))


def alone(graph):
    return graph.with_edges(odometry_edges(graph))


def streamed(graph, **options):
    """The closures of a map, one by one."""
    online = IncrementalWithin(alone(graph), **options)
    for step, row in enumerate(loops_of(graph).tolist()):
        assert online.add(**edges(graph, [row]), source=graph.source[[row]]).tolist() == [step]
    return online


def assert_same_answer(one, other):
    for name in ("kept", "odometry", "closures", "accepted", "recalled"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    for name in ("gate", "optimal", "upper_bound", "odometry_scale"):
        assert getattr(one, name) == getattr(other, name)
    np.testing.assert_allclose(one.squared, other.squared, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(one.own_squared, other.own_squared, rtol=1e-9, atol=1e-9)
    assert (one.verdict.why, one.verdict.believed) == (other.verdict.why, other.verdict.believed)
    assert (one.verdict.found, one.verdict.places) == (other.verdict.found, other.verdict.places)
    assert one.graph.num_edges == other.graph.num_edges


@pytest.fixture(scope="module")
def graph():
    return world()


def test_the_public_name():
    assert pcm_jax.IncrementalWithin is IncrementalWithin


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"own_loop": False},
        {"odometry_scale": 2.0, "separation": 2.0},
        {"minimum_inliers": 3, "confidence": 0.9, "recall": True},
        {"method": "pcm-heuristic", "seed": 3},
        {"tie_break": "distance"},
        {"recheck": True},
        {"method": lambda evidence, gate: evidence.consistent(gate).sum(axis=1) > 4},
    ],
)
def test_ends_with_the_batch(graph, options):
    online, batch = streamed(graph, **options), select_within(graph, **options)
    assert batch.accepted.any() and not batch.accepted.all()
    assert_same_answer(online.result(), batch)
    assert online.result() is online.result()
    np.testing.assert_array_equal(online.graph.source, graph.source)


def test_odometry_that_is_too_sure_is_found_out():
    sure = world(sure=12.0)
    online, batch = streamed(sure), select_within(sure)
    assert batch.odometry_scale > 1.0
    assert_same_answer(online.result(), batch)
    online.remove([5])
    assert_same_answer(online.result(), select_within(online.graph))
    online.add(**edges(sure, loops_of(sure)[[5]]))
    assert_same_answer(online.result(), select_within(online.graph))


def test_a_whole_drive(graph):
    """From one pose: odometry by odometry, each closure as soon as its later pose is there."""
    online = IncrementalWithin(begun(graph, 1))
    last = np.maximum(graph.tail, graph.head)
    steps = odometry_edges(graph)
    for pose in range(1, graph.num_poses):
        assert len(online.extend(**edges(graph, steps[[pose - 1]]))) == 0
        rows = np.setdiff1d(np.flatnonzero(last == pose), steps)
        if len(rows):
            assert (online.add(**edges(graph, rows)) >= 0).all()
        if pose % 12 == 0:
            assert_same_answer(online.result(), select_within(online.graph))
    assert online.graph.num_edges == graph.num_edges
    assert_same_answer(online.result(), select_within(online.graph))


def test_distances_are_not_found_anew(graph, monkeypatch):
    online = streamed(graph)
    monkeypatch.setattr(Trials, "distances", pytest.fail)
    assert online.result().accepted.any()
    online.add(**edges(graph, loops_of(graph)[[0]]))
    assert online.result().accepted.any()


def test_many_at_once_and_one_by_one_are_the_same(graph, monkeypatch):
    monkeypatch.setattr(_held_within, "MANY", 5)
    online = IncrementalWithin(alone(graph))
    rows = loops_of(graph)
    online.add(**edges(graph, rows[:20]))
    assert_same_answer(online.result(), select_within(online.graph))
    online.add(**edges(graph, rows[20:23]))
    online.remove(np.arange(7))
    assert_same_answer(online.result(), select_within(online.graph))


def test_a_closure_that_is_stated_again_counts_once(graph):
    online = streamed(graph)
    count, again = len(online), edges(graph, loops_of(graph)[[4]])
    assert online.add(**again).tolist() == online.add(**turned(again)).tolist() == [4]
    assert (len(online), online.repeated) == (count, 2)


def test_a_closure_waits_for_its_pose(graph):
    online = IncrementalWithin(begun(graph, 40))
    rows = loops_of(graph)
    early = rows[np.maximum(graph.tail, graph.head)[rows] == 41]
    beside = rows[np.maximum(graph.tail, graph.head)[rows] > 50][:1]
    assert len(early) and len(beside)
    assert (online.add(**edges(graph, np.append(early, beside))) == -1).all()
    assert online.add(**edges(graph, early)).tolist() == [-1] * len(early)
    assert online.waiting.tolist()[-1] == [graph.tail[beside[0]], graph.head[beside[0]]]
    steps, held = odometry_edges(graph), len(online)
    assert len(online.extend(**edges(graph, steps[39:40]))) == 0
    entered = online.extend(**edges(graph, steps[40:41]))
    np.testing.assert_array_equal(entered, held + np.arange(len(early)))
    assert (len(online.waiting), online.repeated) == (1, len(early))
    assert_same_answer(online.result(), select_within(online.graph))


def test_saved_and_loaded_it_goes_on(graph, tmp_path):
    online = IncrementalWithin(begun(graph, 50), seed=2)
    rows = loops_of(graph)
    online.add(**edges(graph, rows[:18]), source=graph.source[rows[:18]])
    online.save(tmp_path / "state.npz")
    other = IncrementalWithin.load(tmp_path / "state.npz")
    np.testing.assert_array_equal(other.waiting, online.waiting)
    assert len(other.waiting) and repr(other) == repr(online)
    held = edges(graph, [int(np.flatnonzero(graph.source == online.graph.source[-1])[0])])
    assert other.add(**held).tolist() == online.add(**held).tolist() == [len(online) - 1]
    for each in (online, other):
        each.extend(**edges(graph, odometry_edges(graph)[49:]))
        each.add(**edges(graph, rows[17:]))
    assert (len(other), other.repeated) == (len(online), online.repeated)
    assert_same_answer(other.result(), online.result())
    with pytest.raises(FileFormatError, match="a state of IncrementalWithin, expected one of Incr"):
        IncrementalPcm.load(tmp_path / "state.npz")


REFUSED = {
    "robot's own pose": (lambda o, e: o.add(**e | {"head": e["tail"]}), "to itself"),
    "negative": (lambda o, e: o.add(**e | {"head": [-1]}), r"head\[0\]"),
    "count": (lambda o, e: o.add(**e | {"tail": [1, 2]}), "tail: 2 entries given, expected 1"),
    "group": (
        lambda o, e: o.add(**e | {"measurement": np.eye(4)[None]}),
        "measurement: SE3 given, expected SE2 like the map",
    ),
    "information": (lambda o, e: o.add(**e | {"information": -e["information"]}), "information"),
    "full": (
        lambda o, e: [o.add(**e | {"head": [90 + k]}) for k in range(2)],
        "closures: 2 would wait",
    ),
    "no odometry": (lambda o, e: o.extend(**e), "closures come by add"),
    "apart": (lambda o, e: o.extend(**e | {"tail": [98], "head": [99]}), "pose"),
    "index": (lambda o, e: o.remove([99]), "indices: 99 given"),
    "option": (lambda o, e: IncrementalWithin(o.graph, speed=3), "speed: not an option"),
    "broken": (lambda o, e: IncrementalWithin(begun(o.graph, 9).with_edges([0])), "no edge joins"),
}


@pytest.mark.parametrize("case", sorted(REFUSED))
def test_what_is_refused_changes_nothing(graph, case):
    online = IncrementalWithin(alone(graph), most_waiting=1)
    some = edges(graph, loops_of(graph)[:8])
    online.add(**some)
    before = online.result()
    call, message = REFUSED[case]
    with pytest.raises(InputError, match=message):
        call(online, edges(graph, loops_of(graph)[[9]]))
    assert (len(online), online.repeated) == (8, 0)
    assert_same_answer(online.result(), before)


@pytest.mark.slow
def test_a_real_drive(shared_data):
    given = read_graph(shared_data / KITTI).maps[0]
    online = IncrementalWithin(given)
    batch = select_within(online.graph)
    assert_same_answer(online.result(), batch)
    assert batch.accepted.sum() > 100


WORLDS = {"plain": world(), "too sure": world(seed=5, sure=12.0)}
OPTIONS = (
    {},
    {"minimum_inliers": 3, "confidence": 0.9},
    {"own_loop": False},
    {"significance": 0.2, "seed": 4, "separation": 1.0},
    {"method": "pcm-heuristic"},
)


class Steps(RuleBasedStateMachine):
    """Runs steps on `IncrementalWithin` and on plain lists, and compares."""

    @initialize(
        name=st.sampled_from(sorted(WORLDS)), options=st.sampled_from(OPTIONS), data=st.data()
    )
    def begin(self, name, options, data):
        self.world, self.options, self.count = WORLDS[name], options, 35
        self.rows = loops_of(self.world)
        self.held, self.waits = [], []
        self.online = IncrementalWithin(begun(alone(self.world), self.count), **options)
        self.add_some(data)

    def has_poses(self, row):
        return max(self.world.tail[row], self.world.head[row]) < self.count

    @rule(data=st.data())
    def add_some(self, data):
        some = data.draw(st.lists(st.sampled_from(self.rows.tolist()), min_size=1, max_size=9))
        part = edges(self.world, some)
        found = self.online.add(**(turned(part) if data.draw(st.booleans()) else part))
        for row, index in zip(some, found.tolist(), strict=True):
            if row in self.held:
                assert index == self.held.index(row)
            elif self.has_poses(row):
                assert index == len(self.held)
                self.held.append(row)
            else:
                assert index == -1
                self.waits += [row] * (row not in self.waits)

    @precondition(lambda self: self.held)
    @rule(data=st.data())
    def remove_some(self, data):
        rows = data.draw(
            st.lists(st.integers(0, len(self.held) - 1), min_size=1, max_size=4, unique=True)
        )
        self.online.remove(rows)
        self.held = [one for row, one in enumerate(self.held) if row not in rows]

    @rule(steps=st.integers(1, 6))
    def extend(self, steps):
        steps = min(steps, self.world.num_poses - self.count)
        if steps:
            rows = odometry_edges(self.world)[self.count - 1 : self.count - 1 + steps]
            self.count += steps
            entered = self.online.extend(**edges(self.world, rows))
            came = [row for row in self.waits if self.has_poses(row)]
            np.testing.assert_array_equal(entered, len(self.held) + np.arange(len(came)))
            self.held += came
            self.waits = [row for row in self.waits if row not in came]

    @rule()
    def save_and_load(self):
        with tempfile.TemporaryDirectory() as folder:
            self.online.save(Path(folder, "state.npz"))
            self.online = IncrementalWithin.load(Path(folder, "state.npz"))

    @precondition(lambda self: hasattr(self, "online"))
    @invariant()
    def equal(self):
        begun_now = begun(alone(self.world), self.count)
        parts = [begun_now, self.world.with_edges(np.array(self.held, int))]
        model = dataclasses.replace(
            begun_now,
            tail=np.concatenate([part.tail for part in parts]),
            head=np.concatenate([part.head for part in parts]),
            measurement=lie.concatenate([lie.as_numpy(part.measurement) for part in parts]),
            information=np.concatenate([part.information for part in parts]),
            source=np.concatenate([part.source for part in parts]),
        )
        assert len(self.online.waiting) == len(self.waits)
        found = self.online.result()
        # Closures that came turned lie so in the map that is asked, and are judged alike.
        assert_same_answer(found, select_within(self.online.graph, **self.options))
        np.testing.assert_array_equal(found.accepted, select_within(model, **self.options).accepted)


EXAMPLES = int(os.environ.get("PCM_JAX_ONLINE_EXAMPLES", "10"))
Steps.TestCase.settings = settings(
    max_examples=EXAMPLES,
    stateful_step_count=10,
    phases=(Phase.explicit, Phase.generate),
    database=None,
    deadline=None,
    derandomize="PCM_JAX_ONLINE_EXAMPLES" not in os.environ,
    suppress_health_check=(HealthCheck.too_slow, HealthCheck.data_too_large),
)
TestSteps = Steps.TestCase
TestSteps.pytestmark = [pytest.mark.slow]  # type: ignore[attr-defined]
