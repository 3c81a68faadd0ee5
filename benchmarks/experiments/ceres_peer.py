"""Planar pose graphs by Ceres through pyceres, whose wheel has no factor of pose graphs.

So the residual, ours, is written in Python and called edge by edge, which is most of the time.
Levenberg-Marquardt with next to no damping, sparse normal equations, CHOLMOD, one thread.
"""

from __future__ import annotations

from collections.abc import Callable
from math import cos, pi, sin, tan
from typing import Any

import jaxlie
import numpy as np

from benchmarks.suite.gtsam_peer import TOLERANCE, PlainGraph
from pcm_jax import lie
from pcm_jax.mapping._linearization import whitening_of

try:
    import pyceres  # pyright: ignore[reportMissingImports]
except ImportError:
    pyceres: Any = None

RADIUS = 1e16
"""Of the trust region: next to no damping."""


def contestant(graph: PlainGraph) -> Callable[[], Callable[[], Callable[[], np.ndarray]]]:
    """Gets ready and returns the solve, which returns what reads the poses off, as matrices."""
    start = _planar(graph.poses)
    values = [row.copy() for row in start]
    problem = pyceres.Problem()
    whitening = np.moveaxis(whitening_of(graph.information), -1, 0)
    ends = zip(graph.tail.tolist(), graph.head.tolist(), strict=True)
    between = _between()
    for (tail, head), measured, white in zip(
        ends, _planar(graph.measurement), whitening, strict=True
    ):
        cost = between(measured.tolist(), white)
        problem.add_residual_block(cost, None, [values[tail], values[head]])
    problem.set_parameter_block_constant(values[0])
    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.SPARSE_NORMAL_CHOLESKY
    options.function_tolerance = TOLERANCE
    options.initial_trust_region_radius = options.max_trust_region_radius = RADIUS
    options.num_threads = 1

    def ready() -> Callable[[], Callable[[], np.ndarray]]:
        for value, row in zip(values, start, strict=True):
            value[:] = row
        return solve

    def solve() -> Callable[[], np.ndarray]:
        pyceres.solve(options, problem, pyceres.SolverSummary())
        return lambda: _matrices(np.array(values))

    return ready


def _between() -> type:
    """The cost function, a class of pyceres, which may be absent."""

    class Between(pyceres.CostFunction):
        """Lᵀ Log(z⁻¹ X_i⁻¹ X_j) by (x, y, θ) of both poses."""

        def __init__(self, measured: list[float], whitening: np.ndarray) -> None:
            super().__init__()
            self.set_num_residuals(3)
            self.set_parameter_block_sizes([3, 3])
            self.measured, self.whitening = measured, whitening

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:  # noqa: N802
            """Called by Ceres."""
            residual, by_tail, by_head = _log_of_loop(parameters[0], parameters[1], self.measured)
            residuals[:] = self.whitening @ residual
            for place, by in zip(jacobians or (), (by_tail, by_head), strict=False):
                if place is not None:
                    place[:] = (self.whitening @ by).ravel()
            return True

    return Between


def _log_of_loop(
    tail: np.ndarray, head: np.ndarray, measured: list[float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log(z⁻¹ X_i⁻¹ X_j) of (x, y, θ), and its derivatives by both."""
    c, s = cos(tail[2]), sin(tail[2])
    seen_c, seen_s = cos(measured[2]), sin(measured[2])
    away = head[0] - tail[0], head[1] - tail[1]
    seen = c * away[0] + s * away[1], c * away[1] - s * away[0]
    off = seen[0] - measured[0], seen[1] - measured[1]
    place = np.array([seen_c * off[0] + seen_s * off[1], seen_c * off[1] - seen_s * off[0]])
    angle = (head[2] - tail[2] - measured[2] + pi) % (2.0 * pi) - pi
    half = 0.5 * angle
    small = abs(half) < 1e-5
    scale = 1.0 - half * half / 3.0 if small else half / tan(half)
    slope = -half / 3.0 if small else 0.5 * (1.0 / tan(half) - half / sin(half) ** 2)
    left = np.array([[scale, half], [-half, scale]])
    turned = np.array([[slope, 0.5], [-0.5, slope]]) @ place
    into = left @ np.array([[seen_c, seen_s], [-seen_s, seen_c]])
    by_place = into @ np.array([[c, s], [-s, c]])
    by_tail, by_head = np.zeros((3, 3)), np.zeros((3, 3))
    by_head[:2, :2], by_head[:2, 2], by_head[2, 2] = by_place, turned, 1.0
    by_tail[:2, :2], by_tail[2, 2] = -by_place, -1.0
    by_tail[:2, 2] = into @ np.array([seen[1], -seen[0]]) - turned
    return np.array([*(left @ place), angle]), by_tail, by_head


def _planar(matrices: np.ndarray) -> np.ndarray:
    """(x, y, θ) of homogeneous matrices."""
    angle = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    return np.stack([matrices[:, 0, 2], matrices[:, 1, 2], angle], axis=1)


def _matrices(planar: np.ndarray) -> np.ndarray:
    x, y, angle = planar.T
    stacked: Any = np.stack([np.cos(angle), np.sin(angle), x, y], axis=1)
    return np.asarray(lie.as_matrix(jaxlie.SE2(stacked)))
