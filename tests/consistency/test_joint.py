"""The joint test against the dense joint solve, eq. 4, Monte Carlo, and changes of gauge."""

import jaxlie
import numpy as np
import pytest
from consistency_worlds import moved_map, random_world
from joint_oracle import evidence_of, merged, noisy_world
from scipy.stats import chi2, kstest

from pcm_jax import lie
from pcm_jax.consistency import (
    PairEvidence,
    alignment_difference,
    consistency_problem,
    joint_consistency,
    squared_mahalanobis,
)
from pcm_jax.consistency import joint as joint_module
from pcm_jax.consistency.joint import quantiles
from pcm_jax.consistency.stacked import drops, stack_closures
from pcm_jax.errors import InputError
from pcm_jax.graph import PoseGraph

WORLDS = 80


def renumbered(graph, first):
    """The same map with another pose as its first, which is the one that is held."""
    order = np.roll(np.arange(graph.num_poses), -first)
    place = np.argsort(order)
    return place, PoseGraph.from_arrays(
        poses=lie.take(lie.as_numpy(graph.poses), order),
        tail=place[np.asarray(graph.tail)],
        head=place[np.asarray(graph.head)],
        measurement=graph.measurement,
        information=graph.information,
    )


def with_ends(closures, **ends):
    parts = {name: getattr(closures, name) for name in ("robot_a", "pose_a", "robot_b", "pose_b")}
    return type(closures).from_arrays(
        **parts | ends, measurement=closures.measurement, information=closures.information
    )


def world_of(group, seed, **options):
    maps, closures, costs, truth = noisy_world(group, np.random.default_rng(seed), **options)
    return maps, closures, sum(costs), truth, evidence_of(maps, closures)


def test_the_held_pose_does_not_matter(group):
    map_a, map_b, closures = random_world(group, 3, 8)
    usual = joint_consistency(evidence_of((map_a, map_b), closures))
    place_a, other_a = renumbered(map_a, 4)
    place_b, other_b = renumbered(map_b, 7)
    ends = {"pose_a": place_a[closures.pose_a], "pose_b": place_b[closures.pose_b]}
    turned = joint_consistency(evidence_of((other_a, other_b), with_ends(closures, **ends)))
    assert turned.chi2 == pytest.approx(usual.chi2, rel=1e-9)
    np.testing.assert_allclose(turned.contributions, usual.contributions, rtol=1e-7)
    assert not np.allclose(turned.covariance, usual.covariance, rtol=1e-2)


def test_the_origin_does_not_matter(group):
    map_a, map_b, closures = random_world(group, 4, 8)
    usual = evidence_of((map_a, map_b), closures)
    tangent = np.random.default_rng(0).normal(size=lie.tangent_dim(group))
    tangent[0] += 1e5
    far = lie.exp(group, tangent)
    moved = evidence_of((moved_map(map_a, far), map_b), closures)
    one, other = joint_consistency(usual), joint_consistency(moved)
    assert other.chi2 == pytest.approx(one.chi2, rel=1e-7)
    expected = lie.as_matrix(lie.compose(far, one.alignment))
    np.testing.assert_allclose(lie.as_matrix(other.alignment), expected, rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-6, atol=1e-8)
    halves = np.arange(4), np.arange(4, 8)
    assert alignment_difference(moved, *halves).chi2 == pytest.approx(
        alignment_difference(usual, *halves).chi2, rel=1e-6
    )


@pytest.mark.slow
def test_two_closures_have_the_distance_of_the_paper(group):
    """To first order in the errors; of single closures, their alignments' difference exactly."""
    maps, closures, _, _, evidence = world_of(group, 1, sigma=1e-4)
    squared = np.asarray(squared_mahalanobis(consistency_problem(*maps, closures)))
    for u in range(5):
        for v in range(u):
            joint = joint_consistency(evidence, [u, v])
            assert joint.chi2 == pytest.approx(squared[u, v], rel=2e-3)
            assert joint.dof == lie.tangent_dim(group)
            apart = alignment_difference(evidence, [u], [v])
            assert apart.chi2 == pytest.approx(max(squared[u, v], squared[v, u]), rel=1e-9)


@pytest.mark.slow
def test_chi2_is_what_merging_costs(group):
    for seed in range(3):
        maps, closures, before, truth, evidence = world_of(group, seed, sigma=1e-3)
        cost, anchors = merged(*maps, closures, np.zeros(5, int), truth)
        joint = joint_consistency(evidence)
        assert joint.chi2 == pytest.approx(cost - before, rel=5e-3)
        off = lie.log(lie.between(joint.alignment, lie.take(anchors, 0)))
        deviation = np.sqrt(np.diag(joint.covariance))
        assert (np.abs(off) < 0.02 * deviation).all()
        assert (np.abs(lie.log(lie.between(joint.alignment, truth))) < 5 * deviation).all()


@pytest.mark.slow
def test_the_difference_is_what_sharing_an_alignment_costs(group):
    for seed in range(3):
        maps, closures, _, truth, evidence = world_of(group, seed, sigma=1e-3)
        groups = np.array([0, 0, 1, 1, 1])
        together, _ = merged(*maps, closures, np.zeros(5, int), truth)
        apart, anchors = merged(*maps, closures, groups, truth)
        found = alignment_difference(evidence, groups == 0, groups == 1)
        assert found.chi2 == pytest.approx(together - apart, rel=1e-2)
        assert found.p == pytest.approx(chi2.sf(found.chi2, lie.tangent_dim(group)))
        one, other = (lie.take(anchors, k) for k in (0, 1))
        turned = np.linalg.norm(lie.log(lie.between(one, other))[-1:])
        assert np.linalg.norm(found.difference[-1:]) == pytest.approx(turned, abs=2e-3)


def test_contributions_are_what_leaving_one_out_saves(group):
    _, _, _, _, evidence = world_of(group, 6, sigma=1e-3)
    joint = joint_consistency(evidence)
    for row in range(5):
        rest = joint_consistency(evidence, np.delete(np.arange(5), row))
        assert joint.contributions[row] == pytest.approx(joint.chi2 - rest.chi2, rel=2e-2)


def test_increases_are_what_adding_one_costs(group):
    _, _, _, _, evidence = world_of(group, 7, sigma=1e-3)
    stacked = stack_closures(evidence, np.arange(5))
    members, others = np.array([0, 3, 4]), np.array([1, 2])
    alone = joint_consistency(evidence, members).chi2
    expected = [joint_consistency(evidence, [*members, one]).chi2 - alone for one in others]
    np.testing.assert_allclose(stacked.increases(members, others), expected, rtol=2e-2)


@pytest.fixture(scope="module", params=[jaxlie.SE2, jaxlie.SE3], ids=lambda group: group.__name__)
def drawn(request):
    """Tests of many worlds of right closures, and of the two halves' alignments."""
    rng = np.random.default_rng(20180521)
    joint, halves = [], []
    for _ in range(WORLDS):
        maps, closures, _, truth = noisy_world(request.param, rng, poses=5)
        evidence = evidence_of(maps, closures)
        found = joint_consistency(evidence)
        off = lie.log(lie.between(found.alignment, truth))
        joint.append((found.chi2, found.p, off @ np.linalg.solve(found.covariance, off)))
        halves.append(alignment_difference(evidence, [0, 1, 2], [3, 4]).p)
    return found.dof, np.array(joint), np.array(halves)


@pytest.mark.slow
def test_right_closures_have_uniform_p_values(drawn):
    dof, joint, halves = drawn
    assert joint[:, 0].mean() == pytest.approx(dof, abs=4 * np.sqrt(2 * dof / WORLDS))
    assert kstest(joint[:, 1], "uniform").pvalue > 0.01
    assert kstest(halves, "uniform").pvalue > 0.01


@pytest.mark.slow
def test_alignments_covariance_is_calibrated(drawn):
    dof, joint, _ = drawn
    d = dof // 4
    assert kstest(joint[:, 2], chi2(d).cdf).pvalue > 0.01


def test_a_wrong_closure_is_found_by_its_contribution(group):
    maps, closures, _, _, _ = world_of(group, 9, sigma=1e-3)
    tangent = np.zeros((5, lie.tangent_dim(group)))
    tangent[2, 0] = 0.3
    wrong = lie.compose(lie.as_numpy(closures.measurement), lie.exp(group, tangent))
    closures = type(closures).from_arrays(
        **{name: getattr(closures, name) for name in ("robot_a", "pose_a", "robot_b", "pose_b")},
        measurement=wrong,
        information=closures.information,
    )
    joint = joint_consistency(evidence_of(maps, closures))
    assert joint.p < 1e-6
    assert joint.contributions.argmax() == 2
    assert joint.closures[joint.contributions.argmax()] == 2
    assert "closure 2" in repr(joint)
    assert joint_consistency(evidence_of(maps, closures), [0, 1, 3, 4]).p > 1e-3


def test_one_closure_contradicts_nothing(group):
    maps, closures, _, _, evidence = world_of(group, 2)
    alone = joint_consistency(evidence, [3])
    assert (alone.dof, alone.p, alone.contributions.tolist()) == (0, 1.0, [0.0])
    assert alone.chi2 == pytest.approx(0.0, abs=1e-12)
    pose_a, pose_b = int(closures.pose_a[3]), int(closures.pose_b[3])
    ends = [lie.take(lie.as_numpy(m.poses), k) for m, k in zip(maps, (pose_a, pose_b), strict=True)]
    seen = lie.compose(ends[0], lie.take(lie.as_numpy(closures.measurement), 3))
    expected = lie.as_matrix(lie.compose(seen, lie.inverse(ends[1])))
    np.testing.assert_allclose(lie.as_matrix(alone.alignment), expected, atol=1e-12)


def test_large_sets_are_thinned_and_say_so(monkeypatch):
    _, _, _, _, evidence = world_of(jaxlie.SE2, 3, count=12)
    monkeypatch.setattr(joint_module, "LIMIT", 5)
    joint = joint_consistency(evidence)
    assert (joint.closures.tolist(), joint.asked, joint.dof) == ([0, 3, 6, 8, 11], 12, 12)
    assert "5 closures, thinned from 12" in repr(joint)
    apart = alignment_difference(evidence, np.arange(8), np.arange(8, 12))
    assert (apart.closures.tolist(), apart.asked) == ([0, 4, 7, 8], 12)
    assert "4 of 12 closures" in repr(apart)


def test_quantiles_keep_the_gates_confidence():
    for d, confidence in ((3, 0.99), (6, 0.11), (3, 1 - 1e-12)):
        found = quantiles(float(chi2.isf(1 - confidence, d)), d, 4)
        expected = [0.0, 0.0, *chi2.isf(1 - confidence, [d, 2 * d, 3 * d])]
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_drops_of_one_closure_are_nothing():
    assert drops(np.zeros((1, 3, 1, 3)), np.zeros((1, 3))).tolist() == [0.0]


@pytest.mark.parametrize(
    ("accepted", "message"),
    [
        ([], r"accepted: no closure, expected at least one"),
        (np.zeros(5, bool), r"accepted: no closure"),
        (np.ones(4, bool), r"accepted: shape \(4,\), expected \(5,\)"),
        ([1, 5], r"accepted\[1\]: 5, expected 0 … 4"),
        ([1, 2, 1], r"accepted: closure 1 given twice"),
        ([0.5], r"accepted: float64"),
    ],
)
def test_bad_sets_are_refused(accepted, message):
    _, _, _, _, evidence = world_of(jaxlie.SE2, 0)
    with pytest.raises(InputError, match=message):
        joint_consistency(evidence, accepted)


def test_what_cannot_be_tested_is_refused():
    with pytest.raises(InputError, match="evidence: of distances alone"):
        joint_consistency(PairEvidence.from_squared(np.zeros((3, 3))))
    _, _, _, _, evidence = world_of(jaxlie.SE2, 0)
    with pytest.raises(InputError, match="second: closure 1 is in the first set too"):
        alignment_difference(evidence, [0, 1], [1, 2])
