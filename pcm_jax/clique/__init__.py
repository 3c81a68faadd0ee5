"""Step iii: maximum cliques, which measurements are pairwise consistent. Knows no poses.

_adjacency      graphs as they are accepted, checked once at the entrance
_weights        weights of nodes, checked, and as whole numbers
_costs          squared distances that tell equals apart, checked, and gathered
_bounds         what cannot matter: degrees and cores
_heuristic      a first clique, greedily
_local_search   a larger one
_exact          a proof, by branch and bound
_lanes          the same for thousands of nodes side by side
_subgraphs      parts of a graph, relabelled, on machine words
_colouring      greedy colourings of many sets at once
_weighted       the same for the heaviest
_ties           one of several that are equally large, or heavy
_heaviest       the walk through the above with weights
maximum         `maximum_clique`, which walks through them
growing         `GrowingClique`: the same as vertices come and go
result          `Clique`, with its certificate, and what an interrupt brings
_bitset         sets of nodes as integers
_words          sets of nodes as machine words, for kernels
batched         `maximum_clique_batched`: many small graphs in one compiled program
"""

from pcm_jax.clique.batched import BatchedCliques, maximum_clique_batched
from pcm_jax.clique.growing import GrowingClique
from pcm_jax.clique.maximum import maximum_clique
from pcm_jax.clique.result import Clique, CliqueInterrupt

__all__ = [
    "BatchedCliques",
    "Clique",
    "CliqueInterrupt",
    "GrowingClique",
    "maximum_clique",
    "maximum_clique_batched",
]
