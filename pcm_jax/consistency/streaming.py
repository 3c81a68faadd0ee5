"""The consistency graph of very many closures, panel by panel, straight to bits.

For m closures Q has 8 m² bytes (3.2 GB at 20,000), and the joint covariance that it rests on
(6 n)² · 8 of each map. Neither is ever whole here. In the order of their poses in map a, closures
are cut into panels of columns v; each panel meets all closures u from its own on (the rest is its
mirror image), and of either map needs only the columns

    Σ_ij,  i touched by any u, j touched by some v of the panel,

found from the sparse factor of H by substitution (`MapCovariance.columns`). Left perturbations
come at no price: the right-hand sides are Ad(X_j)ᵀ, what is left is a product with Ad(X_i) from the
left. Then, as in `problem` and `closed_form`,

    G_ij = Σ_ii + Σ_jj − Σ_ij − Σ_ijᵀ,     q²_uv and q²_vu by tiles,     a bit where both pass.

The Σ_ii are found once, by forward substitution alone. While the device weighs the pairs of one
panel (compiled once: every panel has the same padded shape), the host prepares the next one.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from pcm_jax import lie
from pcm_jax.arrays import as_real, device_array, on_host, pad_leading, shareable_zeros
from pcm_jax.consistency._closed_form import gather, per_closure, weigh
from pcm_jax.consistency.limit import Limit, carried, gates
from pcm_jax.consistency.packed import PackedGraph
from pcm_jax.consistency.problem import check_pair, padded
from pcm_jax.errors import InputError, check_number
from pcm_jax.graph.unsaid import noise_of
from pcm_jax.lie import unrolled
from pcm_jax.mapping import MapCovariance
from pcm_jax.mapping.covariance import CovarianceColumns
from pcm_jax.store import Store, digest

if TYPE_CHECKING:
    from pcm_jax.graph import LoopClosures, PoseGraph

TILE = 64  # rows of a tile; its columns are the panel's
ROWS_AT_ONCE = 64  # of G on the host, so that what one step needs stays in a cache
UNPACKED_AT_ONCE = 512  # rows of bits as bytes
FORMAT = 1  # of the files

Progress = Callable[[str, int, int], None]


@on_host
def stream_consistency_graph(
    map_a: PoseGraph,
    map_b: PoseGraph,
    closures: LoopClosures,
    gate: float,
    *,
    folder: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
    panel: int = 128,
) -> PackedGraph:
    """Makes the consistency graph of two maps' closures without Q and without a joint marginal.

        graph = pcm_jax.stream_consistency_graph(*maps, closures, gate, folder="panels")
        pcm_jax.maximum_clique(graph.dense())

    The same bits as `consistency_graph(squared_mahalanobis(consistency_problem(...)), gate)`, but
    for squared distances that equal the gate to rounding. Time grows with m², and with m times the
    size of the maps' factors; memory with m² / 8 bytes and with `panel` times the maps' poses.

    Args:
        map_a: the optimised map of the robot that the closures start at.
        map_b: the optimised map of the robot that they end at.
        closures: all from one robot to one other, as `LoopClosures.between` gives them.
        gate: γ², see `chi2_gate`.
        folder: where each finished panel is kept, at once and whole or not at all, named by what
            the result depends on. A call with equal arguments goes on from what is there: a kill
            costs the panel on the device and what was prepared of the next. Other calls may share
            the folder. Files are left there.
        progress: called with "consistency", the pairs done and the pairs in all after each panel.
        panel: closures at a time, a multiple of 64.

    Returns:
        The graph, closures in their given order.

    Raises:
        InputError: for closures of several robot pairs, a pose that a map does not have, groups
            that differ, a singular map, a gate that is not a number, or another `panel`.
    """
    return stream_from_covariances(
        MapCovariance(map_a),
        MapCovariance(map_b),
        closures,
        gate,
        folder=folder,
        progress=progress,
        panel=panel,
    )


@on_host
def stream_from_covariances(
    covariance_a: MapCovariance,
    covariance_b: MapCovariance,
    closures: LoopClosures,
    gate: float,
    *,
    folder: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
    panel: int = 128,
) -> PackedGraph:
    """The same as `stream_consistency_graph`, of maps that are factorised already."""
    _check_numbers(gate, panel)
    map_a, map_b = covariance_a.pose_graph, covariance_b.pose_graph
    check_pair(map_a, map_b, closures)
    count = len(closures)
    order = np.lexsort((np.asarray(closures.pose_b), np.asarray(closures.pose_a)))
    panels = [Panel(start, min(start + panel, count), count) for start in range(0, count, panel)]
    stamp = _stamp(map_a, map_b, closures, gate, panel) if folder is not None else ""
    store = Store(folder, stamp)
    kept = {part: bits for part in panels if (bits := _kept(store, part)) is not None}
    missing = [part for part in panels if part not in kept]
    fresh = _computed(covariance_a, covariance_b, closures[order], gate, missing, panel)
    bits, done = np.zeros((count, -(-count // 8)), np.uint8), 0
    for part in panels:
        within = kept.get(part)
        if within is None:
            within = next(fresh)
            store.write_array(_name(part), within)
        _insert(bits, part, within)
        done += part.pairs
        if progress is not None:
            progress("consistency", done, count * (count - 1) // 2)
    return PackedGraph(_in_given_order(bits, order), count)


def _check_numbers(gate: float, panel: int) -> None:
    level = as_real(gate, "gate")
    if level.ndim or not level >= 0.0:
        raise InputError(f"gate: {gate}; expected one squared distance, at least 0")
    check_number("panel", panel, integer=True)
    if panel < TILE or panel % TILE:
        raise InputError(f"panel: {panel}; expected a multiple of {TILE}")


class Panel(NamedTuple):
    """Closures v from `start` up to `stop`, to be weighed against all u from `start` to `count`."""

    start: int
    stop: int
    count: int

    @property
    def shape(self) -> tuple[int, int]:
        """The shape of its bits."""
        return self.count - self.start, -(-(self.stop - self.start) // 8)

    @property
    def pairs(self) -> int:
        """Unordered pairs, each counted in one panel only."""
        width = self.stop - self.start
        return width * (self.count - self.stop) + width * (width - 1) // 2


def _insert(bits: np.ndarray, panel: Panel, within: UInt8[np.ndarray, "rows bytes"]) -> None:
    """Puts a panel's bits, and their mirror image, where they belong."""
    first = panel.start // 8
    bits[panel.start :, first : first + panel.shape[1]] |= within
    upright = np.unpackbits(within, axis=1, count=panel.stop - panel.start).T
    bits[panel.start : panel.stop, first:] |= np.packbits(upright, axis=1)


def _in_given_order(bits: np.ndarray, order: np.ndarray) -> UInt8[np.ndarray, "m bytes"]:
    """Bits whose rows and columns stand in `order`, in the order before that."""
    count, place = len(order), np.argsort(order)
    result = np.empty_like(bits)
    for start in range(0, count, UNPACKED_AT_ONCE):
        rows = slice(start, start + UNPACKED_AT_ONCE)
        dense = np.unpackbits(bits[place[rows]], axis=1, count=count)
        result[rows] = np.packbits(np.take(dense, place, axis=1), axis=1)
    return result


def _computed(
    covariance_a: MapCovariance,
    covariance_b: MapCovariance,
    closures: LoopClosures,
    gate: float,
    panels: Sequence[Panel],
    width: int,
) -> Iterator[UInt8[np.ndarray, "rows bytes"]]:
    """The bits of each of `panels`; the device works on one while the next is prepared."""
    if not panels:
        return
    module = lie.module_of(closures.group)
    side_a = _Side(covariance_a, np.asarray(closures.pose_a), width)
    side_b = _Side(covariance_b, np.asarray(closures.pose_b), width)
    rows = -(-panels[0].count // width) * width
    placed = _on_device(closures, side_a, side_b, rows)
    by_freedom = device_array(gates(float(gate), closures.tangent_dim))
    running: Any = None
    for panel in panels:
        columns = side_a.columns(panel), side_b.columns(panel)
        if running is not None:
            yield _packed(*running)
        bounds = device_array([panel.start, panel.count], np.int32)
        running = panel, _within_gate(module, placed, *columns, bounds, by_freedom)
    yield _packed(*running)


def _packed(panel: Panel, within: Bool[Array, "rows width"]) -> UInt8[np.ndarray, "rows bytes"]:
    dense = np.asarray(within)[panel.start : panel.count, : panel.stop - panel.start]
    return np.packbits(dense, axis=1)


class _Columns(NamedTuple):
    """One map's share of a panel: G of all touched poses with those of the panel, packed.

    Attributes:
        relative_covariance: `[d(d+1)/2, k, c]`; rows of poses that no u touches are not set.
        column: int32 `[width]`, of each closure v.
    """

    relative_covariance: Float[Array, "packed k c"]
    column: Int[Array, " width"]


class _Placed(NamedTuple):
    """All closures: `per_closure`, `carried`, and their poses' rows in `_Columns`; padded."""

    transform: Float[Array, "p m"]
    noise: Float[Array, "packed m"]
    free: Float[Array, "f d m"] | None
    row_a: Int[Array, " m"]
    row_b: Int[Array, " m"]


class _Side:
    """One map: panels of G from the sparse factor of its information.

    Rows are the touched poses in the order of their last use, so that what later panels need is
    always what comes last.

    Args:
        covariance: of the map.
        touching: `[m]` the pose that each closure touches.
        width: closures in a panel.
    """

    def __init__(self, covariance: MapCovariance, touching: Int[np.ndarray, " m"], width: int):
        touched, from_end, index = np.unique(touching[::-1], return_index=True, return_inverse=True)
        by_last_use = np.argsort(-from_end)
        self._covariance, self._width = covariance, width
        self._touched = touched[by_last_use]
        self.row = np.argsort(by_last_use)[index[::-1]]
        starts = range(0, len(touching), width)
        self._most = max(len(np.unique(self.row[start : start + width])) for start in starts)
        self.poses = lie.take(covariance.frame, touching)
        own = covariance.diagonal(self._touched, side="left")
        self._own = np.stack([own[:, i, j] for i, j in unrolled.packed_indices(own.shape[1])])

    def columns(self, panel: Panel) -> _Columns:
        """Puts what the panel's pairs need of this map on the device."""
        rows, column = np.unique(self.row[panel.start : panel.stop], return_inverse=True)
        solution = self._covariance.columns(self._touched[rows], side="left")
        column = pad_leading(column, self._width)
        first = int(self.row[panel.start :].min())
        packed = self._relative_covariance(solution, rows, first)
        return _Columns(device_array(packed), device_array(column, np.int32))

    def _relative_covariance(
        self, solution: CovarianceColumns, columns: np.ndarray, first: int
    ) -> Float[np.ndarray, "packed k most"]:
        """G of the rows from `first` on, from columns of left covariances."""
        k, count = len(self._touched), len(columns)
        packed = shareable_zeros((len(self._own), k, self._most))
        d = self._covariance.pose_graph.tangent_dim
        for start in range(first, k, ROWS_AT_ONCE):
            rows = slice(start, min(start + ROWS_AT_ONCE, k))
            cross = solution.rows(self._touched[rows], side="left")
            for entry, (i, j) in enumerate(unrolled.packed_indices(d)):
                own = self._own[entry, rows, None] + self._own[entry, columns]
                packed[entry, rows, :count] = own - (cross[:, i, j] + cross[:, j, i])
        return packed


class _Closures(NamedTuple):
    """The closures as `per_closure` takes them."""

    measurement: Any
    measurement_covariance: Float[Array, "m d d"]
    pose_a: Any
    pose_b: Any
    free: Float[Array, "m d f"] | None


def _on_device(closures: LoopClosures, side_a: _Side, side_b: _Side, size: int) -> _Placed:
    covariance, free = noise_of(np.asarray(closures.information, dtype=np.float64))
    given = _Closures(
        padded(lie.as_numpy(closures.measurement), size),
        device_array(pad_leading(covariance, size)),
        padded(side_a.poses, size),
        padded(side_b.poses, size),
        None if free is None else device_array(pad_leading(free, size)),
    )
    rows = (pad_leading(side.row, size) for side in (side_a, side_b))
    return _Placed(*_per_closure(given), *(device_array(row, np.int32) for row in rows))


@jax.jit
def _per_closure(closures: _Closures) -> tuple[Any, Any, Any]:
    return *per_closure(closures), carried(closures)


@functools.partial(jax.jit, static_argnames="module")
def _within_gate(
    module: ModuleType,
    placed: _Placed,
    side_a: _Columns,
    side_b: _Columns,
    bounds: Int[Array, "2"],
    gate: Float[Array, " d+1"],
) -> Bool[Array, "m width"]:
    """Finds which u agree with each v of a panel; false before the panel's own rows.

    Args:
        module: of the group.
        placed: all closures.
        side_a, side_b: of the panel.
        bounds: its start, and the number of closures.
        gate: of pairs of 0 … d degrees of freedom.
    """
    start, count = bounds
    width = side_a.column.shape[0]
    v = start + jnp.arange(width)

    def tile(block: Any, within: Any) -> Any:
        u = block * TILE + jnp.arange(TILE)
        sides = (
            gather(side_a.relative_covariance, placed.row_a[u], side_a.column),
            gather(side_b.relative_covariance, placed.row_b[u], side_b.column),
            None,
        )
        both = weigh(module, placed.transform, placed.noise, (u, v), sides, placed.free)
        agree = _within(both[0], gate) & _within(both[1], gate) & (u[:, None] != v)
        return jax.lax.dynamic_update_slice_in_dim(within, agree, block * TILE, 0)

    within = jnp.zeros((placed.row_a.shape[0], width), bool)
    return jax.lax.fori_loop(start // TILE, -(-count // TILE), tile, within)


def _within(found: Any, gate: Float[Array, " d+1"]) -> Bool[Array, "r c"]:
    if not isinstance(found, Limit):
        return found <= gate[-1]
    return found.squared <= gate[found.freedom.astype(np.int32)]


def _stamp(
    map_a: PoseGraph, map_b: PoseGraph, closures: LoopClosures, gate: float, panel: int
) -> str:
    """A digest of all that the bits and their cut into panels depend on."""
    maps = [(m.poses, m.tail, m.head, m.measurement, m.information) for m in (map_a, map_b)]
    pairs = closures.pose_a, closures.pose_b, closures.measurement, closures.information
    return digest((FORMAT, closures.group, float(gate), panel), *jax.tree.leaves((maps, pairs)))


def _name(panel: Panel) -> str:
    return f"{panel.start:08d}"


def _kept(store: Store, panel: Panel) -> UInt8[np.ndarray, "rows bytes"] | None:
    """A panel's bits, mapped from its file; None if there is none, or one of another shape."""
    within = store.read_array(_name(panel))
    return within if within is not None and within.shape == panel.shape else None
