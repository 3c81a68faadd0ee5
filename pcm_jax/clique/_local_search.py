"""A larger clique by small changes: a better start for the proof, a better answer without one.

Grow by a vertex adjacent to all members; where there is none, swap a member for a vertex adjacent
to all the others; where that leads in circles, restart from the neighbours of some vertex. After
R. Battiti and M. Protasi, "Reactive local search for the maximum clique problem", Algorithmica 29
(2001), and W. Pullan and H. Hoos, "Dynamic local search for the maximum clique problem", JAIR 25
(2006). On random graphs the clique is then mostly a maximum one, and the search left to prove it
visits half the nodes.
"""

from __future__ import annotations

import random
from time import perf_counter
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pcm_jax.clique._exact import BitGraph

# Set operations and steps spent per vertex that the proof would have to branch on at first: a few
# percent of what it takes.
_OPERATIONS_PER_BRANCH = 128
_STEPS_PER_BRANCH = 8


def improved_clique(
    graph: BitGraph,
    clique: list[int],
    *,
    deadline: float,
    steps: float | None = None,
    seed: int = 0,
) -> list[int]:
    """The largest (heaviest) clique met in some steps from `clique`: itself, if none is larger.

    No step is taken from a clique that a colouring proves to be a maximum one.

    Args:
        graph: the graph; a `WeightedGraph` asks for weight instead of size.
        clique: the labels of a clique.
        deadline: reading of `time.perf_counter` at which to stop.
        steps: to be taken; by default a few for each vertex that a proof would branch on at first.
        seed: of the vertices from which the walk restarts.
    """
    single, count = graph.single, len(graph.vertices)
    generator = random.Random(seed)  # the same graph, the same walk
    current = best = sum(single[label] for label in clique)
    highest = graph.value(best)
    removed = 0  # since the last restart: a swap that brought one back would be undone
    branches = graph.beyond(highest).bit_count()
    if steps is None or not branches:
        steps = min(_STEPS_PER_BRANCH, _OPERATIONS_PER_BRANCH / len(clique)) * branches
    for _ in range(int(steps)):
        if perf_counter() > deadline:
            break
        growth, swaps = _one_step_away(graph, current)
        if growth:
            current |= single[_one_of(growth, count, generator)]
        elif swaps & ~removed:
            label = _one_of(swaps & ~removed, count, generator)
            removed |= current & graph.strangers[label]
            current = current & graph.neighbours[label] | single[label]
        else:
            label = generator.randint(1, count)
            current = current & graph.neighbours[label] | single[label]
            removed = 0
        if (value := graph.value(current)) > highest:
            best, highest, removed = current, value, 0
    return graph.members(best)


def _one_step_away(graph: BitGraph, clique: int) -> tuple[int, int]:
    """The labels outside `clique` that are adjacent to all of its members, and to all but one."""
    none_missing, one_missing = graph.everything & ~clique, 0
    while clique:
        label = clique.bit_length()
        clique ^= graph.single[label]
        strangers = graph.strangers[label]
        one_missing = one_missing & ~strangers | none_missing & strangers
        none_missing &= ~strangers
    return none_missing, one_missing


def _one_of(labels: int, count: int, generator: random.Random) -> int:
    """The highest label of a set, or one chosen at random, each half of the time.

    The first leads to large cliques soon, the second out of circles: to the largest of the hard
    graphs in the benchmarks, each alone takes two to four times as many steps on half of them.
    """
    if generator.getrandbits(1):
        below = labels & (1 << generator.randint(1, count)) - 1
        labels = below or labels
    return labels.bit_length()
