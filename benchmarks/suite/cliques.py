"""Step iii: the exact clique search on graphs like the paper's, planted and random ones."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import networkx as nx
import numpy as np
from jaxtyping import Bool

from benchmarks.suite.harness import Case, Measured, Metric, Settings
from benchmarks.suite.measure import against, alone, race, timing_of
from pcm_jax import consistency_graph, maximum_clique, select, select_from, to_networkx
from pcm_jax.simulation import simulate_city

PLANTED = {"planted-150": (1_000, 150), "planted-300": (3_000, 300)}
BACKGROUND = 0.05
RANDOM_GRAPHS, LARGEST = 1_000, 14


def paper(settings: Settings) -> dict[str, Measured]:
    """The consistency graph of 15 true, 2 x 5 aliased and 90 random closures in a city."""
    (pair,) = select(simulate_city().graph).pairs
    adjacency = consistency_graph(jnp.asarray(pair.squared), pair.gate)
    graph, peer = np.asarray(adjacency), to_networkx(adjacency)
    times = race(
        {
            "ours": lambda: lambda: maximum_clique(graph),
            "networkx": lambda: lambda: _by_networkx(peer),
        },
        settings.patience,
    )
    ours, theirs = times["ours"], times["networkx"]
    clique = maximum_clique(graph)
    note = f"{clique.size} of {len(graph)}, proven: {clique.optimal}"
    return {
        "exact": Measured(1e3 * ours.median, note),
        "over_networkx": Measured(ours.median / theirs.median, against(ours, theirs)),
    }


def planted(settings: Settings) -> dict[str, Measured]:
    """Cliques planted into random graphs."""
    found = {}
    for name, (size, members) in PLANTED.items():
        graph = _planted_graph(size, members)
        clique = maximum_clique(graph)
        timing = timing_of(lambda graph=graph: maximum_clique(graph), settings.patience)
        note = f"{clique.size} of {size:,}, proven: {clique.optimal}; {alone(timing)}"
        right = clique.optimal and clique.size == members
        found[name] = Measured(timing.median if right else None, note)
    return found


def random_graphs(settings: Settings) -> dict[str, Measured]:
    """How many random graphs get a clique as large as networkx's and as enumeration's."""
    generator = np.random.default_rng(0)
    equal = 0
    for _ in range(RANDOM_GRAPHS):
        size, density = int(generator.integers(1, LARGEST + 1)), generator.random()
        graph = _random_graph(generator, size, density)
        ours = maximum_clique(graph).size
        enumerated = select_from(np.where(graph, 0.0, 2.0), 1.0, method="combinatorial")
        theirs = _by_networkx(nx.from_numpy_array(graph))
        equal += ours == theirs == int(enumerated.sum())
    note = f"up to {LARGEST} nodes, of every density"
    return {"as_networkx_and_enumeration": Measured(float(equal), note)}


def _by_networkx(graph: Any) -> int:
    nodes_only: Any = None  # as its documentation says, which its stubs do not know
    return nx.max_weight_clique(graph, weight=nodes_only)[1]


def _random_graph(generator: Any, size: int, density: float) -> Bool[np.ndarray, "n n"]:
    upper = np.triu(generator.random((size, size)) < density, 1)
    return upper | upper.T


def _planted_graph(size: int, members: int) -> Bool[np.ndarray, "n n"]:
    generator = np.random.default_rng(size)
    graph = _random_graph(generator, size, BACKGROUND)
    chosen = generator.permutation(size)[:members]
    graph[np.ix_(chosen, chosen)] = True
    np.fill_diagonal(graph, False)
    return graph


CASES = [
    Case(
        "cliques/paper-115",
        (Metric("exact", "ms", figure=5.0), Metric("over_networkx", "×")),
        paper,
    ),
    Case(
        "cliques/planted",
        (Metric("planted-150", "s"), Metric("planted-300", "s", figure=3.0)),
        planted,
    ),
    Case(
        "cliques/random",
        (
            Metric(
                "as_networkx_and_enumeration",
                f"of {RANDOM_GRAPHS}",
                "higher",
                figure=float(RANDOM_GRAPHS),
                tolerance=0.0,
                digits=4,
            ),
        ),
        random_graphs,
    ),
]
