"""`merge`: anchors, groups, gauge, certificates, and what it does with hopeless input."""

import dataclasses
import json
import warnings

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

import pcm_jax
from pcm_jax import lie
from pcm_jax.errors import ConvergenceWarning, InputError, InputWarning
from pcm_jax.files import read_graph
from pcm_jax.graph import LoopClosures, MultiRobotGraph
from pcm_jax.mapping import optimize
from pcm_jax.mapping._linearization import retract, whitened_residual
from pcm_jax.mapping.least_squares import padded_edges
from pcm_jax.mapping.optimization import host_arrays
from pcm_jax.merging.alignment import aligned_anchors
from pcm_jax.merging.joint import joint_graph, rebuild
from pcm_jax.pipeline import merge
from pcm_jax.simulation import simulate_city, simulate_sessions
from pcm_jax.sparse import assembly

SMALL = {"poses": 60, "inliers": 6, "aliased_groups": 1, "aliased_size": 3, "random": 10}


@pytest.fixture(scope="module", params=["SE2", "SE3"])
def world(request):
    """Two robots with true, aliased and random closures."""
    if request.param == "SE2":
        return simulate_city(seed=0, **SMALL)
    return simulate_sessions(seed=1, **SMALL)


@pytest.fixture(scope="module")
def result(world):
    return merge(world.graph, accepted=world.is_true)


def with_explicit_anchors(graph, accepted, start):
    """Dense Gauss-Newton on maps in their own frames and an anchor each (Kim et al. 2010)."""
    d, group = graph.tangent_dim, graph.group
    sizes = [m.num_poses for m in graph.maps]
    offset = np.cumsum([0, *sizes])
    edges = [jax.tree.map(jnp.asarray, padded_edges(*host_arrays(m), size=256)) for m in graph.maps]
    kept = graph.closures[accepted]
    whitening = np.linalg.cholesky(np.asarray(kept.information)).transpose(0, 2, 1)
    robot_a, robot_b = np.asarray(kept.robot_a), np.asarray(kept.robot_b)
    pose_a, pose_b = np.asarray(kept.pose_a).tolist(), np.asarray(kept.pose_b).tolist()

    def residuals(poses, anchors, step):
        parts, moved = [], []
        for robot, size in enumerate(sizes):
            own = step[offset[robot] : offset[robot] + size].at[0].set(0.0)  # gauge of each map
            moved.append(retract(poses[robot], own))
            parts.append(whitened_residual(moved[-1], edges[robot]).ravel())
        turn = step[offset[-1] :].at[0].set(0.0)  # gauge of the group
        anchors = retract(anchors, turn)
        ends = []
        for robot, pose in ((robot_a, pose_a), (robot_b, pose_b)):
            picked = [lie.take(moved[r], i) for r, i in zip(robot, pose, strict=True)]
            ends.append(lie.compose(lie.take(anchors, robot), lie.stack(picked)))
        error = lie.log(lie.between(kept.measurement, lie.between(*ends)))
        return jnp.concatenate([*parts, jnp.einsum("eij,ej->ei", whitening, error).ravel()])

    @jax.jit
    def linear(poses, anchors):
        zero = jnp.zeros((offset[-1] + len(sizes), d))
        at = lambda step: residuals(poses, anchors, step)  # noqa: E731
        return at(zero), jax.jacfwd(at)(zero)

    poses, anchors = [m.poses for m in graph.maps], lie.as_device(start)
    for _ in range(8):
        r, jacobian = linear(poses, anchors)
        step = -np.linalg.lstsq(np.asarray(jacobian).reshape(len(r), -1), np.asarray(r))[0]
        step = step.reshape(-1, d)
        poses = [retract(p, step[offset[k] : offset[k] + sizes[k]]) for k, p in enumerate(poses)]
        anchors = retract(anchors, step[offset[-1] :])
    assert lie.group_of(anchors) is group
    return poses, anchors, 0.5 * float(r @ r)


@pytest.mark.slow
def test_the_merged_frame_is_the_anchored_problem():
    """The same optimum and anchors as with anchors as unknowns, on a small case."""
    world = simulate_city(seed=5, poses=14, inliers=4, aliased_groups=0, random=2)
    maps = tuple(optimize(m).graph for m in world.graph.maps)
    graph = MultiRobotGraph(maps, world.graph.closures)
    start = aligned_anchors(graph, world.is_true, ((0, 1),))
    poses, anchors, cost = with_explicit_anchors(graph, world.is_true, start)
    result = merge(graph, accepted=world.is_true, optimized=True)
    np.testing.assert_allclose(result.solution.cost, cost, rtol=1e-8)
    np.testing.assert_allclose(lie.as_matrix(result.anchors), lie.as_matrix(anchors), atol=1e-6)
    for robot in (0, 1):
        expected = lie.compose(lie.take(anchors, np.full(14, robot)), poses[robot])
        found = result.graph.maps[robot].poses
        np.testing.assert_allclose(lie.as_matrix(found), lie.as_matrix(expected), atol=1e-6)


def test_pcm_keeps_the_true_closures(world):
    result = merge(world.graph)
    assert (result.accepted == world.is_true).all()
    assert result.groups == ((0, 1),)
    assert result.solution.converged
    assert 0.8 < result.solution.normalized_chi2 < 1.2
    assert result.selection.pairs[0].optimal


def test_first_robot_keeps_its_frame(result):
    first = lie.as_matrix(lie.take(result.graph.maps[0].poses, 0))
    np.testing.assert_allclose(first, lie.as_matrix(lie.take(result.maps[0].poses, 0)), atol=1e-12)
    identity = lie.as_matrix(lie.take(result.anchors, 0))
    np.testing.assert_allclose(identity, np.eye(len(identity)), atol=1e-12)


def test_moving_one_map_moves_only_its_anchor(world, result):
    graph = world.graph
    far = lie.exp(graph.group, np.linspace(5.0, 0.3, graph.tangent_dim))
    moved = graph.maps[1].with_poses(
        lie.as_device(lie.compose(far, lie.as_numpy(graph.maps[1].poses)))
    )
    other = merge(MultiRobotGraph((graph.maps[0], moved), graph.closures), accepted=world.is_true)
    for robot in (0, 1):
        np.testing.assert_allclose(
            lie.as_matrix(other.graph.maps[robot].poses),
            lie.as_matrix(result.graph.maps[robot].poses),
            atol=1e-6,
        )
    expected = lie.compose(lie.take(lie.as_numpy(result.anchors), 1), lie.inverse(far))
    found = lie.take(lie.as_numpy(other.anchors), 1)
    np.testing.assert_allclose(lie.as_matrix(found), lie.as_matrix(expected), atol=1e-6)


def test_the_order_of_closures_and_robots_does_not_matter(world, result):
    graph, count = world.graph, len(world.graph.closures)
    shuffle = np.random.default_rng(0).permutation(count)
    flipped = LoopClosures.from_arrays(
        robot_a=np.asarray(graph.closures.robot_b),
        pose_a=np.asarray(graph.closures.pose_b),
        robot_b=np.asarray(graph.closures.robot_a),
        pose_b=np.asarray(graph.closures.pose_a),
        measurement=lie.inverse(lie.as_numpy(graph.closures.measurement)),
        information=transported(graph.closures),
    )[shuffle]
    other = merge(MultiRobotGraph(graph.maps, flipped))
    np.testing.assert_array_equal(other.accepted, world.is_true[shuffle])
    np.testing.assert_allclose(other.solution.cost, result.solution.cost, rtol=1e-7)


def transported(closures):
    """Information of the inverse measurements: δ' = −Ad(z) δ."""
    back = np.asarray(lie.adjoint(lie.inverse(lie.as_numpy(closures.measurement))))
    return back.transpose(0, 2, 1) @ np.asarray(closures.information) @ back


def test_anchor_covariance_is_that_of_the_first_pose(world, result):
    """Monte Carlo would need many merges: the dense inverse of the joint information instead."""
    graph, members = result.graph, (0, 1)
    identity = lie.identity(graph.group, (2,))
    joint = joint_graph(graph, members, np.arange(len(graph.closures)), identity)
    n, d = joint.num_poses, joint.tangent_dim
    from pcm_jax.mapping._linearization import linearize

    edges = padded_edges(*host_arrays(joint), size=256)
    _, by_tail, by_head = map(np.asarray, jax.jit(linearize)(joint.poses, edges))
    jacobian = np.zeros((joint.num_edges, d, n, d))
    for k, (i, j) in enumerate(zip(np.asarray(joint.tail), np.asarray(joint.head), strict=True)):
        jacobian[k, :, i] += by_tail[:, :, k]
        jacobian[k, :, j] += by_head[:, :, k]
    free = jacobian.reshape(-1, n * d)[:, d:]
    covariance = np.linalg.inv(free.T @ free)
    at = (graph.maps[0].num_poses - 1) * d
    own = covariance[at : at + d, at : at + d]
    adjoint = np.asarray(lie.adjoint(lie.take(lie.as_numpy(result.maps[1].poses), 0)))
    expected = adjoint @ own @ adjoint.T
    np.testing.assert_allclose(
        result.anchor_covariance[1], expected, atol=1e-8 * np.abs(expected).max()
    )
    assert not result.anchor_covariance[0].any()


def three_robots(seed=2):
    return simulate_city(seed=seed, poses=60, robots=3, inliers=5, aliased_groups=0, random=5)


def test_three_robots_make_one_group():
    world = three_robots()
    result = merge(world.graph)
    assert result.groups == ((0, 1, 2),)
    np.testing.assert_array_equal(result.accepted, world.is_true)


def test_anchors_are_chained_in_either_direction():
    """Robots a and b are tied only through c, so that b is placed against its own closures."""
    world = three_robots()
    robot_a, robot_b = np.asarray(world.graph.closures.robot_a), world.graph.closures.robot_b
    accepted = world.is_true & ((robot_a == 2) | (np.asarray(robot_b) == 2))
    maps = tuple(optimize(m).graph for m in world.graph.maps)
    graph = MultiRobotGraph(maps, world.graph.closures)
    start = aligned_anchors(graph, accepted, ((0, 1, 2),))
    found = merge(graph, accepted=accepted, optimized=True).anchors
    np.testing.assert_allclose(lie.as_matrix(start), lie.as_matrix(found), atol=0.3)


def test_robots_that_nothing_connects_stay_apart():
    world = three_robots()
    closures = world.graph.closures
    to_last = (np.asarray(closures.robot_a) == 2) | (np.asarray(closures.robot_b) == 2)
    result = merge(world.graph, accepted=world.is_true & ~to_last)
    assert result.groups == ((0, 1), (2,))
    report = result.report()
    assert report["anchors"][2] is None
    assert report["anchors"][1] is not None
    assert report["groups"] == [["a", "b"], ["c"]]
    np.testing.assert_allclose(
        lie.as_matrix(result.graph.maps[2].poses), lie.as_matrix(result.maps[2].poses), atol=1e-9
    )


def test_too_few_inliers_accept_none(world):
    result = merge(world.graph, minimum_inliers=50)
    assert not result.accepted.any()
    assert result.groups == ((0,), (1,))


@pytest.mark.slow
def test_accepting_everything_is_reported_as_what_it_is(world):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        result = merge(world.graph, method="all")
    assert result.accepted.all()
    assert np.isfinite(result.solution.cost)
    assert result.solution.cost > 1000 * merge(world.graph).solution.cost
    told = any("did not converge" in str(warning.message) for warning in caught)
    assert told == (not result.solution.converged)


def test_the_rebuild_reaches_the_batch_optimum(world, result):
    maps = result.maps
    graph = MultiRobotGraph(maps, world.graph.closures)
    start = aligned_anchors(graph, world.is_true, ((0, 1),))
    joint = joint_graph(graph, (0, 1), np.flatnonzero(world.is_true), start)
    rebuilt = rebuild(joint, int(world.is_true.sum()))
    assert rebuilt.converged
    np.testing.assert_allclose(rebuilt.cost, result.solution.cost, rtol=1e-7)


def test_a_given_set_as_mask_or_indices(world):
    by_mask = merge(world.graph, accepted=world.is_true)
    by_index = merge(world.graph, accepted=np.flatnonzero(world.is_true))
    assert by_mask.method == "given"
    np.testing.assert_array_equal(by_mask.accepted, by_index.accepted)
    assert by_mask.solution.cost == by_index.solution.cost


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["blocks", "cholmod"])
def test_merges_with_room_for_each_other_share_a_plan(world, result, engine, monkeypatch):
    sparsax = pytest.importorskip("sparsax")
    graph = MultiRobotGraph(result.maps, world.graph.closures)
    true = np.flatnonzero(world.is_true)
    false = np.flatnonzero(~world.is_true)[:1]
    room = np.concatenate([true, false])
    sets = [true, true[1:], true[::2], np.concatenate([true[2:], false])]
    alone = [merge(graph, accepted=each, optimized=True, engine=engine) for each in sets]

    before, planned, plan = sparsax.cache_size(), [], assembly.front_tree
    monkeypatch.setattr(assembly, "front_tree", lambda *a: planned.append(len(a[1])) or plan(*a))
    options = {"optimized": True, "engine": engine, "room_for": room}
    together = [merge(graph, accepted=each, **options) for each in sets]
    made = len(planned) if engine == "blocks" else sparsax.cache_size() - before
    assert made == 1
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_array_equal(other.accepted, one.accepted)
        assert other.solution.cost == pytest.approx(one.solution.cost, rel=1e-9)
        assert other.solution.normalized_chi2 == pytest.approx(one.solution.normalized_chi2)
        assert other.solution.iterations == one.solution.iterations
        for a, b in zip(one.graph.maps, other.graph.maps, strict=True):
            np.testing.assert_allclose(lie.as_matrix(b.poses), lie.as_matrix(a.poses), atol=1e-9)


def test_room_between_groups_joins_nobody(world, result):
    graph = MultiRobotGraph(result.maps, world.graph.closures)
    apart = merge(graph, accepted=[], room_for=world.is_true, optimized=True)
    assert apart.groups == ((0,), (1,))
    assert apart.solution.cost == merge(graph, accepted=[], optimized=True).solution.cost


def test_report_is_plain_and_complete(world):
    result = merge(world.graph)
    report = json.loads(json.dumps(result.report(), allow_nan=False))
    assert report["version"] == pcm_jax.__version__
    assert report["confidence"] == 0.99
    assert [c["accepted"] for c in report["closures"]] == result.accepted.tolist()
    assert [c["index"] for c in report["closures"]] == list(range(len(result.accepted)))
    assert set(report["solution"]) == {"cost", "normalized_chi2", "iterations", "converged"}
    (pair,) = report["robot_pairs"]
    assert (pair["a"], pair["b"], pair["optimal"]) == ("a", "b", True)
    assert pair["accepted"] == pair["upper_bound"] == world.is_true.sum()
    stages = {"optimize", "marginals", "consistency", "clique", "chance", "merge", "compile"}
    assert set(report["seconds"]) == stages


def test_no_degree_of_freedom_is_no_number():
    world = simulate_city(seed=1, poses=40, inliers=3, aliased_groups=0, random=2)
    chains = []
    for one in world.graph.maps:
        kept = np.flatnonzero(np.asarray(one.head) - np.asarray(one.tail) == 1)
        kept = kept[np.unique(np.asarray(one.tail)[kept], return_index=True)[1]]
        chains.append(
            dataclasses.replace(
                one,
                tail=one.tail[kept],
                head=one.head[kept],
                measurement=lie.take(one.measurement, kept),
                information=one.information[kept],
                source=one.source[kept],
            )
        )
    graph = MultiRobotGraph(tuple(chains), world.graph.closures)
    result = merge(graph, accepted=np.flatnonzero(world.is_true)[:1])
    assert result.solution.normalized_chi2 is None
    assert result.solution.cost < 1e-12


def test_plot_draws_the_merged_maps(world, result):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    axes = result.plot(is_true=world.is_true)
    assert axes.get_xlabel()
    matplotlib.pyplot.close(axes.figure)


def test_bad_arguments(world):
    graph = world.graph
    with pytest.raises(
        InputError, match=r"one robot \('a'\) given, expected at least two.*--split"
    ):
        merge(MultiRobotGraph(graph.maps[:1], LoopClosures.empty(graph.group)))
    with pytest.raises(InputError, match="2 robots but no closure between them"):
        merge(MultiRobotGraph(graph.maps, LoopClosures.empty(graph.group)))
    with pytest.raises(InputError, match="accepted: shape"):
        merge(graph, accepted=np.ones(3, bool))
    with pytest.raises(InputError, match="accepted: index 999"):
        merge(graph, accepted=[999])
    with pytest.raises(InputError, match="room_for: shape"):
        merge(graph, accepted=[0, 1], room_for=np.ones(3, bool))
    with pytest.raises(InputError, match="method: 'best', expected one of"):
        merge(graph, method="best")


RDM = "multirobot_rdm/pairwise_consistency_maximization/spoiled"


@pytest.mark.parametrize(
    "folder", ["simulation/example_4robots", "simulation_not_in_order/example_2robots"]
)
def test_spoiled_sets_accept_exactly_half(shared_data, folder):
    paths = sorted((shared_data / RDM / folder).glob("*.g2o.xz"))
    result = merge(read_graph(*paths), confidence=0.99)
    for pair in result.report()["robot_pairs"]:
        assert 2 * pair["accepted"] == pair["measured"], pair
        assert pair["optimal"]
    assert result.solution.converged
    assert result.graph.group is jaxlie.SE3


def test_a_fit_that_cannot_be_meant_is_told_with_the_part_that_does_not_fit():
    """All 20 random closures between a and c accepted, and those between a and b as PCM does."""
    world = simulate_city(seed=0, robots=3, poses=60, inliers=6, aliased_groups=0, random=20)
    closures = world.graph.closures
    wrong = (closures.robot_a == 0) & (closures.robot_b == 2) & ~world.is_true
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # closures that contradict each other
        result = merge(world.graph, accepted=world.is_true | wrong)
    (told,) = result.warnings
    assert f"chi-squared is {result.solution.normalized_chi2:.3g}, where noise" in told
    assert "% of it lies in the 26 closures between 'a' and 'c'" in told
    assert result.report()["warnings"] == [told]
    assert merge(world.graph, accepted=world.is_true).warnings == []


def test_the_parts_of_a_fit_add_up_to_its_cost():
    from pcm_jax.merging._strain import _shares

    world = simulate_city(seed=0, poses=60, inliers=6, aliased_groups=0, random=2)
    result = merge(world.graph, accepted=np.ones(8, bool))
    assert sum(_shares(result.graph).values()) == pytest.approx(2 * result.solution.cost)
