"""`IncrementalPcm`: closures that keep coming, maps that keep growing.

At every step the answer is that of `select` on the same maps and closures: the same set under the
same rule, with the same certificate. What a step costs is what it changes:

    a closure comes     one row of Q; a search for a larger set that must hold it
    a closure goes      a search for a set as large, if it was in the largest
    odometry comes      nothing: distances between closures stay what they were
    a loop in a map     that map's optimum; when next asked, the pairs whose distance has moved
    the answer          chance, places and rivals of the pairs of robots that changed since

What is refused leaves all as it was: a step is worked out first, and then taken.
"""

from __future__ import annotations

import dataclasses
import json
from collections import defaultdict, deque
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from pcm_jax.arrays import on_host
from pcm_jax.errors import InputError, check_class, check_number
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph
from pcm_jax.graph.checked import as_weights
from pcm_jax.mapping import MapCovariance
from pcm_jax.merging import MergeResult
from pcm_jax.online._answer import answer, memory_limit, remember
from pcm_jax.online._arrivals import (
    Identities,
    as_rows,
    check_arrivals,
    check_queue,
    named,
)
from pcm_jax.online._maps import check_name, checked_part, grown_by, robot_index
from pcm_jax.online._merged import merged_by
from pcm_jax.online._room import Room
from pcm_jax.online._saved import arrays_of, options_to_save, read, state_of, write
from pcm_jax.online._state import State
from pcm_jax.online._steady import MOST_LOGGED, Change
from pcm_jax.pipeline.select import select
from pcm_jax.pipeline.weigh import optimized_maps
from pcm_jax.selection import Selection

MOST_WAITING = 10_000
"""Closures that may wait for poses."""
FORM = "IncrementalPcm"


class IncrementalPcm:
    """Selects the closures to believe while closures come and go and maps grow.

        online = pcm_jax.IncrementalPcm(graph, confidence=0.99)
        online.add(closures)                            # as they are found
        online.extend(0, measurement=step, covariance=noise)    # as robot 0 drives
        online.result().accepted                        # as select(online.graph).accepted

    Closures are counted from 0 in the order in which they came, as in `graph`; where some are
    removed, those behind them move up, as in an array. One that states an earlier one again counts
    once (`repeated`); one that touches a pose that has not come yet waits for it (`waiting`).

    A closure costs one row of Q and a search among those that agree with it: with Mahalanobis
    distances, and `"pcm-exact"` where weights, ties by distance and time limits do not decide.
    Other methods and metrics of one's own are asked anew, with what changed.

    Args:
        graph: the robots' maps, and the closures that are known already.
        most_waiting: closures that may wait for poses.
        hysteresis: the set believed so far stays, with what has come and agrees with all of it,
            unless the method's has more than so many closures (weighs so much) more, see `_steady`.
            0: the answer is that of `select`.
        tolerance: how far a loop or other maps may move the distance (not squared) of two closures
            that are then judged as before. 0: the answer is that of `select`.
        **options: as for `select`.

    Raises:
        InputError: as `select`.
    """

    @on_host
    def __init__(
        self,
        graph: MultiRobotGraph,
        *,
        most_waiting: int = MOST_WAITING,
        hysteresis: float = 0.0,
        tolerance: float = 0.0,
        **options: Any,
    ) -> None:
        check_class("graph", graph, "a MultiRobotGraph", MultiRobotGraph)
        check_number("most_waiting", most_waiting, least=0, integer=True)
        check_number("hysteresis", hysteresis, least=0)
        check_number("tolerance", tolerance, least=0)
        self._options, self._most_waiting = options, most_waiting
        self._hysteresis, self._step = float(hysteresis), -1
        self._log: deque[Change] = deque(maxlen=MOST_LOGGED)
        maps = dataclasses.replace(graph, closures=LoopClosures.empty(graph.group))
        started = select(maps, **options)
        self._names = started.method, started.confidence, started.gate
        self._metric, self._seconds = started.evidence.metric, dict(started.evidence.seconds)
        metric = options.get("metric") if callable(options.get("metric")) else None
        weighing = started.gate, memory_limit(options), metric
        state = State.of_maps(maps, started.evidence.covariances, weighing)
        self._state = dataclasses.replace(state, tolerance=float(tolerance))
        self._identities: Identities | None = None
        self._rooms = defaultdict[int, Room](Room)
        self._graph: MultiRobotGraph | None = None
        self._merged: MergeResult | None = None
        self._selection: Selection | None = None
        self.add(graph.closures)

    def __len__(self) -> int:
        return len(self._state.arrived)

    def __repr__(self) -> str:
        names, pairs = self._state.maps.names, sorted(self._state.pairs.items())
        held = [f"{names[a]}-{names[b]} {len(pair)}" for (a, b), pair in pairs]
        return (
            f"IncrementalPcm({len(names)} maps, {len(self)} closures)\n"
            f"  pairs   {', '.join(held) or 'none'}\n"
            f"  beside  {len(self.waiting)} that wait for poses, {self.repeated} repeated"
        )

    @property
    def graph(self) -> MultiRobotGraph:
        """The maps as given and the closures held: what `select` would be asked."""
        if self._graph is None:
            closures = self._state.arrived.closures
            self._graph = dataclasses.replace(self._state.maps, closures=closures)
        return self._graph

    @property
    def waiting(self) -> LoopClosures:
        """The closures that wait for poses, in the order in which they came."""
        return self._state.waiting

    @property
    def repeated(self) -> int:
        """The number of closures that came and stated an earlier one again."""
        return self._state.repeated

    @property
    def log(self) -> tuple[Change, ...]:
        """The last 10,000 closures that entered answers or left them by themselves, and why."""
        return tuple(self._log)

    @on_host
    def add(self, closures: LoopClosures) -> Int[np.ndarray, " n"]:
        """Takes closures in.

        Args:
            closures: any number, between any robots.

        Returns:
            int64 `[n]`, the index of each in `graph`; of one that was there already the index that
            it has; −1 for one that waits for a pose.

        Raises:
            InputError: for closures of another group, a robot that does not exist, a negative pose,
                a weight that is no finite number of at least 0, a queue that is full, a map whose
                information is singular. Nothing is taken in then.
        """
        check_class("closures", closures, "LoopClosures", LoopClosures)
        state = self._state
        there = check_arrivals(state.maps.maps, closures)
        as_weights(closures.weight, len(closures))
        known, self._identities = self._identities, None
        names, new, known = named(closures, there, len(self), known, state.met)
        waits = closures[new & ~there]
        check_queue(len(state.waiting) + len(waits), self._most_waiting)
        state = state.with_closures(closures[new & there], waits, int((~new).sum()))
        self._take(state)
        self._identities = known
        return names

    @on_host
    def remove(self, indices: Any) -> None:
        """Takes closures out; those behind them move up.

        Args:
            indices: `[r]` of closures in `graph`, each once; or a mask.

        Raises:
            InputError: for an index that is not there or is given twice, a mask of another length.
        """
        gone = as_rows(indices, len(self))
        if not gone.any():
            return
        self._take(self._state.without(gone))

    @on_host
    def extend(self, robot: int | str, poses: Any = None, **part: Any) -> Int[np.ndarray, " n"]:
        """Appends poses and edges to a robot's map.

            online.extend(0, measurement=steps, covariance=noise)       # odometry
            online.extend(0, tail=[900], head=[12], measurement=loop, covariance=noise)

        Odometry, one edge from the last pose to the first new one and so on, changes no distance
        between closures. Anything else, a loop above all, moves the whole map: it is optimised
        anew from where it is, and its pairs of robots are weighed again when next asked.

        Args:
            robot: index or name.
            poses: `jaxlie.SE2` or `jaxlie.SE3` `[p]` or homogeneous matrices: where the new poses
                are, in the map's frame; None: where the edges put them.
            **part: of the edges `measurement`, `information` or `covariance` (and `tangent_order`),
                as for `PoseGraph.from_arrays`; `tail` and `head`, indices in the map as it will
                be; without both odometry from the last pose on. Of the poses `ids` `[p]`, new ones,
                and `stamps` `[p]`, seconds, in order.

        Returns:
            int64 `[n]`, indices in `graph` of the closures that had waited for these poses.

        Raises:
            InputError: for a robot that does not exist, what `PoseGraph.from_arrays` refuses, a
                pose that no edge joins to the map, an id that is taken, stamps out of order.

        Warns:
            ConvergenceWarning: for a map whose optimisation stopped before it converged.
        """
        index = robot_index(robot, self._state.maps.names)
        given, covariance = self._state.maps.maps[index], self._state.covariances[index]
        new = checked_part(given, poses, **part)
        settled, room = self._options.get("optimized", False), self._rooms[index]
        grown, covariance, odometry = grown_by(given, covariance, new, room, settled=settled)
        maps, covariances = list(self._state.maps.maps), list(self._state.covariances)
        maps[index], covariances[index] = grown, covariance
        return self._move(tuple(maps), tuple(covariances), index if odometry else None)

    @on_host
    def replace_maps(self, maps: Sequence[PoseGraph]) -> Int[np.ndarray, " n"]:
        """Puts other maps in the place of those held, as after an optimisation elsewhere.

        Pairs of robots whose maps changed are weighed again when next asked; a map that is the same
        object costs nothing.

        Args:
            maps: one for each robot, in their order, with all poses that closures touch; any
                further ones are robots that come.

        Returns:
            int64 `[n]`, indices in `graph` of the closures that had waited for poses.

        Raises:
            InputError: for fewer maps, another group, a pose that a closure needs and is not there.

        Warns:
            ConvergenceWarning: as `extend`.
        """
        check_class("maps", maps, "PoseGraphs", tuple, list)
        before = self._state.maps.maps
        if len(maps) < len(before):
            raise InputError(
                f"maps: {len(maps)} given, expected at least {len(before)}, one a robot"
            )
        given = dataclasses.replace(self.graph, maps=tuple(maps)).maps
        settled = self._options.get("optimized", False)
        covariances = [
            self._state.covariances[index]
            if index < len(before) and maps[index] is before[index]
            else MapCovariance(optimized_maps((one,), settled)[0])
            for index, one in enumerate(given)
        ]
        return self._move(given, tuple(covariances), None)

    def add_robot(self, pose_graph: PoseGraph) -> int:
        """Takes in the map of a robot that comes, behind those that are there.

        Args:
            pose_graph: its map. A name that is taken gets a number.

        Returns:
            its index.
        """
        check_class("pose_graph", pose_graph, "a PoseGraph", PoseGraph)
        maps = self._state.maps.maps
        self.replace_maps([*maps, pose_graph])
        return len(maps)

    @on_host
    def rename(self, robot: int | str, name: str) -> None:
        """Gives a robot another name; all else stays as it is.

        Raises:
            InputError: for a robot that does not exist, a name that is empty or taken.
        """
        index = robot_index(robot, self._state.maps.names)
        check_name(index, name, self._state.maps.names)
        maps, covariances = list(self._state.maps.maps), list(self._state.covariances)
        maps[index] = dataclasses.replace(maps[index], name=name)
        covariances[index] = covariances[index].renamed(name)
        self._move(tuple(maps), tuple(covariances), index)

    @on_host
    def result(self) -> Selection:
        """The closures to believe: what `select` answers for `graph`.

        Kept until something changes; only pairs of robots that changed are judged anew. What was
        accepted is tested again each time, and may leave: see `log`.

        Warns:
            InputWarning: as `select`.
        """
        if self._selection is None:
            self._state = self._state.current()
            told = self._metric, self._seconds
            of = self._state, self.graph, self._options, self._names, *told
            self._selection = answer(*of, self._hysteresis)
            self._log.extend(remember(self._state, self._selection, self._step))
        return self._selection

    def merge(self, **options: Any) -> MergeResult:
        """Merges the maps by the closures that are believed now, as `merge` of `graph` does.

        Solves from where the last call ended, where that is the better start.

        Args:
            **options: `solver`, `engine`, `refine` and `progress` of `merge`.

        Raises:
            InputError: as `merge`.
        """
        self._merged = merged_by(self.result(), options, self._merged)
        return self._merged

    @on_host
    def save(self, path: str | PathLike[str]) -> None:
        """Writes the whole state to one file, whole or not at all.

            online.save("state.npz")
            online = pcm_jax.IncrementalPcm.load("state.npz")

        Args:
            path: of an `.npz` file, which is replaced if it is there.

        Raises:
            InputError: where the metric or the method is a function.
            OSError: where the file cannot be written.
        """
        options = options_to_save(self._options)
        self._state = self._state.current()
        meta = {
            "form": FORM,
            "options": options,
            "rule": (self._most_waiting, self._hysteresis, self._state.tolerance),
            "step": self._step,
            "log": [dataclasses.astuple(change) for change in self._log],
            "names": self._names,
            "metric": self._metric,
            "seconds": self._seconds,
            "robots": self._state.maps.names,
            "repeated": self.repeated,
        }
        write(Path(path), json.loads(json.dumps(meta)), arrays_of(self._state))

    @classmethod
    @on_host
    def load(cls, path: str | PathLike[str]) -> IncrementalPcm:
        """Goes on from a saved state: to the same answers as without a break.

        Args:
            path: of what `save` wrote.

        Raises:
            FileFormatError: for a file of another kind or version, one cut short or changed.
            OSError: where it cannot be opened.
        """
        meta, arrays = read(Path(path), FORM)
        online = object.__new__(cls)
        online._options, online._metric = meta["options"], meta["metric"]
        online._most_waiting, online._hysteresis, tolerance = meta["rule"]
        online._log = deque((Change(*each) for each in meta["log"]), maxlen=MOST_LOGGED)
        *_, gate = online._names = tuple(meta["names"])
        online._step, online._seconds = meta["step"], meta["seconds"]
        online._identities = online._graph = online._selection = online._merged = None
        online._rooms = defaultdict(Room)
        state = state_of(arrays, meta, (gate, memory_limit(meta["options"]), None))
        online._state = dataclasses.replace(state, tolerance=tolerance)
        return online

    def _move(
        self, maps: tuple[PoseGraph, ...], covariances: tuple[MapCovariance, ...], grown: int | None
    ) -> Int[np.ndarray, " n"]:
        """Goes on with other maps; `grown` is a robot whose map has but odometry more."""
        before = len(self)
        self._take(self._state.in_maps(maps, covariances, grown))
        return np.arange(before, len(self))

    def _take(self, state: State) -> None:
        if len(state.arrived) != len(self) or len(state.waiting) != len(self.waiting):
            self._identities = None
        self._state, self._graph, self._selection = state, None, None
        self._step += 1
