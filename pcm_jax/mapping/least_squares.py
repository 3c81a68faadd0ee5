"""The host's side of a solve: padding, one compiled call, the result.

`PoseProblem` takes any graph of poses, one map or several merged ones; `optimize` and the merge are
thin callers. Robust methods solve one problem again and again, with other weights of its edges.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import bucket, on_host
from pcm_jax.compiling import is_worth_compiling
from pcm_jax.errors import InputError, check_choice
from pcm_jax.graph.priors import Priors
from pcm_jax.mapping._linearization import Edges, whitened_residual, whitening_of
from pcm_jax.mapping._stepwise import Stepped, minimize, step_twice
from pcm_jax.sparse import registry

SOLVERS = ("gauss-newton", "levenberg-marquardt")
ENGINES = ("blocks", "cholmod")
RTOL = 1e-9
ATOL = 1e-9
MAX_STEPS = 100

SECONDS_AN_EDGE = {3: 3e-5, 6: 6e-5}
"""About what a solve takes in NumPy, by tangent dimensions."""

SMALLEST_PADDED = 256
FINE_ABOVE = 4096
"""Kernels cost little beside the factorisation, which is not padded: few sizes are worth more."""


def padded_size(poses: int, edges: int) -> int:
    """The number of poses, and of edges, that the kernels see: one size for both."""
    return bucket(max(poses, edges), smallest=SMALLEST_PADDED, fine_above=FINE_ABOVE)


def padded_poses(poses: int, edges: int) -> int:
    """The number of poses that the solver sees: as many as edges, or in large graphs fewer.

    CHOLMOD factorises the rows of padded poses too, and they would be half of City10000's.
    """
    return min(padded_size(poses, edges), padded_size(poses, FINE_ABOVE))


class Framed(NamedTuple):
    """The measurements of a problem and the poses that stay.

    Attributes:
        tail, head: `[e]`.
        measurement: Lie `[e]`, NumPy.
        information: `[e, d, d]`.
        fixed: bool `[n]`.
    """

    tail: Int[np.ndarray, " e"]
    head: Int[np.ndarray, " e"]
    measurement: Any
    information: Float[np.ndarray, "e d d"]
    fixed: Bool[np.ndarray, " n"]

    def with_priors(self, priors: Priors) -> Framed:
        """Adds a last pose, the frame, which stays, and an edge from it for every prior."""
        frame = np.full(len(priors), len(self.fixed))
        measurements = [lie.as_numpy(self.measurement), lie.as_numpy(priors.measurement)]
        return Framed(
            np.concatenate([self.tail, frame]),
            np.concatenate([self.head, priors.pose]),
            lie.concatenate(measurements),
            np.concatenate([np.asarray(self.information), priors.information]),
            np.append(self.fixed, True),
        )


def with_frame(poses: Any, size: int) -> Any:
    """The poses, Lie `[size]`, NumPy: with the identity at their end where one is missing."""
    given = lie.as_numpy(poses)
    if len(lie.parameters(given)) == size:
        return given
    return lie.concatenate([given, lie.identity(lie.group_of(given), (1,))])


class Solved(NamedTuple):
    """The result of `PoseProblem.solve`, on the host.

    Attributes:
        poses: Lie `[n]`, NumPy; of the problem's own poses, without the frame's.
        initial_cost, cost: 0.5 Σ rᵀΩr before and after.
        iterations: accepted steps.
        converged: whether a tolerance was met.
    """

    poses: Any
    initial_cost: float
    cost: float
    iterations: int
    converged: bool


def check_names(solver: str, engine: str) -> None:
    """Raises InputError unless solver and engine are known, and the engine's extra installed."""
    check_choice("solver", solver, SOLVERS)
    check_choice("engine", engine, ENGINES)
    if engine == "cholmod":
        try:
            import sparsax  # noqa: F401
        except ImportError as error:
            raise InputError(
                "engine: 'cholmod' needs the package sparsax: pip install '.[cholmod]'"
            ) from error


class PoseProblem:
    """Residuals between poses, planned and padded once, to be solved as often as asked.

    Args:
        tail, head: `[e]`.
        measurement: Lie `[e]`.
        information: `[e, d, d]`, of the right perturbation of the measurement.
        fixed: `[n]` poses that stay; at least one in every connected part, if there are no priors.
        priors: measurements of single poses, `r = Log(z⁻¹ X)`: edges from the frame itself, which
            is a pose at the identity that stays.
    """

    def __init__(
        self,
        tail: Int[np.ndarray, " e"],
        head: Int[np.ndarray, " e"],
        measurement: Any,
        information: Float[np.ndarray, "e d d"],
        fixed: Bool[np.ndarray, " n"],
        *,
        priors: Priors | None = None,
    ):
        given = Framed(np.asarray(tail), np.asarray(head), measurement, information, fixed)
        self._given = len(given.tail), len(given.fixed)
        if priors is not None:
            given = given.with_priors(priors)
        tail, head, measurement, information, held = given
        self._poses, self._edges = len(held), len(tail)
        size = padded_size(self._poses, self._edges)
        self._size = padded_poses(self._poses, self._edges)
        self._free = np.pad(~held, (0, self._size - self._poses))
        self._padded = padded_edges(tail, head, measurement, information, size=size)

    @on_host
    def solve(
        self,
        poses: Any,
        *,
        scale: Float[np.ndarray, " e"] | None = None,
        solver: str = "gauss-newton",
        engine: str = "blocks",
        rtol: float = RTOL,
        atol: float = ATOL,
        max_steps: int = MAX_STEPS,
    ) -> Solved:
        """Minimises 0.5 Σ s² rᵀΩr, r = Log(z⁻¹ X_i⁻¹ X_j), from the given poses.

        Args:
            poses: Lie `[n]`.
            scale: s of each edge; None: all 1.
            solver: "gauss-newton" or "levenberg-marquardt".
            engine: "blocks" or "cholmod".
            rtol, atol: see `ManifoldGaussNewton`.
            max_steps: evaluations after which to give up.

        Raises:
            InputError: an unknown name, or an engine that is not installed.
        """
        check_names(solver, engine)
        if engine == ENGINES[0] and not self._is_compiled():
            limits = {"rtol": rtol, "atol": atol, "max_steps": max_steps}
            found = minimize(
                with_frame(poses, self._poses),
                self._scaled(scale).part(slice(self._edges)),
                self._free[: self._poses],
                damped=solver == SOLVERS[1],
                **limits,
            )
            registry.spare.free()
            return Solved(lie.take(found.poses, slice(0, self._given[1])), *found[1:])
        from pcm_jax.mapping._gauss_newton import Problem

        arrays: Any = (
            self._free,
            np.array([self._poses, self._edges], np.int32),
            np.asarray(max_steps),
        )
        problem = Problem(self._scaled(scale), *arrays)
        start = lie.pad_leading(with_frame(poses, self._poses), self._size)
        run = _compiled(solver, engine, rtol, atol)
        final, initial_cost, cost, steps, converged = jax.device_get(run(start, problem))
        registry.spare.free()
        return Solved(
            lie.take(lie.as_numpy(final), slice(0, self._given[1])),
            float(initial_cost),
            float(cost),
            int(steps),
            bool(converged),
        )

    @on_host
    def step_twice(self, poses: Any) -> Stepped:
        """Takes a step of Gauss-Newton, and another with the same factor; see `_stepwise`.

        Args:
            poses: Lie `[n]`, of a problem without priors.

        Raises:
            NotPositiveDefiniteError: there is no factor.
        """
        edges, free = self._padded.part(slice(self._edges)), self._free[: self._poses]
        found = step_twice(lie.as_numpy(poses), edges, free)
        registry.spare.free()
        return found

    @on_host
    def cost(self, poses: Any) -> float:
        """0.5 Σ rᵀΩr at the given poses.

        Args:
            poses: Lie `[n]`.
        """
        residual = whitened_residual(
            with_frame(poses, self._poses), self._padded.part(slice(self._edges))
        )
        return 0.5 * float(np.sum(np.square(residual)))

    def _is_compiled(self) -> bool:
        return is_worth_compiling(self._edges * SECONDS_AN_EDGE[len(self._padded.whitening)])

    def _scaled(self, scale: np.ndarray | None) -> Edges:
        if scale is None:
            return self._padded
        whitening: Any = np.array(self._padded.whitening)
        whitening[..., : self._given[0]] *= scale
        return dataclasses.replace(self._padded, whitening=whitening)


def padded_edges(
    tail: Int[np.ndarray, " e"],
    head: Int[np.ndarray, " e"],
    measurement: Any,
    information: Float[np.ndarray, "e d d"],
    *,
    size: int,
) -> Edges:
    """`size` edges in NumPy: those added join the first pose to itself, at no weight."""
    missing = size - len(tail)
    arrays: Any = (
        np.pad(tail.astype(np.int32), (0, missing)),
        np.pad(head.astype(np.int32), (0, missing)),
        lie.pad_leading(lie.as_numpy(measurement), size),
        np.pad(whitening_of(information), ((0, 0), (0, 0), (0, missing))),
    )
    return Edges(*arrays)


@functools.lru_cache(maxsize=64)
def _compiled(solver: str, engine: str, rtol: float, atol: float) -> Any:
    """The whole solve as one compiled program per padded size."""
    import optimistix as optx

    from pcm_jax.mapping._gauss_newton import least_squares

    options: Any = {"solver": solver, "engine": engine, "rtol": rtol, "atol": atol}

    @jax.jit
    def solve_poses(start: Any, problem: Any) -> Any:
        solution = least_squares(start, problem, **options)
        stats = solution.stats
        return (
            solution.value,
            stats["initial_cost"],
            stats["cost"],
            stats["accepted_steps"],
            solution.result == optx.RESULTS.successful,
        )

    return solve_poses
