"""Step i: each robot's map by itself, and how certain its poses are.

Data walks through this folder once:

    initialization   poses to start from (chordal relaxation, spanning tree)
    linearization    residuals of the edges and their Jacobians, in closed form
    gauss_newton     the optimistix solver that steps on the manifold
    normal_equations the linear system of a step, as lineax operator and solvers
    symbolic, assembly, cholesky   the block Cholesky factorisation: tree, plan, numbers
    least_squares    padding and one compiled call around all of these
    optimization     `optimize`, what users call
    marginals        `joint_marginal_covariance` of some poses at the optimum
"""

from pcm_jax.mapping.marginals import joint_marginal_covariance
from pcm_jax.mapping.optimization import Solution, optimize

__all__ = ["Solution", "joint_marginal_covariance", "optimize"]
