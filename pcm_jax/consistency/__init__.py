"""Step ii: which pairs of inter-robot closures agree with each other.

Two closures between the same two robots close a loop: out along one, through one map, back along
the other, and home through the other map. If both are right, the loop's error is what the
uncertainty of the measurements and of the two maps explains. The largest set of closures that all
agree, step iii, is the largest clique of the graph of agreeing pairs.

_relative           G, the covariance of the differences of poses' errors, in one map
problem             `consistency_problem`: what Q needs of two maps and the closures between them
within              the same for the closures inside one robot's own map
limit               q² of closures that leave directions unsaid
definition          the loop error (eq. 4) by automatic differentiation: the specification
_closed_form        the same number without a Jacobian, for all pairs in one vectorised loop
mahalanobis         `squared_mahalanobis`: either of the two, compiled
_single_precision   what float32 would change
gate                `chi2_gate`: how large a squared distance two right closures may have
overstated          `narrowing`: a smaller gate where errors are stated too large
graph               `consistency_graph`: an edge where a pair passes in both directions
packed              `PackedGraph`: a graph of one bit a pair
streaming           all of it for tens of thousands of closures, panel by panel, straight to bits
shuffled            the pairs that agree once measurements are shuffled: what chance does
growing             `GrowingPair`: closures that come one by one, a row of Q each
growing_within      `GrowingWithin`: the same for closures inside one map
evidence            `Evidence`: what every pair of robots' closures say of each other
stacked             the errors of k closures about one alignment, and their covariance
joint               `joint_consistency`: whether all closures of a set can be right together
"""

from pcm_jax.consistency.definition import loop_error, squared_mahalanobis_of
from pcm_jax.consistency.evidence import Evidence, PairEvidence
from pcm_jax.consistency.gate import chi2_gate
from pcm_jax.consistency.graph import consistency_graph, to_networkx
from pcm_jax.consistency.growing import GrowingPair
from pcm_jax.consistency.growing_within import GrowingWithin
from pcm_jax.consistency.joint import (
    AlignmentDifference,
    JointConsistency,
    alignment_difference,
    joint_consistency,
)
from pcm_jax.consistency.mahalanobis import (
    freedom_of,
    squared_mahalanobis,
    squared_own_loops,
    squared_rows,
    weighed_on_host,
)
from pcm_jax.consistency.packed import PackedGraph
from pcm_jax.consistency.problem import (
    ConsistencyProblem,
    bytes_needed,
    consistency_problem,
    problem_from_covariances,
)
from pcm_jax.consistency.shuffled import ConsistentPairs
from pcm_jax.consistency.streaming import (
    stream_consistency_graph,
    stream_from_covariances,
)
from pcm_jax.consistency.within import (
    OwnLoops,
    WithinProblem,
    odometry_edges,
    own_loops,
    reordered,
    with_odometry_errors,
    within_problem,
)

__all__ = [
    "AlignmentDifference",
    "ConsistencyProblem",
    "ConsistentPairs",
    "Evidence",
    "GrowingPair",
    "GrowingWithin",
    "JointConsistency",
    "OwnLoops",
    "PackedGraph",
    "PairEvidence",
    "WithinProblem",
    "alignment_difference",
    "bytes_needed",
    "chi2_gate",
    "consistency_graph",
    "consistency_problem",
    "freedom_of",
    "joint_consistency",
    "loop_error",
    "odometry_edges",
    "own_loops",
    "problem_from_covariances",
    "reordered",
    "squared_mahalanobis",
    "squared_mahalanobis_of",
    "squared_own_loops",
    "squared_rows",
    "stream_consistency_graph",
    "stream_from_covariances",
    "to_networkx",
    "weighed_on_host",
    "with_odometry_errors",
    "within_problem",
]
