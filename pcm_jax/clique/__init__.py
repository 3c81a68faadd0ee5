"""Maximum cliques (step iii of the paper): which measurements are pairwise consistent.

Knows graphs only, no poses. `maximum_clique` is the entrance; the modules, in the order in which
it walks through them: `adjacency` (what is a graph), `bounds` (what cannot matter), `heuristic`
(a first clique), `local_search` (a larger one), `exact` (a proof), `ties` (which of equals).
`maximum_clique_batched` does it for many small graphs in one compiled program (`batched`, on the
machine words of `words`).
"""

from pcm_jax.clique.batched import BatchedCliques, maximum_clique_batched
from pcm_jax.clique.maximum import maximum_clique
from pcm_jax.clique.result import Clique

__all__ = ["BatchedCliques", "Clique", "maximum_clique", "maximum_clique_batched"]
