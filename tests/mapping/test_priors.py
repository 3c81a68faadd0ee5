"""Priors on poses: they are in the optimum and in its covariance, and they are the gauge."""

import dataclasses

import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import InputError, InputWarning
from pcm_jax.files import to_gtsam
from pcm_jax.graph import PoseGraph, Priors, split
from pcm_jax.graph.padded import pad_graph
from pcm_jax.mapping import MapCovariance, optimize
from pcm_jax.mapping.priors import freedom_added, placed


def measured(graph, at, noise, seed=3, sigma=0.05):
    """Priors near some of the graph's poses, of random covariance about sigma²."""
    rng = np.random.default_rng(seed)
    d = graph.tangent_dim
    root = sigma * (np.eye(d) + 0.3 * rng.normal(size=(len(at), d, d)))
    error = noise * np.einsum("kij,kj->ki", root, rng.normal(size=(len(at), d)))
    here = lie.take(lie.as_numpy(graph.poses), np.array(at))
    return Priors.from_arrays(
        pose=at,
        measurement=lie.compose(here, lie.exp(graph.group, error)),
        information=np.linalg.inv(root @ root.swapaxes(1, 2)),
    )


def positions(graph, at, weight=400.0, noise=0.0, seed=5):
    """Positions of some poses, each with the rotation of the identity: nothing is known of it."""
    d = graph.tangent_dim
    space = 2 if d == 3 else 3
    fixes = lie.translation(lie.as_numpy(graph.poses))[np.array(at)]
    fixes = fixes + noise * np.random.default_rng(seed).normal(size=fixes.shape)
    matrices = np.tile(np.eye(space + 1), (len(at), 1, 1))
    matrices[:, :space, space] = fixes
    information = np.zeros((len(at), d, d))
    information[:, range(space), range(space)] = weight
    return Priors.from_arrays(pose=at, measurement=matrices, information=information)


def moved(graph, by):
    """The same graph in another frame, priors left where they are."""
    far = lie.exp(graph.group, np.full((graph.num_poses, graph.tangent_dim), by))
    return graph.with_poses(lie.compose(far, lie.as_numpy(graph.poses)))


def cost_by_gtsam(graph):
    pytest.importorskip("gtsam")
    factors, values = to_gtsam(graph)
    return factors.error(values), factors, values


@pytest.fixture
def noisy(group, make_map):
    graph = make_map(group, noise=0.05)
    return dataclasses.replace(graph, priors=measured(graph, [4, 11, 25], noise=1.0))


def test_the_cost_is_gtsams_with_prior_factors(noisy):
    solution = optimize(noisy)
    assert solution.converged
    error, _, _ = cost_by_gtsam(solution.graph)
    assert solution.cost == pytest.approx(error, rel=1e-9)
    assert solution.cost > optimize(noisy.without_priors()).cost + 0.1


def test_no_direction_leads_down_from_the_optimum(noisy):
    """GTSAM's cost, differentiated by differences in every coordinate of a few poses."""
    found = optimize(noisy).graph
    slopes = {}
    for name, graph in (("found", found), ("start", noisy)):
        costs = []
        for pose in (0, 4, 17):
            for axis in range(graph.tangent_dim):
                step = np.zeros((graph.num_poses, graph.tangent_dim))
                for size in (1e-5, -1e-5):
                    step[pose, axis] = size
                    there = lie.compose(lie.as_numpy(graph.poses), lie.exp(graph.group, step))
                    costs.append(cost_by_gtsam(graph.with_poses(there))[0])
        slopes[name] = np.abs(np.diff(np.array(costs).reshape(-1, 2))).max() / 2e-5
    assert slopes["found"] < 1e-5 * slopes["start"]


def test_the_map_is_put_where_its_priors_are(noisy):
    """From half a turn and metres away, as if it had been given there."""
    near, far = optimize(noisy), optimize(moved(noisy, 2.0))
    assert far.converged
    assert far.cost == pytest.approx(near.cost, rel=1e-8)
    apart = lie.log(lie.between(near.graph.poses, far.graph.poses))
    assert np.abs(np.asarray(apart)).max() < 1e-6


def test_marginals_are_gtsams_with_prior_factors(group, make_map):
    """At priors that the map meets exactly, where GTSAM's Jacobian of a prior is exact."""
    gtsam = pytest.importorskip("gtsam")
    graph = optimize(make_map(group, poses=40)).graph
    graph = dataclasses.replace(graph, priors=measured(graph, [3, 20], noise=0.0))
    graph = optimize(graph, initial="given").graph
    _, factors, values = cost_by_gtsam(graph)
    order = np.array([3, 4, 5, 0, 1, 2] if group is jaxlie.SE3 else [0, 1, 2])
    wanted = np.array([0, 4, 11, 30])
    joint = gtsam.Marginals(factors, values).jointMarginalCovariance(wanted.tolist()).fullMatrix()
    rows = (np.arange(4)[:, None] * graph.tangent_dim + order).ravel()
    covariance = MapCovariance(graph)
    expected = joint[np.ix_(rows, rows)]
    np.testing.assert_allclose(covariance.joint(wanted), expected, rtol=1e-6, atol=1e-12)
    blocks = expected.reshape(4, graph.tangent_dim, 4, -1)[range(4), :, range(4)]
    np.testing.assert_allclose(covariance.diagonal(wanted), blocks, rtol=1e-6, atol=1e-12)
    columns = covariance.columns(wanted[:1]).rows(wanted)[..., 0]
    np.testing.assert_allclose(
        columns.reshape(-1, graph.tangent_dim),
        covariance.joint(wanted)[:, : graph.tangent_dim],
        atol=1e-12,
    )


def test_positions_alone_place_a_map(group, make_map):
    """Fixes without attitude turn and move the map; their own rotations play no part.

    The map is given nearly half a turn away: the whole is placed before the first step.
    """
    truth = optimize(make_map(group, noise=0.01)).graph
    fixes = positions(truth, [0, 7, 15, 22, 29])
    half = 3.0 / np.sqrt(1 if group is jaxlie.SE2 else 3)
    other = dataclasses.replace(moved(truth, half), priors=fixes)
    apart = lie.log(lie.between(truth.poses, placed(other.poses, fixes)))
    assert np.abs(np.asarray(apart)).max() < 1e-4
    solution = optimize(other)
    assert solution.converged
    apart = lie.log(lie.between(truth.poses, solution.graph.poses))
    assert np.abs(np.asarray(apart)).max() < 1e-4
    assert solution.cost == pytest.approx(optimize(truth).cost, rel=1e-6)


def test_one_position_leaves_rotations_free(group, make_map):
    """The rest of the gauge is the first pose; the cost and relative covariances are as without."""
    graph = make_map(group, noise=0.02)
    plain = optimize(graph)
    alone = dataclasses.replace(graph, priors=positions(graph, [9]))
    with pytest.warns(InputWarning, match="leave (1 of 3|3 of 6) directions"):
        solution = optimize(alone)
    assert solution.converged
    assert solution.cost == pytest.approx(plain.cost, rel=1e-8)
    fix, found = (lie.translation(lie.as_numpy(g.poses))[9] for g in (graph, solution.graph))
    np.testing.assert_allclose(found, fix, atol=1e-6)
    turn = lie.compose(
        lie.take(lie.as_numpy(plain.graph.poses), 0),
        lie.inverse(lie.take(lie.as_numpy(solution.graph.poses), 0)),
    )
    aligned = solution.graph.with_poses(
        lie.compose(lie.stack([turn] * graph.num_poses), lie.as_numpy(solution.graph.poses))
    )
    expected, relative = (_relative(g) for g in (plain.graph, solution.graph))
    apart = lie.log(lie.between(plain.graph.poses, aligned.poses))
    assert np.abs(np.asarray(apart)).max() < 1e-5
    np.testing.assert_allclose(relative, expected, rtol=1e-5)


def _relative(graph):
    """The covariance of pose 20 seen from pose 3: whatever the gauge, the same."""
    joint = MapCovariance(graph).joint(np.array([3, 20]))
    d = graph.tangent_dim
    poses = lie.as_numpy(graph.poses)
    between = lie.between(lie.take(poses, 3), lie.take(poses, 20))
    by_first = -np.asarray(lie.adjoint(lie.inverse(between)))
    jacobian = np.concatenate([by_first, np.eye(d)], axis=1)
    return jacobian @ joint @ jacobian.T


@pytest.mark.slow
def test_the_cost_follows_the_chi_squared_law(group, make_map):
    """With as many degrees of freedom as `freedom_added` says, over 60 worlds."""
    from scipy.stats import chi2

    total = freedom = 0.0
    for seed in range(60):
        graph = make_map(group, seed=seed, noise=0.002)
        priors = measured(graph, [2, 14, 28], noise=1.0, seed=seed, sigma=0.002)
        graph = dataclasses.replace(graph, priors=priors)
        freedom += (graph.num_edges - graph.num_poses + 1) * graph.tangent_dim
        freedom += freedom_added(graph)
        total += 2.0 * optimize(graph, initial="given").cost
    assert freedom_added(graph) == 2 * graph.tangent_dim
    assert 0.001 < chi2.cdf(total, freedom) < 0.999


def test_a_single_pose_with_a_prior(group):
    graph = PoseGraph.from_arrays(
        poses=lie.identity(group, (1,)),
        tail=np.zeros(0, int),
        head=np.zeros(0, int),
        measurement=lie.identity(group, (0,)),
        information=np.zeros((0, lie.tangent_dim(group), lie.tangent_dim(group))),
    )
    there = lie.exp(group, 0.4 * np.ones((1, graph.tangent_dim)))
    weight = 25.0 * np.eye(graph.tangent_dim)[None]
    graph = dataclasses.replace(
        graph, priors=Priors.from_arrays(pose=[0], measurement=there, information=weight)
    )
    found = optimize(graph).graph
    np.testing.assert_allclose(
        lie.as_matrix(lie.as_numpy(found.poses)), lie.as_matrix(there), atol=1e-9
    )
    covariance = MapCovariance(found).joint(np.array([0]))
    np.testing.assert_allclose(covariance, np.eye(graph.tangent_dim) / 25.0, rtol=1e-9)


def test_a_cut_keeps_priors_with_their_poses(group, make_map):
    graph = make_map(group, loops=40)
    graph = dataclasses.replace(graph, priors=measured(graph, [4, 11, 25], noise=0.0))
    first, second = split(graph, 15).maps
    assert first.priors is not None and second.priors is not None
    assert (first.priors.pose.tolist(), second.priors.pose.tolist()) == ([4, 11], [10])


def test_what_cannot_hold_priors_says_so(group, make_map):
    graph = make_map(group)
    graph = split(dataclasses.replace(graph, priors=measured(graph, [4], noise=0.0)), 15)
    with pytest.raises(InputError, match=r"priors: robot 0 has 1, .*without_priors"):
        pad_graph(graph, poses=40, edges=60, closures=40)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"pose": [0, 1]}, r"pose: 2 entries given, expected 1"),
        ({"pose": [-1]}, "pose"),
        ({"information": np.eye(3)}, r"information: shape \(3, 3\), expected \(1, 3, 3\)"),
        ({"information": -np.eye(3)[None]}, r"information\[0\]: .*positive semidefinite"),
        ({"information": np.triu(np.ones((1, 3, 3)))}, r"information\[0\]: .*symmetric"),
        ({"information": np.full((1, 3, 3), np.nan)}, r"information\[0\]: .*finite"),
    ],
)
def test_bad_priors_are_refused(wrong, words):
    given = {
        "pose": [0],
        "measurement": lie.identity(jaxlie.SE2, (1,)),
        "information": np.eye(3)[None],
    }
    with pytest.raises(InputError, match=words):
        Priors.from_arrays(**{**given, **wrong})
