"""The consistency graph: both directions, never oneself, never NaN."""

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest

from pcm_jax.consistency import consistency_graph, to_networkx
from pcm_jax.errors import InputError

SQUARED = np.array(
    [
        [0.0, 1.0, 9.0, 1.0, np.nan],
        [2.0, 0.0, 1.0, 3.0, 1.0],
        [1.0, 1.0, 0.0, np.inf, 1.0],
        [1.0, 3.0, 1.0, 0.0, 1.0],
        [1.0, 1.0, 1.0, 1.0, 0.0],
    ]
)
EDGES = [(0, 1), (0, 3), (1, 2), (1, 3), (1, 4), (2, 4), (3, 4)]  # within 3.0, the gate included


def adjacency(edges, size=5):
    graph = np.zeros((size, size), bool)
    for u, v in edges:
        graph[u, v] = graph[v, u] = True
    return graph


@pytest.mark.parametrize(
    "function",
    [consistency_graph, jax.jit(consistency_graph)],
    ids=["concrete", "traced"],
)
def test_an_edge_needs_both_directions(function):
    np.testing.assert_array_equal(function(jnp.asarray(SQUARED), 3.0), adjacency(EDGES))


def test_numpy_stays_numpy():
    graph = consistency_graph(SQUARED, 3.0)
    assert isinstance(graph, np.ndarray)
    np.testing.assert_array_equal(graph, adjacency(EDGES))
    assert isinstance(consistency_graph(jnp.asarray(SQUARED), 3.0), jax.Array)


def test_a_gate_of_infinity_still_refuses_nan_and_oneself():
    graph = consistency_graph(SQUARED, np.inf)
    assert not graph[0, 4]
    assert not graph.diagonal().any()
    assert graph[2, 3]


def test_several_gates_at_once():
    graphs = jax.vmap(consistency_graph, in_axes=(None, 0))(
        jnp.asarray(SQUARED), jnp.array([0.5, 3.0])
    )
    np.testing.assert_array_equal(graphs, [adjacency([]), adjacency(EDGES)])


def test_shape():
    with pytest.raises(InputError, match=r"squared: shape \(5, 4\); expected \[m, m\]"):
        consistency_graph(SQUARED[:, :4], 1.0)


def test_networkx():
    graph = to_networkx(adjacency(EDGES), SQUARED)
    assert sorted(graph.edges) == EDGES
    assert graph.edges[0, 1]["squared"] == 2.0
    assert graph.edges[1, 4]["squared"] == 1.0
    np.testing.assert_array_equal(
        nx.to_numpy_array(to_networkx(adjacency(EDGES))), adjacency(EDGES)
    )
    assert to_networkx(np.zeros((3, 3), bool)).number_of_nodes() == 3


@pytest.mark.parametrize("gate", [float("nan"), -1.0, 1j, [1.0, 2.0, 3.0], None, "11", True])
def test_a_gate_that_is_no_gate(gate):
    with pytest.raises(InputError, match=r"^gate: "):
        consistency_graph(SQUARED, gate)


def test_distances_that_are_no_real_numbers():
    for wrong in (SQUARED + 1j, np.ma.masked_array(SQUARED, SQUARED > 1.0), None, [["a"]]):
        with pytest.raises(InputError, match=r"squared: .* given, expected real numbers"):
            consistency_graph(wrong, 1.0)  # type: ignore[arg-type]
