"""Step i: each robot's map by itself, and how certain its poses are.

Data walks through this folder once:

    initialization      poses to start from (chordal relaxation, spanning tree)
    _linearization      residuals of the edges and their Jacobians, in closed form
    _host_step          the linear system of a step, assembled, factorised and solved on the host
    _stepwise           both solvers in NumPy, for problems that are not worth a compilation
    _callbacks          host code called from a compiled program, on any device
    _normal_equations   the system of a step as lineax operator and solvers, for the compiled loop
    _gauss_newton       the optimistix solver that steps on the manifold
    least_squares       padding and one compiled call around all of these
    priors              measurements of single poses: where they put a map, what they leave free
    certificate         whether no other poses can fit better
    optimization        `optimize`, what users call
    _odometry           the steps by which a map has grown
    _lost_digits        the share of covariances that rounding takes
    covariance_factor   the factor of the information matrix at the optimum
    _pair_covariances   the joint covariances of many pairs of poses
    covariance          `MapCovariance` of the poses at the optimum
    first_order         the first step as loops come, by the factor of before
    implicit            the optimum as a differentiable function of its data
"""

from pcm_jax.mapping.certificate import Certificate, certify
from pcm_jax.mapping.covariance import MapCovariance, joint_marginal_covariance
from pcm_jax.mapping.optimization import Solution, optimize

__all__ = [
    "Certificate",
    "MapCovariance",
    "Solution",
    "certify",
    "joint_marginal_covariance",
    "optimize",
]
