"""Soft PCM: its limit is PCM, its derivatives are those of differences, its masks hold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pcm_jax.clique import maximum_clique_batched
from pcm_jax.errors import InputError
from pcm_jax.selection import select_from, soft_select
from pcm_jax.selection.soft import _starts, soft_adjacency

GATE = 11.3


def distances(rng, edges):
    """Squared distances, not symmetric, on either side of the gate as `edges` says."""
    shape = edges.shape
    near = np.minimum(rng.chisquare(3, shape), 10.5)
    return np.where(edges, near, rng.uniform(11.6, 80.0, shape))


def random_graph(rng, size, planted, density):
    edges = np.triu(rng.random((size, size)) < density, 1)
    members = rng.choice(size, planted, replace=False)
    edges |= np.triu(
        np.isin(np.arange(size), members)[:, None] & np.isin(np.arange(size), members), 1
    )
    return edges | edges.T


def with_unique_maximum(graphs, members):
    """Whether every maximum loses a node as soon as any of its nodes is taken away."""
    size = jax.jit(lambda graphs, valid: maximum_clique_batched(graphs, valid=valid).size)
    order, total = np.argsort(~members, axis=1, kind="stable"), members.sum(axis=1)
    unique = np.ones(len(graphs), bool)
    for rank in range(total.max()):
        valid = np.arange(graphs.shape[-1]) != order[:, rank, None]
        unique &= (rank >= total) | (np.asarray(size(graphs, valid)) < total)
    return unique


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "planted", "density"), [(300, (10, 15), (0.05, 0.3)), (150, (0, 6), (0.5, 0.6))]
)
def test_the_limit_is_pcm(count, planted, density):
    """Planted cliques as in the paper's worlds, and dense graphs that local methods fail on."""
    rng, most = np.random.default_rng(0), 32
    graphs, squared = np.zeros((count, most, most), bool), np.full((count, most, most), np.inf)
    for row in range(count):
        size = rng.integers(24, most + 1)
        graph = random_graph(rng, size, rng.integers(*planted), rng.uniform(*density))
        graphs[row, :size, :size], squared[row, :size, :size] = graph, distances(rng, graph)
    members = np.asarray(jax.jit(lambda g: maximum_clique_batched(g).members)(graphs))
    unique = with_unique_maximum(graphs, members)
    assert unique.sum() > 25
    valid = np.isfinite(squared).any(axis=1)
    run = jax.jit(jax.vmap(lambda q, v: soft_select(q, GATE, temperature=1e-6, valid=v)))
    found = np.asarray(run(squared, valid))[unique]
    np.testing.assert_allclose(found, members[unique], atol=1e-5)
    sample = np.flatnonzero(unique)[0]
    cut = squared[sample][np.ix_(valid[sample], valid[sample])]
    np.testing.assert_array_equal(select_from(cut, GATE), members[sample][valid[sample]])


def test_two_measurements_by_hand():
    """x = (1/2, 1/2) has the value (a + 1/2)/2, so both are members to 1 / (1 + 2 (1 − a))."""
    for a in (0.6, 0.9, 1.0 - 1e-9):
        beyond = -np.log(a / (1.0 - a))
        squared = jnp.asarray([[0.0, GATE + beyond], [GATE + beyond - 1.0, 0.0]])
        found = soft_select(squared, GATE, temperature=1.0, steps=200)
        np.testing.assert_allclose(found, 1.0 / (3.0 - 2.0 * a), rtol=1e-9)
    apart = jnp.asarray([[0.0, 90.0], [0.0, 0.0]])
    np.testing.assert_allclose(jnp.sum(soft_select(apart, GATE, temperature=1.0)), 1.0, rtol=1e-9)


def test_two_sets_compete_by_hand():
    """Sets of three and of two, apart: ω of k vertices is 1/2 / (1 − (a (k − 1) + 1/2) / k).

    Four of the six starts end in the larger set: its vertices' and the exact one.
    """
    gate, temperature = 2.0, 0.5
    a = 1.0 / (1.0 + np.exp(-gate / temperature))
    three, two = (0.5 / (1.0 - (a * (k - 1) + 0.5) / k) for k in (3, 2))
    weight = np.exp((two - three) * gate / temperature)
    squared = np.full((5, 5), np.inf)
    squared[:3, :3] = squared[3:, 3:] = 0.0
    expected = np.array([4.0 * three / 3.0] * 3 + [2.0 * weight * two / 2.0] * 2)
    found = soft_select(jnp.asarray(squared), gate, temperature=temperature, steps=200)
    np.testing.assert_allclose(found, expected / (4.0 + 2.0 * weight), rtol=1e-9)


@pytest.fixture(scope="module")
def squared():
    rng = np.random.default_rng(1)
    return distances(rng, random_graph(rng, 24, 8, 0.3))


def test_values_fall_with_contradiction(squared):
    soft = soft_select(jnp.asarray(squared), GATE, temperature=1.0)
    chosen = select_from(squared, GATE)
    assert ((soft >= 0.0) & (soft <= 1.0)).all()
    assert soft[chosen].min() > 10.0 * soft[~chosen].max()
    u, v = np.flatnonzero(chosen)[:2]
    worse = squared.copy()
    worse[u, v] = GATE - 0.5
    contradicted = soft_select(jnp.asarray(worse), GATE, temperature=1.0)
    assert contradicted[u] < soft[u] - 0.05
    assert contradicted[v] < soft[v] - 0.05


@pytest.mark.slow
def test_derivatives_are_those_of_differences(squared):
    rng = np.random.default_rng(2)
    pull = jnp.asarray(rng.normal(size=len(squared)))

    @jax.jit
    def value(squared, gate, temperature):
        return pull @ soft_select(squared, gate, temperature=temperature)

    at = (jnp.asarray(squared), jnp.asarray(GATE), jnp.asarray(1.5))
    along = (jnp.asarray(rng.normal(size=squared.shape)), jnp.asarray(0.7), jnp.asarray(-0.4))
    gradient = jax.grad(value, argnums=(0, 1, 2))(*at)
    for k in range(3):
        only = tuple(x if i == k else jnp.zeros_like(x) for i, x in enumerate(along))
        slope = float(jnp.vdot(gradient[k], along[k]))
        h = 1e-4
        ahead, behind = (
            value(*(x + t * v for x, v in zip(at, only, strict=True))) for t in (h, -h)
        )
        assert abs(slope) > 1e-4
        np.testing.assert_allclose(slope, (ahead - behind) / (2 * h), rtol=1e-5)
        np.testing.assert_allclose(jax.jvp(value, at, only)[1], slope, rtol=1e-9)


@pytest.mark.parametrize("temperature", [1e-100, 1e-9, 1.0, 1e6])
def test_derivatives_are_finite_everywhere(squared, temperature):
    odd = squared.copy()
    odd[3], odd[:, 5], odd[7, 8], odd[9, 10] = np.nan, np.inf, -0.0, GATE
    odd[11, 12] = odd[12, 11]
    value = lambda q, g, t: jnp.sum(soft_select(q, g, temperature=t) ** 2)  # noqa: E731
    gradients = jax.grad(value, argnums=(0, 1, 2))(jnp.asarray(odd), GATE, temperature)
    assert all(np.isfinite(gradient).all() for gradient in gradients)
    np.testing.assert_array_equal(gradients[0][3], 0.0)


def test_what_does_not_count_changes_nothing(squared):
    """Whatever stands in masked rows, bit for bit; and masked rows are as good as none."""
    valid = np.arange(24) < 19
    run = jax.jit(lambda q: soft_select(q, GATE, temperature=1.0, valid=valid))
    fillings = []
    for filling in (0.0, np.nan, np.inf, 5.0):
        filled = np.where(valid[:, None] & valid, squared, filling)
        fillings.append(np.asarray(run(filled)))
        np.testing.assert_array_equal(fillings[-1], fillings[0])
    np.testing.assert_array_equal(fillings[0][19:], 0.0)
    alone = soft_select(jnp.asarray(squared[:19, :19]), GATE, temperature=1.0)
    np.testing.assert_allclose(fillings[0][:19], alone, rtol=0, atol=1e-12)


def test_batches(squared):
    """Neighbours differ on purpose; a bad one stays alone."""
    rng = np.random.default_rng(3)
    stack = np.stack([distances(rng, random_graph(rng, 24, 8, 0.3)) for _ in range(5)])
    run = jax.jit(jax.vmap(lambda q: soft_select(q, GATE, temperature=1.0)))
    before = np.asarray(run(stack))
    alone = [soft_select(jnp.asarray(q), GATE, temperature=1.0) for q in stack]
    np.testing.assert_allclose(before, alone, rtol=0, atol=1e-12)
    assert len(np.unique(before.round(6), axis=0)) == 5
    stack[2] = np.nan
    after = np.asarray(run(stack))
    others = np.arange(5) != 2
    np.testing.assert_array_equal(after[others], before[others])
    assert np.isfinite(after[2]).all()


def test_starts_are_distributions(squared):
    """Shares that add up to one, or all of nothing where there is nothing to start from."""
    of_distances = jax.jit(lambda q, v: _starts(soft_adjacency(q, GATE, 1.0, v), v))
    for valid in (np.arange(len(squared)) % 3 > 0, np.zeros(len(squared), bool)):
        starts = np.asarray(of_distances(squared, valid))
        assert (starts >= 0.0).all()
        np.testing.assert_allclose(starts[:-1].sum(axis=1), 1.0)
        np.testing.assert_allclose(starts[-1].sum(), float(valid.any()))


def test_edges_of_the_domain():
    assert soft_select(jnp.zeros((0, 0)), GATE, temperature=1.0).shape == (0,)
    nothing = soft_select(jnp.zeros((3, 3)), GATE, temperature=1.0, valid=np.zeros(3, bool))
    np.testing.assert_array_equal(nothing, 0.0)
    single = soft_select(np.zeros((2, 2), np.float32), 5.0, temperature=1.0)
    assert single.dtype == jnp.float32
    with pytest.raises(InputError, match=r"squared: shape \(2, 3\), expected \[m, m\]"):
        soft_select(np.zeros((2, 3)), GATE, temperature=1.0)


@pytest.mark.parametrize("wrong", [0.0, float("nan"), float("inf"), -1.0, 1e-300, 1j, [1.0], None])
@pytest.mark.parametrize("name", ["gate", "temperature"])
def test_gates_and_temperatures_that_are_none(name, wrong):
    given = {"gate": 11.0, "temperature": 1.0} | {name: wrong}
    with pytest.raises(InputError, match=f"^{name}: "):
        soft_select(jnp.zeros((2, 2)), given["gate"], temperature=given["temperature"])
