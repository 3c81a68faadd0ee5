"""Graphs with known or brute-forced cliques, shared by the tests of this folder."""

from __future__ import annotations

import itertools

import numpy as np


def random_graph(size: int, density: float, seed: int) -> np.ndarray:
    upper = np.triu(np.random.default_rng(seed).random((size, size)) < density, 1)
    return upper | upper.T


def planted_graph(size: int, planted: int, density: float, seed: int) -> np.ndarray:
    adjacency = random_graph(size, density, seed)
    members = np.random.default_rng(seed + 1).permutation(size)[:planted]
    adjacency[np.ix_(members, members)] = True
    np.fill_diagonal(adjacency, False)
    return adjacency


def complete_multipartite(parts: int, part_size: int) -> np.ndarray:
    part = np.arange(parts * part_size) // part_size
    return part[:, None] != part[None]


def hamming_graph(bits: int, distance: int) -> np.ndarray:
    words = np.arange(2**bits)
    return np.bitwise_count(words[:, None] ^ words[None]) >= distance


def johnson_graph(size: int) -> np.ndarray:
    """Pairs of `size` things, adjacent where disjoint."""
    words = np.array([1 << i | 1 << j for i, j in itertools.combinations(range(size), 2)])
    return (words[:, None] & words[None]) == 0


def all_cliques(adjacency: np.ndarray) -> list[tuple[int, ...]]:
    """Every clique, as an ascending tuple of vertices, by extension of smaller ones."""
    cliques: list[tuple[int, ...]] = [()]
    layer = [()]
    while layer:
        layer = [
            (*clique, vertex)
            for clique in layer
            for vertex in range(clique[-1] + 1 if clique else 0, len(adjacency))
            if adjacency[list(clique), vertex].all()
        ]
        cliques += layer
    return cliques


def is_clique(adjacency: np.ndarray, members: np.ndarray) -> bool:
    inside = np.array(adjacency)[np.ix_(members, members)]
    return bool((inside | np.eye(len(inside), dtype=bool)).all())
