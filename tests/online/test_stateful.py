"""Random sequences of steps: after each the answer is that of the batch, or nothing has changed."""

from __future__ import annotations

import dataclasses
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from online_worlds import (
    assert_same_answer,
    begun,
    edges_at,
    turned,
)

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures, MultiRobotGraph
from pcm_jax.graph.copies import counted_once
from pcm_jax.online import IncrementalPcm
from pcm_jax.pipeline import select
from pcm_jax.simulation import simulate_city, simulate_sessions

FIRST, ALL = 25, 40
"""Poses of each map at the beginning, and at last."""
WORLDS = {
    "city": simulate_city(
        seed=3, poses=ALL, robots=3, inliers=7, aliased_groups=1, aliased_size=4, random=8
    ),
    "sessions": simulate_sessions(
        seed=1, poses=ALL, sessions=2, inliers=9, aliased_groups=1, aliased_size=4, random=8
    ),
}
OPTIONS = (
    {},
    {"minimum_inliers": 3, "confidence": 0.9},
    {"on_ambiguous": "largest", "separation": 1.0, "seed": 4},
    {"tie_break": "distance"},
    {"method": "pcm-heuristic", "significance": 0.05},
    {"method": "ransac"},
    {"memory_limit": 0},
)


class Steps(RuleBasedStateMachine):
    """Runs steps on `IncrementalPcm` and on plain lists, and compares."""

    @initialize(
        world=st.sampled_from(sorted(WORLDS)), options=st.sampled_from(OPTIONS), data=st.data()
    )
    def begin(self, world, options, data):
        self.world, self.options = WORLDS[world].graph, options
        self.maps = [begun(one, FIRST) for one in self.world.maps]
        self.held, self.waits = [], []
        empty = MultiRobotGraph(tuple(self.maps))
        self.online = IncrementalPcm(empty, **options)
        if data.draw(st.booleans(), "all closures"):
            self.take_in(range(len(self.pool())), [False] * len(self.pool()))
        self.add_some(data)

    def pool(self) -> LoopClosures:
        return self.world.closures

    def has_poses(self, closure: int) -> bool:
        one = self.pool()
        return bool(
            one.pose_a[closure] < self.maps[one.robot_a[closure]].num_poses
            and one.pose_b[closure] < self.maps[one.robot_b[closure]].num_poses
        )

    def model(self) -> MultiRobotGraph:
        return MultiRobotGraph(tuple(self.maps), self.pool()[np.array(self.held, int)])

    @rule(data=st.data())
    def add_some(self, data):
        count = len(self.pool())
        some = data.draw(st.lists(st.integers(0, count - 1), min_size=1, max_size=12), "closures")
        flips = data.draw(st.lists(st.booleans(), min_size=len(some), max_size=len(some)), "turned")
        self.take_in(some, flips)

    def take_in(self, some, flips):
        parts = [
            turned(self.pool()[[k]]) if flip else self.pool()[[k]]
            for k, flip in zip(some, flips, strict=True)
        ]
        found = self.online.add(LoopClosures.concatenate(parts))
        for closure, index in zip(some, found.tolist(), strict=True):
            if closure in self.held:
                assert index == self.held.index(closure)
            elif self.has_poses(closure):
                assert index == len(self.held)
                self.held.append(closure)
            else:
                assert index == -1
                self.waits += [closure] * (closure not in self.waits)

    @precondition(lambda self: self.held)
    @rule(data=st.data())
    def remove_some(self, data):
        rows = data.draw(
            st.lists(st.integers(0, len(self.held) - 1), min_size=1, max_size=4, unique=True)
        )
        self.online.remove(rows)
        self.held = [one for row, one in enumerate(self.held) if row not in rows]

    @rule(robot=st.integers(0, 2), steps=st.integers(1, 3), loops=st.booleans())
    def extend(self, robot, steps, loops):
        robot %= len(self.maps)
        for _ in range(steps):
            size = self.maps[robot].num_poses
            if size == ALL:
                return
            self.maps[robot] = self.grown(robot, size, loops)
            entered = self.online.extend(
                robot, **edges_at(self.world.maps[robot], size, odometry=True)
            )
            self.come_in(entered)
            edges = edges_at(self.world.maps[robot], size, odometry=False)
            if loops and len(edges["tail"]):
                assert len(self.online.extend(robot, **edges)) == 0

    def grown(self, robot, size, loops):
        longer = begun(self.world.maps[robot], size + 1)
        if loops:
            new = np.maximum(longer.tail, longer.head) == size
            old = self.maps[robot]
            part = longer.with_edges(new)
        else:
            step = (np.maximum(longer.tail, longer.head) == size) & (
                np.abs(longer.tail - longer.head) == 1
            )
            old, part = self.maps[robot], longer.with_edges(step)
        return dataclasses.replace(
            longer,
            tail=np.concatenate([old.tail, part.tail]),
            head=np.concatenate([old.head, part.head]),
            measurement=lie.concatenate([old.measurement, part.measurement]),
            information=np.concatenate([old.information, part.information]),
            source=np.concatenate([old.source, part.source]),
        )

    def come_in(self, entered):
        came = [one for one in self.waits if self.has_poses(one)]
        np.testing.assert_array_equal(entered, len(self.held) + np.arange(len(came)))
        self.held += came
        self.waits = [one for one in self.waits if one not in came]

    @rule(robot=st.integers(0, 2), factor=st.sampled_from((0.5, 2.0)))
    def replace(self, robot, factor):
        robot %= len(self.maps)
        one = self.maps[robot]
        self.maps[robot] = dataclasses.replace(one, information=factor * one.information)
        maps = list(self.online.graph.maps)
        maps[robot] = dataclasses.replace(self.maps[robot], name=maps[robot].name)
        self.come_in(self.online.replace_maps(maps))

    @rule()
    def save_and_load(self):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "state.npz")
            self.online.save(path)
            self.online = IncrementalPcm.load(path)

    @rule(data=st.data())
    def refuse(self, data):
        before = self.fingerprint()
        one, far = self.pool()[[0]], edges_at(self.world.maps[0], ALL - 1, odometry=True)
        calls = {
            "index": lambda: self.online.remove([len(self.held)]),
            "twice": lambda: self.online.remove([0, 0]),
            "mask": lambda: self.online.remove(np.ones(len(self.held) + 1, bool)),
            "robot": lambda: self.online.add(dataclasses.replace(one, robot_a=one.robot_b + 9)),
            "negative": lambda: self.online.add(
                dataclasses.replace(one, pose_a=one.pose_a * 0 - 1)
            ),
            "weight": lambda: self.online.add(dataclasses.replace(one, weight=np.array([-1.0]))),
            "apart": lambda: self.online.extend(0, **far | {"tail": [98], "head": [99]}),
            "maps": lambda: self.online.replace_maps(self.online.graph.maps[:-1]),
            "none": lambda: self.online.extend(7, measurement=one.measurement),
        }
        call = data.draw(st.sampled_from(sorted(calls)))
        with pytest.raises(InputError):
            calls[call]()
        assert self.fingerprint() == before

    def fingerprint(self):
        graph, waiting = self.online.graph, self.online.waiting
        return (
            *(one.num_poses for one in graph.maps),
            *(one.num_edges for one in graph.maps),
            np.asarray(graph.closures.pose_a).tobytes(),
            np.asarray(lie.parameters(graph.closures.measurement)).tobytes(),
            np.asarray(waiting.pose_a).tobytes(),
            self.online.repeated,
            self.online.result().accepted.tobytes(),
        )

    @precondition(lambda self: hasattr(self, "online"))
    @invariant()
    def equal(self):
        found = self.online.result()
        assert found.waiting == len(self.waits) == len(self.online.waiting)
        batch = select(counted(self.model()), **self.options)
        assert_same_answer(found, batch)


def counted(graph: MultiRobotGraph) -> MultiRobotGraph:
    once, _, _ = counted_once(graph.closures)
    assert len(once) == len(graph.closures)
    return graph


EXAMPLES = int(os.environ.get("PCM_JAX_ONLINE_EXAMPLES", "12"))
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
