"""Pose graphs by SymForce's optimiser (C++), which takes one sparse factor of a whole graph.

SymForce is written to generate C++; from Python its factors call back. Called edge by edge they
are slower by far, so all edges are one factor here, linearised in NumPy by our kernel: the
residuals are ours and GTSAM's, and SymForce's own are its sparse factorisation, its steps and its
poses. Levenberg-Marquardt with next to no damping, which is Gauss-Newton.

SymForce retracts `(R exp(ω), t + v)`, rotation first: with ours, `T exp(v', ω)`, v = R v'.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.sparse import csc_array, csc_matrix

from benchmarks.suite.gtsam_peer import TOLERANCE
from pcm_jax import PoseGraph, lie
from pcm_jax.mapping._linearization import Edges, linearize
from pcm_jax.mapping.least_squares import padded_edges
from pcm_jax.mapping.optimization import host_arrays

try:
    import cc_sym  # pyright: ignore[reportMissingImports]
    import sym  # pyright: ignore[reportMissingImports]

    cc_sym.set_log_level("critical")  # at its end it would print how long each of its steps took
except ImportError:
    cc_sym: Any = None
    sym: Any = None

LEAST_DAMPING = 1e-8


def contestant(graph: PoseGraph) -> Callable[[], Callable[[], Callable[[], np.ndarray]]]:
    """Gets ready and returns the solve, which returns what reads the poses off, as matrices."""
    parameters = cc_sym.default_optimizer_params()
    parameters.initial_lambda = LEAST_DAMPING
    parameters.early_exit_min_reduction = TOLERANCE
    keys = [cc_sym.Key("x", pose) for pose in range(graph.num_poses)]
    factor = cc_sym.Factor(_WholeGraph(graph), keys, keys[1:], sparse=True)
    optimizer = cc_sym.Optimizer(parameters, [factor])

    def ready() -> Callable[[], Callable[[], np.ndarray]]:
        values = _values(keys, graph)

        def solve() -> Callable[[], np.ndarray]:
            optimizer.optimize(values)
            return lambda: np.asarray(lie.as_matrix(_poses(values, graph)))

        return solve

    return ready


def _values(keys: list[Any], graph: PoseGraph) -> Any:
    """The graph's own poses."""
    values = cc_sym.Values()
    for key, row in zip(keys, np.asarray(lie.parameters(graph.poses)), strict=True):
        if graph.tangent_dim == 6:
            values.set(key, sym.Pose3(R=sym.Rot3([*row[1:4], row[0]]), t=row[4:]))
        else:
            values.set(key, sym.Pose2(R=sym.Rot2(row[:2]), t=row[2:]))
    return values


def _poses(values: Any, graph: PoseGraph) -> Any:
    stored = np.asarray(values.data()).reshape(graph.num_poses, -1)
    if graph.tangent_dim == 6:
        stored = stored[:, [3, 0, 1, 2, 4, 5, 6]]
    return lie.group_of(graph.poses)(stored)


class _WholeGraph:
    """Residuals, J, the lower half of JᵀJ, and Jᵀr, with patterns found once; first pose held."""

    def __init__(self, graph: PoseGraph) -> None:
        self.graph = graph
        self.edges: Edges = padded_edges(*host_arrays(graph), size=graph.num_edges)
        tail, head, d = np.asarray(graph.tail), np.asarray(graph.head), graph.tangent_dim
        rows, free = np.arange(graph.num_edges), (graph.num_poses - 1) * d
        shape = (graph.num_edges * d, free)
        self.jacobian = _Pattern(d, np.tile(rows, 2), np.concatenate([tail, head]) - 1, shape)
        row = np.concatenate([tail, head, np.maximum(tail, head)]) - 1
        column = np.concatenate([tail, head, np.minimum(tail, head)]) - 1
        self.hessian = _Pattern(d, row, column, (free, free), lower=True)

    def __call__(self, values: Any, _entries: Any = None) -> tuple[Any, ...]:
        poses = _poses(values, self.graph)
        residual, by_tail, by_head = linearize(poses, self.edges)
        k = lie.module_of(lie.group_of(poses)).MATRIX_DIM - 1
        rotation = np.asarray(lie.as_matrix(poses))[:, :k, :k]
        tail, head = (
            _in_chart(np.moveaxis(np.asarray(by), -1, 0), rotation[ends])
            for by, ends in ((by_tail, self.graph.tail), (by_head, self.graph.head))
        )
        jacobian = self.jacobian.filled(np.concatenate([tail, head]))
        first_is_later = np.asarray(self.graph.tail) > np.asarray(self.graph.head)
        across = head.swapaxes(1, 2) @ tail
        across = np.where(first_is_later[:, None, None], across.swapaxes(1, 2), across)
        products = [tail.swapaxes(1, 2) @ tail, head.swapaxes(1, 2) @ head, across]
        whitened = np.asarray(residual).T.ravel()
        hessian = self.hessian.filled(np.concatenate(products))
        return whitened, jacobian, hessian, jacobian.T @ whitened


def _in_chart(by: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Derivatives by (ω, v) from those by our right perturbations (v', ω)."""
    k = rotation.shape[-1]
    return np.concatenate([by[..., k:], by[..., :k] @ rotation.swapaxes(1, 2)], axis=-1)


class _Pattern:
    """Places of the entries of blocks in a sparse matrix by columns; negative blocks have none."""

    def __init__(
        self,
        d: int,
        row: np.ndarray,
        column: np.ndarray,
        shape: tuple[int, int],
        lower: bool = False,
    ) -> None:
        inner = np.arange(d)
        rows = np.broadcast_to((row[:, None] * d + inner)[:, :, None], (len(row), d, d))
        columns = np.broadcast_to((column[:, None] * d + inner)[:, None, :], (len(row), d, d))
        self.kept = (rows >= 0) & (columns >= 0) & ((rows >= columns) | (not lower))
        code = columns[self.kept].astype(np.int64) * shape[0] + rows[self.kept]
        entries, self.position = np.unique(code, return_inverse=True)
        starts = np.searchsorted(entries // shape[0], np.arange(shape[1] + 1))
        self.pattern = csc_array(
            (np.zeros(len(entries)), (entries % shape[0]).astype(np.int32), starts), shape=shape
        )

    def filled(self, blocks: np.ndarray) -> csc_matrix:
        """The matrix of the blocks' sums."""
        size = len(self.pattern.indices)
        summed = np.bincount(self.position, blocks[self.kept], minlength=size)
        pattern = self.pattern
        return csc_matrix((summed, pattern.indices, pattern.indptr), shape=pattern.shape)
