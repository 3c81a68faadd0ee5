"""The largest jointly consistent set: by hand, against enumeration, and repaired greedily."""

import itertools

import jaxlie
import numpy as np
import pytest
from scipy.stats import chi2

from pcm_jax import lie
from pcm_jax.consistency import (
    PairEvidence,
    chi2_gate,
    consistency_problem,
    joint_consistency,
    squared_mahalanobis,
)
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph
from pcm_jax.mapping import MapCovariance
from pcm_jax.pipeline import merge, select, select_within, weigh
from pcm_jax.selection import choose, repair, select_from
from pcm_jax.selection.methods import jcbb as module
from pcm_jax.selection.methods.jcbb import JointSets, suffix_colours

SIGMA = 0.1
THIRTY = {jaxlie.SE2: 0, jaxlie.SE3: 1}  # seeds of worlds whose largest clique fails
OFF = {jaxlie.SE2: 20.0, jaxlie.SE3: 30.0}  # squared side of the triangle, in σ²


def chain(group, rng, poses=8, sigma=0.02):
    """A short map at its optimum; all that chains have is odometry."""
    d = lie.tangent_dim(group)
    placed = lie.exp(group, 0.5 * rng.normal(size=(poses, d)))
    tail, head = np.arange(poses - 1), np.arange(1, poses)
    return PoseGraph.from_arrays(
        poses=placed,
        tail=tail,
        head=head,
        measurement=lie.between(lie.take(placed, tail), lie.take(placed, head)),
        covariance=np.broadcast_to(sigma**2 * np.eye(d), (poses - 1, d, d)),
    )


def closures_off_by(group, maps, pose_a, pose_b, tangents):
    """Closures for the identity as the alignment, but for errors."""
    ends = [
        lie.take(lie.as_numpy(one.poses), np.asarray(poses))
        for one, poses in zip(maps, (pose_a, pose_b), strict=True)
    ]
    count, d = tangents.shape
    return LoopClosures.from_arrays(
        robot_a=np.zeros(count, int),
        pose_a=pose_a,
        robot_b=np.ones(count, int),
        pose_b=pose_b,
        measurement=lie.compose(lie.between(*ends), lie.exp(group, tangents)),
        covariance=np.broadcast_to(SIGMA**2 * np.eye(d), (count, d, d)),
    )


def evidence_of(maps, closures):
    squared = np.asarray(squared_mahalanobis(consistency_problem(*maps, closures)))
    count = len(closures)
    covariances = tuple(map(MapCovariance, maps))
    return PairEvidence(0, 1, np.arange(count), closures, covariances, squared[:count, :count])


@pytest.fixture
def triangle(group):
    """Three closures of the same two poses, off by the corners of an equilateral triangle.

    Each two are s²/2 apart; all three together s² from their mean.
    """
    d, side = lie.tangent_dim(group), SIGMA * np.sqrt(OFF[group])
    tangents = np.zeros((3, d))
    tangents[:, :2] = side * np.array([[0.0, 0.0], [1.0, 0.0], [0.5, np.sqrt(0.75)]])
    maps = [chain(group, np.random.default_rng(k)) for k in (0, 1)]
    return MultiRobotGraph(tuple(maps), closures_off_by(group, maps, [3] * 3, [4] * 3, tangents))


def test_three_of_which_each_two_agree_but_not_all_three(group, triangle):
    evidence, d = weigh(triangle, optimized=True), lie.tangent_dim(group)
    (pair,) = evidence.pairs
    off = ~np.eye(3, dtype=bool)
    np.testing.assert_allclose(pair.squared[off], OFF[group] / 2, rtol=1e-6)
    joint = joint_consistency(pair)
    assert joint.chi2 == pytest.approx(OFF[group], rel=1e-6)
    assert (joint.dof, joint.p) == (2 * d, pytest.approx(chi2.sf(OFF[group], 2 * d)))
    by_pairs, jointly = (
        select(evidence, method=m, minimum_inliers=2) for m in ("pcm-exact", "jcbb")
    )
    assert by_pairs.accepted.tolist() == [True] * 3
    assert jointly.accepted.tolist() == [True, True, False]
    assert (jointly.pairs[0].optimal, jointly.pairs[0].upper_bound) == (True, 2)
    assert repair(pair, by_pairs.accepted).members.tolist() == [True, True, False]
    assert repair(pair, [1, 2]).members.tolist() == [False, True, True]
    assert repair(pair, [0, 1, 2], confidence=0.9999).members.all()
    assert merge(evidence, method="jcbb", minimum_inliers=2).accepted.sum() == 2


def test_the_gate_decides_for_the_whole_set(triangle):
    evidence = weigh(triangle, optimized=True)
    sizes = [
        int(select(evidence, method="jcbb", confidence=p, minimum_inliers=1).accepted.sum())
        for p in (0.5, 0.99, 0.9999)
    ]
    assert sizes == [1, 2, 3]


def enumerated(evidence, gate):
    """The largest set by looking at all; of equal sizes the smallest tuple."""
    graph = evidence.consistent(gate)
    d = evidence.measured.tangent_dim
    confidence = chi2.cdf(gate, d)
    for size in range(len(evidence), 1, -1):
        quantile = chi2.ppf(confidence, (size - 1) * d)
        for rows in itertools.combinations(range(len(evidence)), size):
            pairwise = all(graph[u, v] for u, v in itertools.combinations(rows, 2))
            if pairwise and joint_consistency(evidence, list(rows)).chi2 <= quantile:
                return list(rows)
    return [0]


def doubtful(group, seed, count, squared=2.2):
    """Closures that are all off by as much, in all directions: most pairs pass, large sets fail.

    Args:
        squared: each one's squared error, in d σ².
    """
    rng, d = np.random.default_rng(seed), lie.tangent_dim(group)
    maps = [chain(group, rng) for _ in range(2)]
    tangents = rng.normal(size=(count, d))
    tangents *= SIGMA * np.sqrt(squared * d) / np.linalg.norm(tangents, axis=1, keepdims=True)
    pose_a, pose_b = rng.integers(0, 8, (2, count))
    return evidence_of(maps, closures_off_by(group, maps, pose_a, pose_b, tangents))


@pytest.mark.slow
def test_equals_enumeration(group):
    gate = float(chi2_gate(0.99, lie.tangent_dim(group)))
    repaired = 0
    for seed in range(12):
        evidence = doubtful(group, seed, 9)
        expected = enumerated(evidence, gate)
        choice = choose(evidence, gate, method="jcbb")
        assert np.flatnonzero(choice.members).tolist() == expected, seed
        assert (choice.optimal, choice.upper_bound) == (True, len(expected))
        pairwise = choose(evidence, gate, method="pcm-exact")
        repaired += pairwise.members.sum() > len(expected)
    assert repaired > 2


def test_thirty_closures_are_searched_to_the_end(group):
    evidence = doubtful(group, THIRTY[group], 30)
    gate = float(chi2_gate(0.99, lie.tangent_dim(group)))
    choice = choose(evidence, gate, method="jcbb")
    assert choice.optimal
    assert choice.members.sum() < choose(evidence, gate).members.sum()
    joint = joint_consistency(evidence, choice.members)
    assert joint.p >= 0.01
    # One more of any kind does not pass.
    for other in np.flatnonzero(~choice.members):
        wider = choice.members.copy()
        wider[other] = True
        rows = np.flatnonzero(wider)
        pairs = evidence.consistent(gate)[np.ix_(rows, rows)] | np.eye(len(rows), dtype=bool)
        assert not pairs.all() or joint_consistency(evidence, wider).p < 0.01


@pytest.mark.slow
def test_beyond_the_search_a_repaired_set_is_not_called_optimal(group, monkeypatch):
    evidence = doubtful(group, THIRTY[group], 30)
    gate = float(chi2_gate(0.99, lie.tangent_dim(group)))
    exact = choose(evidence, gate, method="jcbb")
    largest = choose(evidence, gate).members.sum()
    for name, limit in (("SEARCHED", 5), ("BRANCHES", 1)):
        with monkeypatch.context() as patched:
            patched.setattr(module, name, limit)
            greedy = choose(evidence, gate, method="jcbb")
        assert (greedy.optimal, greedy.upper_bound) == (False, largest)
        assert joint_consistency(evidence, greedy.members).p >= 0.01
        assert exact.members.sum() - 3 <= greedy.members.sum() <= exact.members.sum()
    assert not choose(evidence, gate, method="jcbb", time_limit=0.0).optimal
    monkeypatch.setattr(module, "LARGEST", 3)
    with pytest.raises(InputError, match="closures agree pair by pair, expected at most 3"):
        choose(evidence, gate, method="jcbb")


def test_what_passes_is_left_alone(group):
    evidence = doubtful(group, 5, 12, squared=0.3)
    gate = float(chi2_gate(0.99, lie.tangent_dim(group)))
    exact, jointly = (choose(evidence, gate, method=name) for name in ("pcm-exact", "jcbb"))
    np.testing.assert_array_equal(jointly.members, exact.members)
    assert (jointly.optimal, jointly.upper_bound) == (True, exact.members.sum())


def test_a_set_may_be_as_large_as_the_largest_that_is_allowed(monkeypatch):
    evidence = doubtful(jaxlie.SE2, 5, 12, squared=0.3)
    gate = float(chi2_gate(0.99, 3))
    monkeypatch.setattr(module, "LARGEST", 12)
    assert choose(evidence, gate, method="jcbb").members.all()
    monkeypatch.setattr(module, "LARGEST", 11)
    with pytest.raises(InputError, match="12 closures agree pair by pair, expected at most 11"):
        choose(evidence, gate, method="jcbb")


def test_what_candidates_add_together_spares_branches(monkeypatch):
    """Left out of the bound, it costs branches and changes no answer."""
    evidence = doubtful(jaxlie.SE2, THIRTY[jaxlie.SE2], 30)
    gate, searches = float(chi2_gate(0.99, 3)), []
    run, rises = module._Search.run, module._Branch.rises

    def recorded(self):
        searches.append(self)
        return run(self)

    def alone(self):
        own, together = rises(self)
        return own, np.zeros_like(together)

    monkeypatch.setattr(module._Search, "run", recorded)
    bounded = choose(evidence, gate, method="jcbb")
    monkeypatch.setattr(module._Branch, "rises", alone)
    unbounded = choose(evidence, gate, method="jcbb")
    assert bounded.members.tolist() == unbounded.members.tolist()
    assert searches[0].branches < searches[1].branches


def test_a_repaired_set_grows_again(group):
    evidence = doubtful(group, 5, 6, squared=0.3)
    sets = JointSets(evidence, np.arange(6), float(chi2_gate(0.99, lie.tangent_dim(group))))
    everything = np.arange(6)
    assert sets.passes(everything)
    assert sets.shrunk(everything).tolist() == everything.tolist()
    graph = ~np.eye(6, dtype=bool)
    assert sets.grown(np.array([1, 2]), graph).tolist() == everything.tolist()
    graph[2, 5] = graph[5, 2] = False
    assert sets.grown(np.array([1, 2]), graph).tolist() == [0, 1, 2, 3, 4]


def test_colours_of_suffixes_bound_cliques():
    rng = np.random.default_rng(0)
    for _ in range(20):
        graph = np.triu(rng.random((7, 7)) < 0.6, 1)
        graph |= graph.T
        bounds = suffix_colours(graph)
        for start in range(7):
            largest = max(
                size
                for size in range(1, 8 - start)
                for rows in itertools.combinations(range(start, 7), size)
                if all(graph[u, v] for u, v in itertools.combinations(rows, 2))
            )
            assert largest <= bounds[start] <= 7 - start


def test_distances_alone_do_not_suffice():
    with pytest.raises(InputError, match="method: 'jcbb' needs the maps' covariances, expected"):
        select_from(np.zeros((3, 3)), 1.0, method="jcbb")
    with pytest.raises(InputError, match="evidence: of distances alone"):
        repair(PairEvidence.from_squared(np.zeros((3, 3))), [0, 1])
    with pytest.raises(InputError, match="evidence: of distances alone"):
        module.jcbb(PairEvidence.from_squared(np.full((3, 3), 99.0)), 11.3)  # even if none agree
    with pytest.raises(InputError, match="evidence: of distances alone"):
        repair(PairEvidence.from_squared(np.full((3, 3), 99.0)), [0, 1])
    map_with_a_loop = chain(jaxlie.SE2, np.random.default_rng(0)).with_edges(np.arange(7))
    with pytest.raises(InputError, match="method: 'jcbb' needs the maps"):
        select_within(map_with_a_loop, method="jcbb")


@pytest.mark.slow
def test_streamed_evidence_has_the_same_answer(triangle):
    streamed = select(triangle, optimized=True, memory_limit=0, method="jcbb", minimum_inliers=2)
    assert streamed.pairs[0].evidence.is_streamed
    assert streamed.accepted.tolist() == [True, True, False]


def test_no_closure_and_one(triangle):
    (pair,) = weigh(MultiRobotGraph(triangle.maps, triangle.closures[[1]]), optimized=True).pairs
    assert choose(pair, 1.0, method="jcbb").members.tolist() == [True]
    nothing = evidence_of(triangle.maps, triangle.closures[np.zeros(3, bool)])
    choice = choose(nothing, 1.0, method="jcbb")
    assert (choice.members.shape, choice.optimal) == ((0,), True)
