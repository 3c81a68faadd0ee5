"""Cycles of alignments over a team."""

from itertools import combinations

import jaxlie
import networkx as nx
import numpy as np
import pytest
from scipy import stats

from pcm_jax import JointConsistency, lie, select
from pcm_jax.integrity import cycles_of, judge_team, minority
from pcm_jax.integrity.team import _independent_cycles
from pcm_jax.simulation import simulate_city

SIGMA = {3: np.diag([0.1, 0.1, 0.02]) ** 2, 6: np.diag([0.1] * 3 + [0.02] * 3) ** 2}


def team_of(group, robots, generator, pairs=None, wrong=()):
    """Alignments drawn by their covariance, about true frames; the wrong ones metres off."""
    d = lie.tangent_dim(group)
    frames = lie.exp(group, generator.normal(scale=2.0, size=(robots, d)))
    found = {}
    for a, b in pairs or combinations(range(robots), 2):
        root = generator.normal(size=(d, d)) * 0.1 + np.eye(d)
        covariance = root @ SIGMA[d] @ root.T
        error = np.linalg.cholesky(covariance) @ generator.normal(size=d)
        if (a, b) in wrong:
            error = error + 3.0
        true = lie.compose(lie.inverse(lie.take(frames, a)), lie.take(frames, b))
        alignment = lie.compose(lie.as_numpy(true), lie.as_numpy(lie.exp(group, error)))
        nothing = np.zeros(0)
        found[a, b] = JointConsistency(0.0, 0, 1.0, alignment, covariance, nothing, nothing, 0)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("robots", [3, 4])
def test_cycles_close_as_often_as_they_say(group, robots):
    generator = np.random.default_rng(0)
    ring = [(k, k + 1) for k in range(robots - 1)] + [(0, robots - 1)]
    p = []
    for _ in range(400):
        (cycle,) = cycles_of(team_of(group, robots, generator, ring))
        assert cycle.robots == tuple(range(robots))
        p.append(cycle.p)
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_cycles_are_triangles_and_what_networkx_finds_beyond_them():
    generator, longer = np.random.default_rng(8), 0
    for _ in range(60):
        robots = int(generator.integers(3, 8))
        share = generator.choice([0.3, 0.6, 0.9])
        pairs = [pair for pair in combinations(range(robots), 2) if generator.random() < share]
        if not pairs:
            continue
        graph = nx.Graph(pairs)
        triangles = {frozenset(c) for c in nx.enumerate_all_cliques(graph) if len(c) == 3}
        basis = {frozenset(c) for c in nx.minimum_cycle_basis(graph) if len(c) > 3}
        found = cycles_of(team_of(jaxlie.SE2, robots, generator, pairs))
        assert {frozenset(cycle.robots) for cycle in found} == triangles | basis
        assert len(found) == len(triangles) + len(basis)
        longer += len(basis) > 0
        assert _independent_cycles(pairs) == len(nx.cycle_basis(graph))
    assert longer >= 5


def test_every_triangle_is_closed_once():
    cycles = cycles_of(team_of(jaxlie.SE2, 5, np.random.default_rng(0)))
    assert [cycle.robots for cycle in cycles] == list(combinations(range(5), 3))
    assert cycles[1].pairs == ((0, 1), (1, 3), (0, 3))


def test_the_pair_in_the_minority_is_named(group):
    for wrong in ((0, 3), (2, 4)):
        team = team_of(group, 5, np.random.default_rng(1), wrong=[wrong])
        cycles = cycles_of(team)
        assert {c.robots for c in cycles if c.p < 1e-3} == {
            triple for triple in combinations(range(5), 3) if set(wrong) <= set(triple)
        }
        assert minority(cycles) == [wrong]


def test_two_wrong_pairs_are_found_one_after_another():
    wrong = [(0, 1), (2, 3)]
    team = team_of(jaxlie.SE2, 6, np.random.default_rng(2), wrong=wrong)
    assert sorted(minority(cycles_of(team))) == wrong


def test_three_robots_cannot_tell_which_pair_is_wrong():
    cycles = cycles_of(team_of(jaxlie.SE2, 3, np.random.default_rng(3), wrong=[(0, 1)]))
    assert cycles[0].p < 1e-6
    assert minority(cycles) == []


def test_three_that_are_wrong_together_close():
    team = team_of(jaxlie.SE2, 3, np.random.default_rng(4))
    assert minority(cycles_of(team)) == []  # whatever the true frames were


def test_a_pair_without_which_robots_fall_apart_is_kept():
    """Two triangles that share one pair, which alone is wrong: both fail through it."""
    pairs = [(0, 1), (0, 2), (1, 2), (0, 3), (1, 3)]
    team = team_of(jaxlie.SE2, 4, np.random.default_rng(5), pairs, wrong=[(0, 1)])
    assert minority(cycles_of(team)) == [(0, 1)]  # 0 and 1 hang together by 2 and by 3


def test_a_team_overrules_one_pair_of_robots():
    """Five robots; the closures of one pair agree with each other on a wrong alignment."""
    world = simulate_city(
        seed=0, robots=5, poses=60, inliers=6, aliased_groups=1, aliased_size=9, random=6
    )
    closures = world.graph.closures
    own = (closures.robot_a == 0) & (closures.robot_b == 3)
    assert own.any()
    kept = own | (world.labels <= 0)  # aliased between 0 and 3 alone
    graph = type(world.graph)(world.graph.maps, closures[kept])
    by_places = select(graph, on_ambiguous="largest")
    assert world.is_true[kept][by_places.accepted].all()
    assert all(pair.verdict.believed for pair in by_places.pairs)
    selection = select(by_places.evidence, on_ambiguous="largest", prefer="closures")
    verdicts = {(p.robot_a, p.robot_b): p.verdict for p in selection.pairs}
    assert not verdicts[0, 3].believed
    assert "the team contradicts it in all 3 cycles" in verdicts[0, 3].why
    assert all(verdict.believed for pair, verdict in verdicts.items() if pair != (0, 3))
    assert world.is_true[kept][selection.accepted].all()
    assert len(selection.team) == 10


def test_without_a_cycle_there_is_nothing_to_test():
    world = simulate_city(seed=0, poses=60, inliers=6, aliased_groups=0, random=6)
    selection = select(world.graph)
    pairs = [(pair.evidence, pair.accepted) for pair in selection.pairs]
    assert judge_team(pairs, [pair.verdict for pair in selection.pairs])[1] == ()
