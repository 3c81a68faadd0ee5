"""Maximum cliques by other packages, all of them optional.

Run as a script, it is one peer on the graph at its standard input: some cannot be interrupted from
Python, so that the system's timer has to end them.
"""

from __future__ import annotations

import importlib.util
import io
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

Call = Callable[[], int]


class Peer(NamedTuple):
    """A package that finds maximum cliques.

    Attributes:
        module: what to import.
        ready: returns the call that is timed, given the graph; conversion is not timed, except
            where it is part of the call.
    """

    module: str
    ready: Callable[[Bool[np.ndarray, "n n"]], Call]


def installed(peer: str) -> bool:
    """Says whether a peer can be imported."""
    try:
        return importlib.util.find_spec(PEERS[peer].module) is not None
    except ModuleNotFoundError:
        return False


def missing(peer: str) -> str:
    """The reason for a row without its peer."""
    return f"{peer} is not installed: pip install '.[bench]'"


def within(seconds: float, peer: str, graph: Bool[np.ndarray, "n n"]) -> tuple[float, int] | None:
    """Seconds and size by a peer in a process of its own; None if it computes longer than so."""
    packed = io.BytesIO()
    np.save(packed, graph)
    command = [sys.executable, __file__, peer, str(seconds)]
    done = subprocess.run(command, input=packed.getvalue(), capture_output=True, check=False)
    if done.returncode == -signal.SIGPROF:
        return None
    if done.returncode:
        raise RuntimeError(f"{peer}: {done.stderr.decode()}")
    return tuple(json.loads(done.stdout))


def _networkx(graph: np.ndarray) -> Call:
    import networkx as nx

    nodes_only: Any = None  # as its documentation says, which its stubs do not know
    theirs = nx.from_numpy_array(graph)
    return lambda: nx.max_weight_clique(theirs, weight=nodes_only)[1]


def _networkit(graph: np.ndarray) -> Call:
    import networkit  # pyright: ignore[reportMissingImports]

    ends = np.argwhere(np.triu(graph, 1)).astype(np.uint64).T
    theirs = networkit.GraphFromCoo(tuple(ends), n=len(graph))

    def solve() -> int:
        search = networkit.clique.MaximalCliques(theirs, maximumOnly=True)
        return len(search.run().getCliques()[0])

    return solve


class _SageGraph:
    """The part of a graph that `mcqd` asks for; its conversion of it is part of the call."""

    def __init__(self, graph: np.ndarray):
        self.near = [np.flatnonzero(row).tolist() for row in graph]

    def __iter__(self) -> Iterator[int]:
        return iter(range(len(self.near)))

    def order(self) -> int:
        return len(self.near)

    def vertices(self, sort: bool = False) -> list[int]:
        return list(range(len(self.near)))

    def neighbors(self, vertex: int) -> list[int]:
        return self.near[vertex]


def _mcqd(graph: np.ndarray) -> Call:
    from sage.graphs.mcqd import mcqd  # pyright: ignore[reportMissingImports]

    theirs = _SageGraph(graph)
    return lambda: len(mcqd(theirs))


def _cliquematch(graph: np.ndarray) -> Call:
    import cliquematch  # pyright: ignore[reportMissingImports]

    theirs = cliquematch.Graph.from_matrix(graph)
    return lambda: len(theirs.get_max_clique(upper_bound=len(graph)))


PEERS = {
    "networkx": Peer("networkx", _networkx),
    "networkit": Peer("networkit", _networkit),
    "mcqd": Peer("sage.graphs.mcqd", _mcqd),
    "cliquematch": Peer("cliquematch", _cliquematch),
}
"""By name; "mcqd" is the package passagemath-mcqd."""


def _main(peer: str, seconds: str) -> None:
    solve = PEERS[peer].ready(np.load(io.BytesIO(sys.stdin.buffer.read())))
    signal.setitimer(signal.ITIMER_PROF, float(seconds))
    start = time.perf_counter()
    size = solve()
    json.dump([time.perf_counter() - start, int(size)], sys.stdout)


if __name__ == "__main__":
    _main(*sys.argv[1:])
