"""Covariances of a map against the dense inverse, the gauge, GTSAM and Monte Carlo."""

import dataclasses
import pickle
import warnings
from concurrent.futures import ThreadPoolExecutor

import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph import PoseGraph, Priors
from pcm_jax.mapping import (
    MapCovariance,
    _pair_covariances,
    covariance,
    covariance_factor,
    joint_marginal_covariance,
    optimize,
)
from pcm_jax.mapping._linearization import linearize
from pcm_jax.mapping.least_squares import padded_edges
from pcm_jax.mapping.optimization import host_arrays


def dense_covariance(graph):
    """Inverse of the dense information, first pose held."""
    edges = padded_edges(*host_arrays(graph), size=graph.num_edges)
    _, by_tail, by_head = linearize(lie.as_numpy(graph.poses), edges)
    n, d, e = graph.num_poses, graph.tangent_dim, graph.num_edges
    jacobian = np.zeros((e, d, n, d))
    for k, (i, j) in enumerate(zip(np.asarray(graph.tail), np.asarray(graph.head), strict=True)):
        jacobian[k, :, i] += by_tail[:, :, k]
        jacobian[k, :, j] += by_head[:, :, k]
    free = jacobian.reshape(e * d, n * d)[:, d:]
    root = np.linalg.inv(np.linalg.qr(free, mode="r"))  # JᵀJ would square the condition number
    return (root @ root.T).reshape(n - 1, d, n - 1, d)


def test_block_of_the_dense_inverse(group, make_map):
    graph = optimize(make_map(group)).graph
    wanted = np.array([17, 3, 29, 8])
    expected = dense_covariance(graph)[wanted - 1][:, :, wanted - 1]
    found = joint_marginal_covariance(graph, wanted)
    d = graph.tangent_dim
    atol = 1e-10 * np.abs(expected).max()
    np.testing.assert_allclose(found.reshape(4, d, 4, d), expected, atol=atol)


def test_the_held_pose_is_certain(group, make_map):
    graph = optimize(make_map(group)).graph
    d = graph.tangent_dim
    found = joint_marginal_covariance(graph, np.array([5, 0, 9]))
    without = joint_marginal_covariance(graph, np.array([5, 9]))
    assert not found[d : 2 * d].any()
    kept = np.r_[0:d, 2 * d : 3 * d]
    np.testing.assert_allclose(found[np.ix_(kept, kept)], without, rtol=1e-12)
    assert not joint_marginal_covariance(graph, np.array([0])).any()


def test_agrees_with_gtsam(group, make_map):
    gtsam = pytest.importorskip("gtsam")
    graph = optimize(make_map(group, poses=40)).graph
    is_3d = group is jaxlie.SE3
    order = [3, 4, 5, 0, 1, 2] if is_3d else [0, 1, 2]

    def pose(matrix):
        if is_3d:
            return gtsam.Pose3(matrix)
        return gtsam.Pose2(matrix[0, 2], matrix[1, 2], np.arctan2(matrix[1, 0], matrix[0, 0]))

    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for index, matrix in enumerate(np.asarray(lie.as_matrix(graph.poses))):
        values.insert(index, pose(matrix))
    factor = gtsam.BetweenFactorPose3 if is_3d else gtsam.BetweenFactorPose2
    parts = graph.tail, graph.head, lie.as_matrix(graph.measurement), graph.information
    for i, j, z, omega in zip(*map(np.asarray, parts), strict=True):
        noise = gtsam.noiseModel.Gaussian.Information(omega[np.ix_(order, order)])
        factors.add(factor(int(i), int(j), pose(z), noise))
    sure = gtsam.noiseModel.Isotropic.Sigma(graph.tangent_dim, 1e-7)
    prior = gtsam.PriorFactorPose3 if is_3d else gtsam.PriorFactorPose2
    first = values.atPose3(0) if is_3d else values.atPose2(0)
    factors.add(prior(0, first, sure))
    wanted = np.array([4, 11, 30])
    joint = gtsam.Marginals(factors, values).jointMarginalCovariance(wanted.tolist()).fullMatrix()
    rows = (np.arange(3)[:, None] * graph.tangent_dim + np.array(order)).ravel()
    found = joint_marginal_covariance(graph, wanted)
    np.testing.assert_allclose(found, joint[np.ix_(rows, rows)], rtol=1e-6, atol=1e-12)


@pytest.fixture
def optimum(group, make_map):
    """A map with loops enough for ten digits: rounding leaves its condition number times 1e-16."""
    return optimize(make_map(group, loops=60)).graph


def expected_blocks(graph, side):
    """All blocks `[n, d, n, d]` of the dense covariance, the held pose's zero."""
    n, d = graph.num_poses, graph.tangent_dim
    dense = np.zeros((n, d, n, d))
    dense[1:, :, 1:] = dense_covariance(graph)
    if side == "right":
        return dense
    values = np.array(lie.parameters(graph.poses))
    space = 2 if d == 3 else 3
    values[:, -space:] -= values[:, -space:].mean(axis=0)
    adjoint = np.asarray(lie.adjoint(lie.group_of(graph.poses)(values)))
    return np.einsum("iab,ibjc,jdc->iajd", adjoint, dense, adjoint)


@pytest.mark.parametrize("side", ["right", "left"])
def test_every_question_has_the_dense_answer(optimum, side):
    """Left perturbations are Ad of right ones, about the mean of all positions."""
    dense, asked = expected_blocks(optimum, side), MapCovariance(optimum)
    d, atol = optimum.tangent_dim, 1e-10 * np.abs(dense).max()
    wanted = np.array([17, 3, 0, 29, 8])
    block = asked.joint(wanted, side=side)
    np.testing.assert_array_equal(block, block.T)
    np.testing.assert_allclose(
        block.reshape(5, d, 5, d), dense[wanted][:, :, wanted], atol=atol, rtol=0
    )
    own = dense[np.arange(30), :, np.arange(30)]
    np.testing.assert_allclose(asked.diagonal(side=side), own, atol=atol, rtol=0)
    np.testing.assert_allclose(asked.diagonal(wanted, side=side), own[wanted], atol=atol, rtol=0)


@pytest.mark.parametrize("many", [1, 10**6])
def test_pairs_have_the_dense_answer(optimum, many, monkeypatch):
    """Of edges, of poses that none joins, of the first pose; all at once, or panel by panel."""
    monkeypatch.setattr(_pair_covariances, "MANY", many)
    monkeypatch.setattr(_pair_covariances, "PANEL", 7)
    monkeypatch.setattr(covariance, "MANY_POSES", many)
    dense, d = expected_blocks(optimum, "right"), optimum.tangent_dim
    far = np.array([[0, 25, 2, 29], [29, 0, 17, 1]])
    first = np.concatenate([optimum.tail, far[0]])
    second = np.concatenate([optimum.head, far[1]])
    asked = MapCovariance(optimum)
    found = asked.pairs(first, second).reshape(-1, 2, d, 2, d)
    ends, atol = np.stack([first, second], axis=1), 1e-10 * np.abs(dense).max()
    for row in range(2):
        for column in range(2):
            expected = dense[ends[:, row], :, ends[:, column]]
            np.testing.assert_allclose(found[:, row, :, column], expected, atol=atol, rtol=0)
    own = dense[np.arange(30), :, np.arange(30)]
    np.testing.assert_allclose(asked.diagonal(), own, atol=atol, rtol=0)
    left = expected_blocks(optimum, "left")[np.arange(30), :, np.arange(30)]
    np.testing.assert_allclose(asked.diagonal(side="left"), left, atol=atol, rtol=0)


@pytest.mark.parametrize("many", [1, 10**6])
def test_pairs_of_a_map_with_priors(make_map, monkeypatch, many):
    monkeypatch.setattr(_pair_covariances, "MANY", many)
    graph = optimize(make_map()).graph
    d, places = graph.tangent_dim, np.array([0, 20])
    priors = Priors.from_arrays(
        pose=places,
        measurement=lie.take(graph.poses, places),
        information=np.broadcast_to(np.eye(d), (2, d, d)),
    )
    asked = MapCovariance(dataclasses.replace(graph, priors=priors))
    found = asked.pairs([0, 3], [1, 9])
    for pair, block in zip(([0, 1], [3, 9]), found, strict=True):
        joint = asked.joint(np.array(pair))
        np.testing.assert_allclose(block, joint, atol=1e-10 * np.abs(joint).max(), rtol=0)


def test_pairs_that_are_none_are_refused(make_map):
    asked = MapCovariance(make_map())
    assert asked.pairs(np.zeros(0, int), np.zeros(0, int)).shape == (0, 6, 6)
    with pytest.raises(InputError, match=r"second\[1\]: 30 given, expected 0 … 29"):
        asked.pairs([1, 2], [2, 30])
    with pytest.raises(InputError, match="second: 1 poses given, expected 2 as in first"):
        asked.pairs([1, 2], [2])
    with pytest.raises(InputError, match=r"second\[1\]: 2 given, expected another pose"):
        asked.pairs([1, 2], [2, 2])


@pytest.mark.parametrize("of_column", ["right", "left"])
@pytest.mark.parametrize("of_row", ["right", "left"])
def test_columns_join_all_poses_with_some(optimum, of_row, of_column):
    asked = MapCovariance(optimum)
    rows, wanted = np.array([2, 0, 17, 9]), np.array([17, 0, 5])
    unit = np.broadcast_to(np.eye(optimum.tangent_dim), asked.adjoint.shape)
    adjoint = {"left": asked.adjoint, "right": unit}
    expected = np.einsum(
        "iab,ibjc,jdc->iadj",
        adjoint[of_row],
        expected_blocks(optimum, "right"),
        adjoint[of_column],
    )[rows][..., wanted]
    found = asked.columns(wanted, side=of_column).rows(rows, side=of_row)
    np.testing.assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max(), rtol=0)


def test_the_frame_does_not_move(optimum):
    """Whoever asks for which poses; and a map moved as a whole is as certain as before."""
    asked = MapCovariance(optimum)
    mean = np.asarray(lie.translation(optimum.poses)).mean(axis=0)
    before = asked.joint(np.array([4, 7]), side="left")
    asked.joint(np.array([25, 26, 27]), side="left")
    np.testing.assert_allclose(asked.origin, mean)
    np.testing.assert_array_equal(asked.joint(np.array([4, 7]), side="left"), before)
    np.testing.assert_allclose(lie.translation(asked.frame).mean(axis=0), 0.0, atol=1e-12)
    values = np.array(lie.parameters(optimum.poses))
    values[:, -len(mean) :] += 1e5
    far = optimum.with_poses(lie.group_of(optimum.poses)(values))
    shifted = MapCovariance(far, origin=mean + 1e5).joint(np.array([4, 7]), side="left")
    np.testing.assert_allclose(shifted, before, rtol=1e-7, atol=1e-9 * np.abs(before).max())


def test_a_grown_map_keeps_its_origin(optimum):
    asked = MapCovariance(optimum, origin=np.full(3 if optimum.tangent_dim == 6 else 2, 7.0))
    assert (asked.origin == 7.0).all()
    again = pickle.loads(pickle.dumps(asked))
    np.testing.assert_array_equal(again.origin, asked.origin)
    np.testing.assert_array_equal(again.diagonal(side="left"), asked.diagonal(side="left"))
    with pytest.raises(InputError, match=r"origin: shape \(4,\) given, expected \("):
        MapCovariance(optimum, origin=np.zeros(4))


@pytest.fixture
def factorisations(monkeypatch):
    """A list that grows with every factorisation."""
    made, factorize = [], covariance.covariance_factor

    def counted(graph):
        made.append(graph)
        return factorize(graph)

    monkeypatch.setattr(covariance, "covariance_factor", counted)
    return made


def test_a_map_is_factorised_once(make_map, factorisations):
    graph = optimize(make_map()).graph
    asked = MapCovariance(graph)
    assert not factorisations
    asked.joint(np.array([1, 2]))
    asked.joint(np.array([5]), side="left")
    asked.diagonal()
    asked.columns(np.array([3]))
    assert len(factorisations) == 1


def test_eight_threads_share_one_factorisation(make_map, factorisations):
    graph = optimize(make_map()).graph
    asked, alone = MapCovariance(graph), MapCovariance(graph)
    questions = [np.arange(k, k + 9) for k in range(16)]
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(asked.joint, questions))
    assert len(factorisations) == 1
    for question, answer in zip(questions, found, strict=True):
        np.testing.assert_array_equal(answer, alone.joint(question))


def test_small_and_large_maps_are_linearised_alike(group, make_map, monkeypatch):
    graph = make_map(group, noise=0.3)
    parts = (graph.poses, *host_arrays(graph))
    small = covariance_factor._edge_information(*parts)
    monkeypatch.setattr(covariance_factor, "COMPILED_FROM", 0)
    large = covariance_factor._edge_information(*parts)
    assert small.shape[1] < large.shape[1]  # compiled for a padded size
    scale = np.abs(small).max()
    np.testing.assert_allclose(small / scale, large[:, : graph.num_edges] / scale, atol=1e-12)


def tangled_world(rng, group=jaxlie.SE2, poses=8):
    """Truth and one noisy draw of a ring with two chords, its noise of stated covariance."""
    d = lie.tangent_dim(group)
    step = np.zeros(d)
    step[0], step[-1] = 1.0, 2.0 * np.pi / poses
    truth = lie.exp(group, np.arange(poses)[:, None] * step)
    tail = np.array([*range(poses - 1), 0, 1])
    head = np.array([*range(1, poses), poses - 1, 5])
    root = 0.01 * (np.eye(d) + 0.3 * rng.normal(size=(len(tail), d, d)))
    error = np.einsum("eij,ej->ei", root, rng.normal(size=(len(tail), d)))
    exact = lie.between(lie.take(truth, tail), lie.take(truth, head))
    graph = PoseGraph.from_arrays(
        poses=truth,
        tail=tail,
        head=head,
        measurement=lie.compose(exact, lie.exp(group, error)),
        covariance=root @ root.transpose(0, 2, 1),
    )
    return truth, graph


@pytest.mark.slow
def test_marginals_are_honest(group):
    """Errors of optimised poses, weighed by their joint covariance, are χ² over 400 worlds."""
    from scipy.stats import chi2, kstest

    rng, wanted = np.random.default_rng(20), np.array([3, 7, 5])
    worlds = 400
    squared = []
    for _ in range(worlds):
        truth, graph = tangled_world(rng, group)
        best = optimize(graph, initial="given").graph
        estimate, exact = (lie.take(lie.as_numpy(x), wanted) for x in (best.poses, truth))
        error = np.asarray(lie.log(lie.between(estimate, exact))).ravel()
        joint = MapCovariance(best).joint(wanted)
        squared.append(error @ np.linalg.solve(joint, error))
    freedom = len(wanted) * lie.tangent_dim(group)
    assert 0.001 < chi2.cdf(np.sum(squared), worlds * freedom) < 0.999
    assert kstest(squared, chi2(freedom).cdf).pvalue > 0.001


def test_sides_are_checked(make_map):
    with pytest.raises(InputError, match="side: 'up' given, expected one of right, left"):
        MapCovariance(make_map()).joint(np.array([1]), side="up")


def test_a_singular_map_is_named():
    """All hangs on the first pose by next to nothing: 1e-30 + 1 − 1."""
    unit = lie.identity(jaxlie.SE2, (3,))
    information = np.stack([1e-30 * np.eye(3), np.eye(3)])
    edges = {"tail": np.array([0, 1]), "head": np.array([1, 2])}
    edges |= {"measurement": lie.take(unit, slice(2)), "information": information}
    asked = MapCovariance(PoseGraph.from_arrays(poses=unit, name="b", **edges))
    for _ in range(2):
        with pytest.raises(InputError, match="pose_graph 'b': its information is singular"):
            asked.diagonal()


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        (np.array([1, 99]), r"poses\[1\]: 99 given, expected 0 … 29"),
        (np.array([-1]), r"poses\[0\]: -1 given"),
        (np.array([4, 4]), "poses: 4 given twice"),
        (np.array([[1, 2]]), "expected integers"),
        (np.array([1.0]), "expected integers"),
    ],
)
def test_bad_indices(make_map, poses, message):
    with pytest.raises(InputError, match=message):
        joint_marginal_covariance(make_map(), poses)


@pytest.mark.parametrize(("orders", "told"), [(0, False), (8, False), (18, True)])
def test_digits_that_rounding_takes_are_told(orders, told):
    """A chain of steps along x, every other one as many orders surer: headings' Σ is known."""
    sigma = np.where(np.arange(20) % 2, 10.0 ** (-0.5 * orders), 1.0)
    steps = np.tile(np.eye(3), (20, 1, 1))
    graph = PoseGraph.from_arrays(
        tail=np.arange(20),
        head=np.arange(1, 21),
        measurement=steps,
        covariance=np.eye(3) * (sigma**2)[:, None, None],
    )
    covariance = MapCovariance(graph)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = covariance.joint(np.arange(1, 21)).reshape(20, 3, 20, 3)[:, 2, :, 2]
    known = np.cumsum(sigma**2)[np.minimum.outer(np.arange(20), np.arange(20))]
    error = np.abs(found / known - 1.0).max()
    assert bool(caught) == told
    if told:
        assert "covariances are right to about" in str(caught[0].message)
        assert error > 1e-6
    else:
        assert error < 1e-6
