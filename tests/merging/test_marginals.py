"""The covariance of merged poses: a dense inverse, Monte Carlo; the anchors' about the middle."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.stats import chi2

from pcm_jax import lie
from pcm_jax.errors import InputError, InputWarning
from pcm_jax.graph import MultiRobotGraph
from pcm_jax.pipeline import merge
from pcm_jax.simulation import simulate_city

WORLDS, STEP = 60, 1e-5
ASKED = np.array([29, 0, 12])


def small_world(seed, robots=2):
    options = {"aliased_groups": 0, "random": 0, "inliers": 5}
    return simulate_city(seed=seed, poses=30, robots=robots, **options)


@pytest.fixture(scope="module")
def result():
    return merge(small_world(1, robots=3).graph, method="all")


def dense_covariance(result):
    """All poses but the first, by differences of the white residuals of every edge and closure."""
    graph = result.graph
    first = np.cumsum([0, *(one.num_poses for one in graph.maps)])
    poses = lie.concatenate([lie.as_numpy(one.poses) for one in graph.maps])
    closures, d = graph.closures, graph.tangent_dim
    tail = [np.asarray(one.tail) + at for one, at in zip(graph.maps, first, strict=False)]
    head = [np.asarray(one.head) + at for one, at in zip(graph.maps, first, strict=False)]
    tail = np.concatenate([*tail, first[closures.robot_a] + closures.pose_a])
    head = np.concatenate([*head, first[closures.robot_b] + closures.pose_b])
    parts = [*graph.maps, closures]
    measured = lie.concatenate([lie.as_numpy(part.measurement) for part in parts])
    root = np.linalg.cholesky(np.concatenate([np.asarray(part.information) for part in parts]))

    def white(moves):
        moved = lie.compose(poses, lie.exp(graph.group, moves.reshape(-1, d)))
        relative = lie.between(lie.take(moved, tail), lie.take(moved, head))
        error = lie.log(lie.between(measured, relative))
        return (root.swapaxes(1, 2) @ error[..., None]).reshape(-1)

    columns = np.eye(int(first[-1]) * d)[d:]
    jacobian = np.stack([(white(STEP * c) - white(-STEP * c)) / (2 * STEP) for c in columns], 1)
    covariance = np.zeros((len(columns) + d,) * 2)
    covariance[d:, d:] = np.linalg.inv(jacobian.T @ jacobian)
    return covariance.reshape(first[-1], d, first[-1], d), first


def test_equals_the_dense_inverse(result):
    expected, first = dense_covariance(result)
    assert result.groups == ((0, 1, 2),)
    for robot in range(3):
        rows = first[robot] + ASKED
        block = expected[rows][:, :, rows].reshape(9, 9)
        found = result.marginals(robot, ASKED)
        np.testing.assert_allclose(found, block, rtol=1e-5, atol=1e-7 * np.abs(block).max())
    everything = result.marginals(2)
    assert everything.shape == (90, 90)
    np.testing.assert_allclose(everything[-3:, -3:], result.marginals(2, [29]), rtol=1e-9)


def test_robots_apart_have_frames_of_their_own(result):
    """Nothing joins them: the covariance is that of each map by itself."""
    apart = merge(MultiRobotGraph(result.maps, result.candidates), accepted=[], optimized=True)
    assert not apart.marginals(1, [0]).any()
    assert apart.marginals(1, [29]).any()
    assert not apart.anchor_covariance_at_middle.any()


@pytest.mark.slow
def test_merged_poses_errors_have_their_covariance():
    """NEES over a few worlds: joint of three poses, and of the anchor about the middle."""
    squared, at_middle = [], []
    for seed in range(WORLDS):
        world = small_world(100 + seed)
        found = merge(world.graph, method="all")
        held = lie.take(lie.as_numpy(found.graph.maps[0].poses), 0)
        frame = lie.compose(held, lie.inverse(lie.take(world.truth[0], 0)))
        error = lie.log(
            lie.between(
                lie.compose(frame, lie.take(world.truth[1], ASKED)),
                lie.take(lie.as_numpy(found.graph.maps[1].poses), ASKED),
            )
        ).reshape(-1)
        squared.append(error @ np.linalg.solve(found.marginals(1, ASKED), error))
        own = lie.as_numpy(found.maps[1].poses)
        middle = lie.translation(own).mean(axis=0)
        shift = found.graph.group(np.array([1.0, 0.0, *middle]))
        true_first = lie.compose(frame, lie.take(world.truth[1], 0))
        anchor = lie.compose(true_first, lie.inverse(lie.take(own, 0)))
        ends = (lie.compose(one, shift) for one in (anchor, lie.take(found.anchors, 1)))
        off = lie.log(lie.between(*ends))
        at_middle.append(off @ np.linalg.solve(found.anchor_covariance_at_middle[1], off))
    for total, dof in ((sum(squared), 9 * WORLDS), (sum(at_middle), 3 * WORLDS)):
        assert chi2.ppf(0.005, dof) < total < chi2.ppf(0.995, dof)


def test_headings_that_are_hardly_known_are_told():
    """Where errors of poses are no longer linear in those of headings."""
    world = simulate_city(
        seed=1, poses=40, inliers=3, aliased_groups=0, random=0, sigma_rotation=0.5
    )
    maps = [one.with_edges(one.head - one.tail == 1) for one in world.graph.maps]
    result = merge(MultiRobotGraph(tuple(maps), world.graph.closures), method="all")
    with pytest.warns(InputWarning, match=r"poses: the heading of pose \d+ of robot b is known to"):
        result.marginals(1)


def test_about_the_middle_it_does_not_matter_where_the_origin_lies(result):
    motion = result.graph.group(np.array([[0.6, 0.8, 1e5, -2e5]]))
    far = [
        one.with_poses(lie.compose(motion, lie.as_numpy(one.poses))) if k == 1 else one
        for k, one in enumerate(result.maps)
    ]
    moved = merge(MultiRobotGraph(tuple(far), result.candidates), method="all", optimized=True)
    usual = result.anchor_covariance_at_middle
    assert np.abs(moved.anchor_covariance[1]).max() > 1e5 * np.abs(usual[1]).max()
    # t(m) turns with the map's frame: so does the covariance.
    turn = np.asarray(lie.adjoint(result.graph.group(np.array([0.6, 0.8, 0.0, 0.0]))))
    expected = turn @ usual[1] @ turn.T
    np.testing.assert_allclose(
        moved.anchor_covariance_at_middle[1], expected, rtol=1e-4, atol=1e-5 * usual[1].max()
    )
    # By the other definition, where that loses no digits.
    middle = lie.translation(lie.as_numpy(result.maps[1].poses)).mean(axis=0)
    back = np.asarray(lie.adjoint(result.graph.group(np.array([1.0, 0.0, *-middle]))))
    np.testing.assert_allclose(usual[1], back @ result.anchor_covariance[1] @ back.T, rtol=1e-6)


def test_factorised_once(result, monkeypatch):
    from pcm_jax.mapping import covariance

    calls = []
    factor = covariance.covariance_factor
    monkeypatch.setattr(
        covariance, "covariance_factor", lambda graph: (calls.append(1), factor(graph))[1]
    )
    fresh = dataclasses.replace(result)
    for robot in range(3):
        fresh.marginals(robot, ASKED)
    _ = fresh.anchor_covariance, fresh.anchor_covariance_at_middle
    assert calls == [1]


def test_what_is_not_there_is_refused(result):
    for robot in (-1, 3):
        with pytest.raises(InputError, match=f"robot: {robot} given, expected 0 … 2"):
            result.marginals(robot, [0])
    with pytest.raises(InputError, match=r"poses\[1\]: index 30 is not in 0 … 29"):
        result.marginals(1, [2, 30])
    with pytest.raises(InputError, match="given twice"):
        result.marginals(1, [2, 2])
