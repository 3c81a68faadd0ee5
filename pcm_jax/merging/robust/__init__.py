"""Robust merging: every closure stays in the graph, with as much information as it deserves.

weights   how much a closure counts, given how badly it fits: the published kernels
methods   the methods by name: their weights, their parameters, what accepts a closure
solve     weights and solves in turn, until both have settled
"""

from pcm_jax.merging.robust.methods import ROBUST_METHODS
from pcm_jax.merging.robust.solve import RobustSolution, solve_robustly

__all__ = ["ROBUST_METHODS", "RobustSolution", "solve_robustly"]
