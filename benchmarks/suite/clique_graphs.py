"""Graphs whose maximum cliques are known to be easy, known to be hard, or known at all.

The hard ones are random graphs and those of the second DIMACS challenge. Its Keller, Hamming,
Johnson and c-fat graphs are constructed, the same but for the order of the nodes. Of its random
families (C, sanr, brock, p_hat, san) these are other draws from the published laws: comparable in
difficulty, not the same instances.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool

Graph = Bool[np.ndarray, "n n"]


def random_graph(size: int, density: float, seed: int) -> Graph:
    """G(n, p); also C125.9 and sanr200_0.7."""
    return _drawn(np.random.default_rng(seed), density, size)


def planted_graph(size: int, members: int, density: float, seed: int) -> Graph:
    """A clique of `members` among about `density` of all other edges."""
    generator = np.random.default_rng(seed)
    graph = np.zeros((size, size), bool)
    ends = generator.integers(size, size=(2, round(density * size * (size - 1) / 2)))
    graph[*ends] = graph[*ends[::-1]] = True
    chosen = generator.permutation(size)[:members]
    graph[np.ix_(chosen, chosen)] = True
    np.fill_diagonal(graph, False)
    return graph


def consistency_like(count: int, size: int, seed: int) -> Bool[np.ndarray, "count n n"]:
    """10 to 15 consistent measurements in 24 to `size`, 5 to 30 % spurious edges; padded."""
    generator = np.random.default_rng(seed)
    graphs = np.zeros((count, size, size), bool)
    for graph in graphs:
        nodes, members = generator.integers([24, 10], [size + 1, 16])
        inside = _drawn(generator, generator.uniform(0.05, 0.3), nodes)
        chosen = generator.permutation(nodes)[:members]
        inside[np.ix_(chosen, chosen)] = True
        np.fill_diagonal(inside, False)
        graph[:nodes, :nodes] = inside
    return graphs


def keller(dimension: int) -> Graph:
    """The neighbours of one node in Keller's graph.

    Its nodes are words over 0..3, joined where they differ in two places or more, by two in one.
    """
    words = np.array(list(itertools.product(range(4), repeat=dimension)))
    apart = (words[:, None] - words[None]) % 4
    graph = ((apart != 0).sum(axis=-1) >= 2) & (apart == 2).any(axis=-1)
    near = np.flatnonzero(graph[0])
    return graph[np.ix_(near, near)]


def hamming(bits: int, distance: int) -> Graph:
    """Words of so many bits that differ in `distance` or more."""
    words = np.arange(2**bits)
    return np.bitwise_count(words[:, None] ^ words[None]) >= distance


def johnson(size: int) -> Graph:
    """Disjoint pairs of `size` things."""
    words = np.array([1 << i | 1 << j for i, j in itertools.combinations(range(size), 2)])
    return (words[:, None] & words[None]) == 0


def c_fat(size: int, width: int) -> Graph:
    """Fault diagnosis, Berman and Pelc 1990: a ring of parts, each joined to its neighbours."""
    parts = int(size / (width * math.log(size)))
    part = np.arange(size) % parts
    steps = (part[:, None] - part[None]) % parts
    return ((steps <= 1) | (steps == parts - 1)) & ~np.eye(size, dtype=bool)


def brock(size: int, density: float, members: int, seed: int) -> Graph:
    """Brockington and Culberson 1996: a clique hidden by giving its nodes the usual degree."""
    generator = np.random.default_rng(seed)
    inside = generator.permutation(size) < members
    outward = (density * (size - 1) - (members - 1)) / (size - members)
    probability = np.where(inside[:, None] | inside, outward, density)
    probability[np.ix_(inside, inside)] = 1.0
    return _drawn(generator, probability, size)


def p_hat(size: int, least: float, most: float, seed: int) -> Graph:
    """Gendreau, Soriano and Salvail 1993: nodes of very different degrees."""
    generator = np.random.default_rng(seed)
    spread = generator.uniform(least, most, size)
    return _drawn(generator, (spread[:, None] + spread) / 2, size)


def san(size: int, density: float, members: int, seed: int) -> Graph:
    """Sanchis 1992: no larger clique, since the complement is covered by `members` cliques.

    The complement's other edges leave one node of each of these independent of the others'.
    """
    generator = np.random.default_rng(seed)
    order = generator.permutation(size)
    part, chosen = order % members, order < members
    strangers = (part[:, None] == part) & ~np.eye(size, dtype=bool)
    free = np.argwhere(np.triu(~strangers & ~(chosen[:, None] & chosen), 1))
    missing = round((1 - density) * size * (size - 1) / 2) - strangers.sum() // 2
    ends = generator.permutation(free)[:missing].T
    strangers[*ends] = strangers[*ends[::-1]] = True
    return ~strangers & ~np.eye(size, dtype=bool)


def _drawn(generator: np.random.Generator, density: float | np.ndarray, size: int) -> Graph:
    upper = np.triu(generator.random((size, size)) < density, 1)
    return upper | upper.T


HARD: dict[str, tuple[Callable[[], Graph], int | None]] = {
    "G(200,.7)": (lambda: random_graph(200, 0.7, 1), None),
    "G(300,.5)": (lambda: random_graph(300, 0.5, 1), None),
    "G(500,.5)": (lambda: random_graph(500, 0.5, 1), None),
    "G(1000,.3)": (lambda: random_graph(1000, 0.3, 1), None),
    "keller4": (lambda: keller(4), 11),
    "hamming8-4": (lambda: hamming(8, 4), 16),
    "brock200_2": (lambda: brock(200, 0.5, 12, 2), None),
    "brock200_4": (lambda: brock(200, 0.65, 17, 4), None),
    "p_hat300-1": (lambda: p_hat(300, 0.0, 0.5, 1), None),
    "p_hat300-2": (lambda: p_hat(300, 0.0, 1.0, 2), None),
    "C125.9": (lambda: random_graph(125, 0.9, 9), None),
    "san200_0.9_1": (lambda: san(200, 0.9, 70, 1), 70),
    "sanr200_0.7": (lambda: random_graph(200, 0.7, 7), None),
    "johnson16-2-4": (lambda: johnson(16), 8),
    "c-fat500-10": (lambda: c_fat(500, 10), 126),
}
"""By name: the graph, and the size of its largest clique where the construction tells it."""
