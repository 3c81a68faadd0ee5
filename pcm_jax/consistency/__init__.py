"""Step ii of the paper: which pairs of inter-robot closures agree with each other?

Two closures between the same two robots close a loop: out along one, through one map, back along
the other, and home through the other map. If both are right, the loop's error is what the
uncertainty of the measurements and of the two maps explains. So, for every pair,

1. `consistency_problem` gathers on the host what the maps say of the poses the closures touch:
   where they are, and their joint covariance;
2. `squared_mahalanobis` weighs each pair's loop error by its covariance (eq. 4 of the paper,
   squared: what follows a chi-squared distribution);
3. `chi2_gate` says how large that may be for two right closures;
4. `consistency_graph` keeps an edge where a pair passes in both directions.

The largest set of closures that all agree, step iii, is the largest clique of that graph.

`within_problem` is step 1 for the loop closures inside one robot's own map, where a closure also
closes a loop with odometry alone (`squared_own_loops`). `squared_mahalanobis_of` does step 2 for
any residual of two measurements. `stream_consistency_graph` does 1, 2 and 4 together for tens of
thousands of closures, whose distances no memory holds.
"""

from pcm_jax.consistency.definition import loop_error, squared_mahalanobis_of
from pcm_jax.consistency.gate import chi2_gate
from pcm_jax.consistency.graph import consistency_graph, to_networkx
from pcm_jax.consistency.mahalanobis import squared_mahalanobis, squared_own_loops
from pcm_jax.consistency.problem import ConsistencyProblem, consistency_problem
from pcm_jax.consistency.streaming import PackedGraph, stream_consistency_graph
from pcm_jax.consistency.within import WithinProblem, odometry_edges, within_problem

__all__ = [
    "ConsistencyProblem",
    "PackedGraph",
    "WithinProblem",
    "chi2_gate",
    "consistency_graph",
    "consistency_problem",
    "loop_error",
    "odometry_edges",
    "squared_mahalanobis",
    "squared_mahalanobis_of",
    "squared_own_loops",
    "stream_consistency_graph",
    "to_networkx",
    "within_problem",
]
