"""`IncrementalWithin`: closures inside one robot's map that keep coming.

At every step the answer is that of `select_within` on the same map. What a step costs is what it
changes:

    a closure comes     one row of Q; a search for a larger set that must hold it
    a closure goes      a search for a set as large, if it was in the largest
    odometry comes      nothing: distances between closures stay what they were
    the answer          chance and recall, as `select_within` has them; none of the distances

Whatever is refused leaves everything as it was: a step is worked out first, and then taken.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections import deque
from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.consistency import odometry_edges
from pcm_jax.errors import InputError, check_class, check_number
from pcm_jax.graph import LoopClosures, PoseGraph, checked
from pcm_jax.graph.validation import argument_fault, as_indices, check_self_loops
from pcm_jax.online._arrivals import (
    WAITS,
    Arrived,
    Identities,
    as_rows,
    check_queue,
    ends_of,
    named,
)
from pcm_jax.online._held_within import HeldTrials, HeldWithin, agreeing
from pcm_jax.online._maps import checked_part, joined
from pcm_jax.online._room import Room
from pcm_jax.online._saved import (
    closure_arrays,
    closures_of,
    map_arrays,
    map_of,
    options_to_save,
    prefixed,
    read,
    those_of,
    write,
)
from pcm_jax.online._steady import MOST_LOGGED, Change, changes
from pcm_jax.online.incremental import MOST_WAITING
from pcm_jax.pipeline.within_decision import Question, decided
from pcm_jax.selection import WithinSelection

FORM = "IncrementalWithin"


class IncrementalWithin:
    """Selects the loop closures to believe inside one robot's map, while it drives.

        online = pcm_jax.IncrementalWithin(pose_graph)
        online.extend(measurement=step, covariance=noise)               # as the robot drives
        online.add([900], [12], measurement=loop, covariance=noise)     # as closures are found
        online.result().accepted                # as select_within(online.graph).accepted

    Closures are counted from 0 in the order in which they came, as in `result().accepted`; where
    some are removed, those behind them move up. One that states an earlier one again counts once
    (`repeated`); one that touches a pose that has not come yet waits for it (`waiting`).

    The search goes on from what is known for `"pcm-exact"` where ties by distance do not decide;
    other methods are asked anew. Where it does not end in its time limit, the largest set that is
    known is the answer, which may then be larger than that of `select_within`.

    Args:
        pose_graph: as for `select_within`: a chain of odometry, and the closures that are known
            already. One pose is enough.
        most_waiting: closures that may wait for poses.
        hysteresis: the set believed so far stays, as for `IncrementalPcm`. 0: the answer is that of
            `select_within`.
        **options: as for `select_within`.

    Raises:
        InputError: as `select_within`.
    """

    @on_host
    def __init__(
        self,
        pose_graph: PoseGraph,
        *,
        most_waiting: int = MOST_WAITING,
        hysteresis: float = 0.0,
        **options: Any,
    ) -> None:
        check_class("pose_graph", pose_graph, "a PoseGraph", PoseGraph)
        check_number("most_waiting", most_waiting, least=0, integer=True)
        check_number("hysteresis", hysteresis, least=0)
        self._options, self._most_waiting = options, most_waiting
        self._hysteresis, self._step = float(hysteresis), -1
        self._log: deque[Change] = deque(maxlen=MOST_LOGGED)
        self._members = self._believed = np.zeros(0, bool)
        self._question = Question.from_options(options)
        is_step = np.zeros(pose_graph.num_edges, bool)
        is_step[odometry_edges(pose_graph)] = True
        none = LoopClosures.empty(pose_graph.group)
        self._odometry = pose_graph.with_edges(odometry_edges(pose_graph))
        self._arrived, self._waiting, self._repeated = Arrived(none), none, 0
        self._held, self._room = self._nothing_held(), Room()
        self._identities: Identities | None = None
        self._graph: PoseGraph | None = None
        self._selection: WithinSelection | None = None
        self._add(_closures_of(pose_graph.with_edges(~is_step)))

    def __len__(self) -> int:
        return len(self._arrived)

    def __repr__(self) -> str:
        return (
            f"IncrementalWithin({self._odometry.name!r}, {self._odometry.num_poses} poses,"
            f" {len(self)} closures)\n"
            f"  beside  {len(self._waiting)} that wait for poses, {self.repeated} repeated"
        )

    @property
    def graph(self) -> PoseGraph:
        """The map: odometry and, behind it, the closures held: what `select_within` is asked."""
        if self._graph is None:
            self._graph = _together(self._odometry, self._arrived.closures)
        return self._graph

    @property
    def waiting(self) -> Int[np.ndarray, "w 2"]:
        """The poses at both ends of the closures that wait for one of them, as they came."""
        return ends_of(self._waiting)[:, [1, 3]]

    @property
    def repeated(self) -> int:
        """The number of closures that came and stated an earlier one again."""
        return self._repeated

    @property
    def log(self) -> tuple[Change, ...]:
        """The closures that entered answers and left them, as `IncrementalPcm.log`."""
        return tuple(self._log)

    @on_host
    def add(
        self,
        tail: Any,
        head: Any,
        *,
        measurement: Any,
        information: Any = None,
        covariance: Any = None,
        tangent_order: str = "translation-rotation",
        source: Any = None,
    ) -> Int[np.ndarray, " n"]:
        """Takes closures in.

        Args:
            tail: int `[n]`, the poses that they start at.
            head: int `[n]`, the poses that they measure.
            measurement: Lie `[n]` or homogeneous matrices, the head's pose seen from the tail.
            information: `[n, d, d]`, or None where `covariance` is given.
            covariance: `[n, d, d]`, or None where `information` is given.
            tangent_order: of their rows and columns, as for `PoseGraph.from_arrays`.
            source: `[n]` of strings, where each comes from.

        Returns:
            int64 `[n]`, the index of each in `result().accepted`; of one that was there already the
            index that it has; −1 for one that waits for a pose.

        Raises:
            InputError: for what `PoseGraph.from_arrays` refuses of an edge, and for a queue that is
                full. Nothing is taken in then.
        """
        edges: Any = checked.as_transforms(measurement, "measurement")
        if lie.group_of(edges) is not self._odometry.group:
            raise InputError(
                f"measurement: {lie.group_of(edges).__name__} given,"
                f" expected {self._odometry.group.__name__} like the map"
            )
        rows = len(lie.parameters(edges))
        ends = [_as_ends(given, name, rows) for name, given in (("tail", tail), ("head", head))]
        check_self_loops(ends[0], ends[1], argument_fault("head"))
        none = np.zeros(rows, np.int32)
        closures = LoopClosures.from_checked(
            (none, ends[0], none, ends[1]),
            edges,
            checked.as_information(information, covariance, edges, tangent_order),
            checked.as_names(source, rows),
            np.ones(rows),
        )
        return self._add(closures)

    @on_host
    def remove(self, indices: Any) -> None:
        """Takes closures out; those behind them move up.

        Args:
            indices: `[r]` of closures, each once; or a mask.

        Raises:
            InputError: for an index that is not there or is given twice, a mask of another length.
        """
        gone = as_rows(indices, len(self))
        if not gone.any():
            return
        held, left = self._held.without(gone), Arrived(self._arrived.closures[~gone])
        self._go_on()
        self._members, self._believed = self._members[~gone], self._believed[~gone]
        self._held, self._arrived, self._identities = held, left, None

    @on_host
    def extend(self, poses: Any = None, **part: Any) -> Int[np.ndarray, " n"]:
        """Appends odometry: one edge from the last pose to the first new one, and so on.

        Args:
            poses: Lie `[p]` or homogeneous matrices: where the new poses are, in the map's frame;
                None: where the edges put them. The answer goes by the edges alone.
            **part: as for `IncrementalPcm.extend`.

        Returns:
            int64 `[n]`, indices of the closures that had waited for these poses.

        Raises:
            InputError: as `IncrementalPcm.extend`; for edges that are no odometry.
        """
        new = checked_part(self._odometry, poses, **part)
        if not new.is_odometry(self._odometry.num_poses):
            raise InputError(
                "tail, head: expected one edge from the last pose to the first new one and so on,"
                " in order; closures come by add"
            )
        odometry, held = joined(self._odometry, new, self._room), self._held.extended(new)
        there = _has_poses(self._waiting, odometry.num_poses)
        enters, before = self._waiting[there], len(self)
        held = held.with_closures(enters) if len(enters) else held
        arrived = self._arrived.with_more(enters) if len(enters) else self._arrived
        self._go_on(len(enters))
        self._odometry, self._held, self._arrived = odometry, held, arrived
        if len(enters):
            self._waiting, self._identities = self._waiting[~there], None
        return np.arange(before, len(self))

    @on_host
    def result(self) -> WithinSelection:
        """The closures to believe: what `select_within` answers for `graph`.

        Kept until something changes. What was accepted is tested again each time, and may leave:
        see `log`.
        """
        if self._selection is None:
            held = functools.partial(
                HeldTrials, held=self._held, members=self._members, hysteresis=self._hysteresis
            )
            found = self._selection = decided(self.graph, self._question, held)
            self._log.extend(self._changes(found))
            self._members = (found.accepted & ~found.recalled) | found.dropped
            self._believed = found.accepted
        return self._selection

    @on_host
    def save(self, path: str | PathLike[str]) -> None:
        """Writes the whole state to one file, whole or not at all; see `IncrementalPcm.save`.

        Raises:
            InputError: where the method is a function.
            OSError: where the file cannot be written.
        """
        meta = {
            "form": FORM,
            "options": options_to_save(self._options),
            "most_waiting": self._most_waiting,
            "hysteresis": self._hysteresis,
            "step": self._step,
            "log": [dataclasses.astuple(change) for change in self._log],
            "name": self._odometry.name,
            "repeated": self._repeated,
        }
        arrays = prefixed("odometry", map_arrays(self._odometry))
        arrays |= prefixed("held", closure_arrays(self._arrived.closures))
        arrays |= prefixed("waiting", closure_arrays(self._waiting))
        arrays |= {"members": self._members, "believed": self._believed}
        write(Path(path), json.loads(json.dumps(meta)), arrays)

    @classmethod
    @on_host
    def load(cls, path: str | PathLike[str]) -> IncrementalWithin:
        """Goes on from a saved state: to the same answers as without a break.

        Raises:
            FileFormatError: for a file of another kind or version, one cut short or changed.
            OSError: where it cannot be opened.
        """
        meta, arrays = read(Path(path), FORM)
        odometry = map_of(those_of("odometry", arrays), meta["name"])
        rule = {name: meta[name] for name in ("most_waiting", "hysteresis")}
        online = cls(odometry, **rule, **meta["options"])
        held, waiting = (
            closures_of(those_of(name, arrays), odometry.group) for name in ("held", "waiting")
        )
        online._held = online._held.with_closures(held)
        online._arrived, online._waiting = Arrived(held), waiting
        online._repeated, online._graph, online._identities = meta["repeated"], None, None
        online._step = meta["step"]
        online._members, online._believed = arrays["members"], arrays["believed"]
        online._log.extend(Change(*each) for each in meta["log"])
        return online

    def _add(self, closures: LoopClosures) -> Int[np.ndarray, " n"]:
        there = _has_poses(closures, self._odometry.num_poses)
        known, self._identities = self._identities, None
        names, new, known = named(closures, there, len(self), known, self._met)
        waits, enters = closures[new & ~there], closures[new & there]
        check_queue(len(self._waiting) + len(waits), self._most_waiting)
        held = self._held.with_closures(enters) if len(enters) else self._held
        arrived = self._arrived.with_more(enters) if len(enters) else self._arrived
        waiting = LoopClosures.concatenate([self._waiting, waits]) if len(waits) else self._waiting
        self._go_on(len(enters))
        self._held, self._arrived, self._waiting = held, arrived, waiting
        self._repeated += int((~new).sum())
        self._identities = known
        return names

    def _changes(self, found: WithinSelection) -> Iterator[Change]:
        """The entries of the log that an answer makes."""
        if np.array_equal(self._believed, found.accepted):
            return
        graph, agree = self.graph, agreeing(found.squared, found.gate)
        why = found.verdict.why
        seen = self._believed, found.accepted, agree, why, found.dropped
        for row, event, reason in changes(*seen):
            edge = found.closures[row]
            a, b = (graph.pose_name(int(at[edge])) for at in (graph.tail, graph.head))
            yield Change(self._step, row, a, b, event, reason)

    def _nothing_held(self) -> HeldWithin:
        asked = self._question.asked(self._odometry.tangent_dim)
        return HeldWithin.of_odometry(self._odometry, asked, self._question.odometry_scale or 1.0)

    def _met(self) -> Identities:
        """All closures held and waiting, by their names."""
        met = Identities()
        met.meet(self._arrived.closures, int)
        met.meet(self._waiting, lambda _: WAITS)
        return met

    def _go_on(self, came: int = 0) -> None:
        """Goes on to the next step; closures that came are not believed yet."""
        none = np.zeros(came, bool)
        self._members, self._believed = (
            np.append(each, none) for each in (self._members, self._believed)
        )
        self._graph = self._selection = None
        self._step += 1


def _as_ends(given: Any, name: str, rows: int) -> Int[np.ndarray, " n"]:
    ends = as_indices(given, None, name, "poses")
    if len(ends) != rows:
        raise InputError(f"{name}: {len(ends)} entries given, expected {rows}, one per measurement")
    return ends


def _has_poses(closures: LoopClosures, size: int) -> Any:
    return (ends_of(closures)[:, [1, 3]] < size).all(axis=1)


def _closures_of(edges: PoseGraph) -> LoopClosures:
    """Edges of one map as closures from its robot, 0, to itself."""
    none = np.zeros(edges.num_edges, np.int32)
    return LoopClosures.from_checked(
        (none, np.asarray(edges.tail), none, np.asarray(edges.head)),
        lie.as_numpy(edges.measurement),
        np.asarray(edges.information),
        edges.source,
        np.ones(edges.num_edges),
    )


def _together(odometry: PoseGraph, closures: LoopClosures) -> PoseGraph:
    ends = ends_of(closures).astype(np.int32)
    return dataclasses.replace(
        odometry,
        tail=np.concatenate([np.asarray(odometry.tail), ends[:, 1]]),
        head=np.concatenate([np.asarray(odometry.head), ends[:, 3]]),
        measurement=lie.concatenate([lie.as_numpy(odometry.measurement), closures.measurement]),
        information=np.concatenate(
            [np.asarray(odometry.information), np.asarray(closures.information)]
        ),
        source=np.concatenate([odometry.source, closures.source]),
    )
