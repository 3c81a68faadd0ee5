"""`State`: all that is held, changed as a whole or not at all.

Each change makes a new state, in which what has not changed is shared. So a step that is refused,
or interrupted, leaves the one that was there.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool

from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph
from pcm_jax.mapping import MapCovariance
from pcm_jax.online._arrivals import WAITS, Arrived, Identities, has_poses
from pcm_jax.online._pair import HeldPair

Robots = tuple[int, int]


@dataclasses.dataclass(frozen=True)
class State:
    """Maps, closures, and what is known of them.

    Attributes:
        maps: the maps as given, in a graph without closures.
        covariances: of the optimised maps.
        arrived: the closures held.
        waiting: those that wait for poses.
        repeated: how many came that stated an earlier one again.
        pairs: by robots, those that closures join.
        weighing: gate, memory limit and metric of the pairs.
        tolerance: how far distances may have moved for pairs to be left as they were judged.
    """

    maps: MultiRobotGraph
    covariances: tuple[MapCovariance, ...]
    arrived: Arrived
    waiting: LoopClosures
    repeated: int
    pairs: dict[Robots, HeldPair]
    weighing: tuple[float, float, Any]
    tolerance: float = 0.0

    @classmethod
    def of_maps(
        cls,
        maps: MultiRobotGraph,
        covariances: tuple[MapCovariance, ...],
        weighing: tuple[float, float, Any],
    ) -> State:
        """Maps without a closure."""
        none = LoopClosures.empty(maps.group)
        return cls(maps, covariances, Arrived(none), none, 0, {}, weighing)

    def met(self) -> Identities:
        """All closures held and waiting, by their names."""
        found = Identities()
        found.meet(self.arrived.closures, int)
        found.meet(self.waiting, lambda _: WAITS)
        return found

    def with_closures(self, closures: LoopClosures, waits: LoopClosures, repeated: int) -> State:
        """The state with further closures, none of them met before.

        Args:
            closures: to take in.
            waits: to wait for poses.
            repeated: how many others stated one of these or of those held.

        Raises:
            InputError: for a map whose information is singular.
        """
        pairs = dict(self.pairs)
        for robots in closures.pairs():
            oriented, rows = closures.between(*robots)
            held = pairs.get(robots) or HeldPair(robots, self._both(robots), *self.weighing)
            pair = self._current(held)
            pair = pair.copy() if pair is held else pair
            pair.add(oriented, len(self.arrived) + rows)
            pairs[robots] = pair
        waiting = LoopClosures.concatenate([self.waiting, waits]) if len(waits) else self.waiting
        return dataclasses.replace(
            self,
            arrived=self.arrived.with_more(closures) if len(closures) else self.arrived,
            waiting=waiting,
            repeated=self.repeated + repeated,
            pairs=pairs,
        )

    def without(self, gone: Bool[np.ndarray, " m"]) -> State:
        """The state without some closures; those behind them move up."""
        before, pairs = np.cumsum(~gone) - 1, {}
        for robots, pair in self.pairs.items():
            rows = np.flatnonzero(gone[pair.closures])
            if len(rows) == len(pair):
                continue
            pairs[robots] = pair.copy()
            if len(rows):
                pairs[robots].remove(rows)
            pairs[robots].renumber(before)
        left = Arrived(self.arrived.closures[~gone])
        return dataclasses.replace(self, arrived=left, pairs=pairs)

    def in_maps(
        self,
        maps: tuple[PoseGraph, ...],
        covariances: tuple[MapCovariance, ...],
        grown: int | None,
    ) -> State:
        """The state in other maps; closures that waited for their poses come in.

        Args:
            maps: as given.
            covariances: of them, optimised.
            grown: the robot whose map has but odometry more, if that is all.

        Raises:
            InputError: as `with_closures`.
        """
        pairs = dict(self.pairs)
        for robots, pair in self.pairs.items():
            both = covariances[robots[0]], covariances[robots[1]]
            changed = [a is not b for a, b in zip(pair.covariances, both, strict=True)]
            if any(changed) and all(
                robot == grown and self.covariances[robot] is before
                for robot, before, moved in zip(robots, pair.covariances, changed, strict=True)
                if moved
            ):
                pairs[robots] = pair.copy()
                pairs[robots].grow(both)
        maps_now = dataclasses.replace(self.maps, maps=maps, truth=None)
        moved = dataclasses.replace(self, maps=maps_now, covariances=covariances, pairs=pairs)
        if not len(self.waiting):
            return moved
        there = has_poses(maps, self.waiting)
        enters = self.waiting[there]
        moved = dataclasses.replace(moved, waiting=self.waiting[~there])
        return moved.with_closures(enters, enters[:0], 0) if len(enters) else moved

    def current(self) -> State:
        """The same with every pair of robots weighed in the maps as they are, and in order.

        Raises:
            InputError: as `with_closures`.
        """
        pairs = {robots: self._current(pair) for robots, pair in sorted(self.pairs.items())}
        return dataclasses.replace(self, pairs=pairs)

    def _current(self, pair: HeldPair) -> HeldPair:
        both = self._both(pair.robots)
        return pair if pair.is_in(both) else pair.refreshed(both, self.tolerance)

    def _both(self, robots: Robots) -> tuple[MapCovariance, MapCovariance]:
        return self.covariances[robots[0]], self.covariances[robots[1]]
