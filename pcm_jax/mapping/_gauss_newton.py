"""Gauss-Newton and Levenberg-Marquardt on the manifold, as an optimistix solver.

Each step linearises at the poses `X`, solves for `δ` and retracts:

    Gauss-Newton          JᵀJ δ = −Jᵀ r                        X ← X exp(δ)
    Levenberg-Marquardt   (JᵀJ + λ diag(JᵀJ)) δ = −Jᵀ r        only if the cost falls

The descent (how δ is found) and the search (whether it is accepted, and λ) are optimistix's own
extension points; damping relative to the diagonal needs its own descent, since poses mix metres
and radians. Everything runs inside one compiled loop; the host is called once per step, for the
factorisation.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from pcm_jax.mapping._linearization import Edges, linearize, retract, whitened_residual
from pcm_jax.mapping._normal_equations import (
    BlockCholesky,
    BlockJacobian,
    Cholmod,
    DampedJacobian,
)
from pcm_jax.mapping._stepwise import FIRST_DAMPING, GROWING, HIGH_CUTOFF, at_rest


class Problem(eqx.Module):
    """The solver's `args`: the structured least-squares problem, padded.

    Attributes:
        edges: measurements; padded ones weigh nothing.
        free: `[n]` poses that may move.
        counts: poses and edges that are no padding, `[2]`.
        max_steps: evaluations of the cost after which to give up; traced, so that no other value
            is compiled for.
    """

    edges: Edges
    free: Bool[Array, " n"]
    counts: Int[Array, "2"]
    max_steps: Int[Array, ""]


def _linearize(poses: Any, problem: Problem) -> Any:
    residual, by_tail, by_head = linearize(poses, problem.edges)
    ends = problem.edges.tail, problem.edges.head
    jacobian = BlockJacobian(*ends, by_tail, by_head, problem.free, problem.counts)
    return optx.FunctionInfo.ResidualJac(residual, jacobian)


class RelativelyDampedDescent(optx.AbstractDescent):
    """`−(JᵀJ + λ diag(JᵀJ))⁻¹ Jᵀ r` with λ = `first_damping` / step size (Marquardt 1963).

    Attributes:
        linear_solver: `BlockCholesky` or `Cholmod`.
        first_damping: λ at step size 1, where optimistix's trust region starts.
    """

    linear_solver: lx.AbstractLinearSolver
    first_damping: float = FIRST_DAMPING

    def init(self, y: Any, f_info_struct: Any) -> Any:
        """A linearisation of zeros."""
        del y
        return _zeros(f_info_struct)

    def query(self, y: Any, f_info: Any, state: Any) -> Any:
        """Keeps the linearisation: the step depends on λ."""
        del y, state
        return f_info

    def step(self, step_size: Array, state: Any) -> tuple[Array, optx.RESULTS]:
        """δ for λ = `first_damping` / `step_size`."""
        residual = state.residual
        damping = jnp.asarray(self.first_damping / step_size, residual.dtype)
        below = _zeros(state.jac.in_structure())
        damped = DampedJacobian(state.jac, damping)
        solution = lx.linear_solve(damped, (residual, below), self.linear_solver, throw=False)
        return -solution.value, optx.RESULTS.promote(solution.result)


class _State(eqx.Module):
    first_step: Bool[Array, ""]
    candidate: Any  # poses that the next step judges
    delta: Float[Array, "n d"]  # how they were reached
    f_info: Any  # linearisation at the accepted poses
    descent_state: Any
    search_state: Any
    initial_cost: Float[Array, ""]
    steps: Int[Array, ""]
    accepted: Int[Array, ""]
    terminate: Bool[Array, ""]
    result: optx.RESULTS


def _zeros(struct: Any) -> Any:
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), struct)


class ManifoldGaussNewton(optx.AbstractLeastSquaresSolver):
    """Gauss-Newton on poses; with a damped descent and a trust region, Levenberg-Marquardt.

    `args` is a `Problem`, `y` a batch of poses, and `fn(y, args)` must be
    `whitened_residual(y, args.edges)`, whose Jacobian is known here in closed form. Stops when an
    accepted step changes the cost by less than `rtol` of it, or when a step moves no coordinate
    (metres, radians) by more than `atol`; a position by no more than that and what rounding leaves
    of it, which at UTM's coordinates is above any fixed tolerance.

    Attributes:
        rtol, atol: tolerances.
        descent: how a step is found.
        search: whether it is accepted, and the next step size.
        norm: largest coordinate; optimistix's protocol.
    """

    rtol: float
    atol: float
    descent: optx.AbstractDescent
    search: optx.AbstractSearch
    norm: Callable[[Any], Array] = optx.max_norm

    def init(
        self,
        fn: Any,
        y: Any,
        args: Problem,
        options: Any,
        f_struct: Any,
        aux_struct: Any,
        tags: Any,
    ) -> _State:
        """The state before any evaluation."""
        del fn, options, f_struct, aux_struct, tags
        struct = jax.eval_shape(_linearize, y, args)
        delta = _zeros(struct.jac.in_structure())
        return _State(
            first_step=jnp.array(True),
            candidate=y,
            delta=delta,
            f_info=_zeros(struct),
            descent_state=self.descent.init(delta, struct),
            search_state=self.search.init(delta, struct),
            initial_cost=jnp.zeros((), delta.dtype),
            steps=jnp.array(0),
            accepted=jnp.array(0),
            terminate=jnp.array(False),
            result=optx.RESULTS.successful,
        )

    def step(
        self, fn: Any, y: Any, args: Problem, options: Any, state: _State, tags: Any
    ) -> tuple[Any, _State, None]:
        """Judges the candidate, then proposes the next one."""
        del fn, options, tags
        f_eval = _linearize(state.candidate, args)
        step_size, accept, search_result, search_state = self.search.step(
            state.first_step,
            jnp.zeros_like(state.delta),
            state.delta,
            state.f_info,
            f_eval,
            state.search_state,
        )
        before, cost = state.f_info.as_min(), f_eval.as_min()
        unchanged = accept & (jnp.abs(before - cost) <= self.rtol * before)
        settled = unchanged | at_rest(state.delta, y, self.atol)
        terminate = settled & ~state.first_step
        y, f_info = _choose(accept, (state.candidate, f_eval), (y, state.f_info))
        out_of_steps = ~terminate & (state.steps + 1 >= args.max_steps)
        descent_state, delta = jax.lax.cond(
            terminate | out_of_steps,
            lambda: (state.descent_state, state.delta),
            lambda: self._descend(accept, f_info, step_size, state.descent_state),
        )
        failed = accept & ~jnp.isfinite(cost)
        result = optx.RESULTS.where(failed, optx.RESULTS.nonfinite, search_result)
        gave_up = optx.RESULTS.nonlinear_max_steps_reached
        result = optx.RESULTS.where(out_of_steps & ~failed, gave_up, result)
        return (
            y,
            _State(
                first_step=jnp.array(False),
                candidate=retract(y, delta),
                delta=delta,
                f_info=f_info,
                descent_state=descent_state,
                search_state=search_state,
                initial_cost=jnp.where(state.first_step, cost, state.initial_cost),
                steps=state.steps + 1,
                accepted=state.accepted + (accept & ~state.first_step),
                terminate=terminate,
                result=result,
            ),
            None,
        )

    def _descend(
        self, accept: Array, f_info: Any, step_size: Array, descent_state: Any
    ) -> tuple[Any, Array]:
        descent_state = jax.lax.cond(
            accept,
            lambda old: self.descent.query(old, f_info, old),
            lambda old: old,
            descent_state,
        )
        # A step that was not found is NaN, and judged as such: its status says no more.
        delta, _ = self.descent.step(step_size, descent_state)
        return descent_state, delta

    def terminate(
        self, fn: Any, y: Any, args: Problem, options: Any, state: _State, tags: Any
    ) -> tuple[Array, optx.RESULTS]:
        """True once a step has settled; and what went wrong, if anything did."""
        del fn, y, args, options, tags
        return state.terminate, state.result

    def postprocess(
        self,
        fn: Any,
        y: Any,
        aux: Any,
        args: Problem,
        options: Any,
        state: _State,
        tags: Any,
        result: optx.RESULTS,
    ) -> tuple[Any, Any, dict[str, Any]]:
        """Costs (half the sum of squares) and the number of accepted steps, as statistics."""
        del fn, args, options, tags, result
        costs = {"initial_cost": state.initial_cost, "cost": state.f_info.as_min()}
        return y, aux, {**costs, "accepted_steps": state.accepted}


def _choose(predicate: Array, when_true: Any, when_false: Any) -> Any:
    return jax.lax.cond(predicate, lambda: when_true, lambda: when_false)


def least_squares(
    start: Any, problem: Problem, *, solver: str, engine: str, rtol: float, atol: float
) -> optx.Solution:
    """Minimises half the sum of squares of `whitened_residual` by optimistix.

    Args:
        start: poses, Lie `[n]`.
        problem: see there.
        solver: "gauss-newton": full steps, every one accepted; or "levenberg-marquardt": damped
            steps, accepted by optimistix's classical trust region.
        engine: "blocks" or "cholmod".
        rtol, atol: see `ManifoldGaussNewton`.
    """
    linear = {"blocks": BlockCholesky, "cholmod": Cholmod}[engine]()
    descent, search = {
        "gauss-newton": lambda: (optx.NewtonDescent(linear_solver=linear), optx.LearningRate(1.0)),
        "levenberg-marquardt": lambda: (
            RelativelyDampedDescent(linear),
            optx.ClassicalTrustRegion(high_cutoff=HIGH_CUTOFF, high_constant=GROWING),
        ),
    }[solver]()
    return optx.least_squares(
        lambda poses, args: whitened_residual(poses, args.edges),
        ManifoldGaussNewton(rtol=rtol, atol=atol, descent=descent, search=search),
        start,
        problem,
        max_steps=None,  # the problem has its own
        throw=False,
    )
