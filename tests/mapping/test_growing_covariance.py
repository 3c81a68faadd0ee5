"""`MapCovariance.column` and `.extend`: one column, and maps that grow by their odometry."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph import PoseGraph, Priors
from pcm_jax.mapping import MapCovariance, optimize
from pcm_jax.simulation import simulate_city, simulate_sessions


@pytest.fixture(scope="module", params=["SE2", "SE3"])
def world(request):
    make = simulate_city if request.param == "SE2" else simulate_sessions
    kind = {"robots": 1} if request.param == "SE2" else {"sessions": 1}
    return optimize(make(seed=4, poses=70, **kind).graph.maps[0]).graph


def grown(one: PoseGraph, steps: int, *, backward: tuple[int, ...] = ()) -> PoseGraph:
    """The map with steps like its first ones behind its last pose."""
    size, rows = one.num_poses, np.arange(steps)
    measured = lie.take(lie.as_numpy(one.measurement), rows)
    poses = [lie.take(one.poses, np.array([size - 1]))]
    tail, head = size - 1 + rows, size + rows
    for row in rows:
        step = lie.take(measured, rows[[row]])
        poses.append(lie.compose(poses[-1], lie.inverse(step) if row in backward else step))
    turned = np.isin(rows, backward)
    return dataclasses.replace(
        one,
        poses=lie.concatenate([one.poses, *poses[1:]]),
        tail=np.concatenate([one.tail, np.where(turned, head, tail)]),
        head=np.concatenate([one.head, np.where(turned, tail, head)]),
        measurement=lie.concatenate([one.measurement, measured]),
        information=np.concatenate([one.information, one.information[:steps]]),
        ids=np.arange(size + steps),
        source=np.full(one.num_edges + steps, "", object),
    )


def columns_of(covariance: MapCovariance, poses: np.ndarray) -> np.ndarray:
    columns = np.stack([covariance.column(int(pose), poses) for pose in poses], axis=2)
    owns = [covariance.own(int(pose)) for pose in poses]
    own = np.einsum("idie->ide", columns)
    np.testing.assert_allclose(owns, own, rtol=1e-9, atol=1e-11 * np.abs(own).max())
    return columns


def joint_of(covariance: MapCovariance, poses: np.ndarray) -> np.ndarray:
    d = covariance.pose_graph.tangent_dim
    shape = len(poses), d, len(poses), d
    return covariance.joint(poses, side="left").reshape(shape)


def test_columns_are_those_of_the_joint_covariance(world):
    poses = np.array([0, 1, 9, 40, 69])
    covariance = MapCovariance(world)
    expected = joint_of(covariance, poses)
    found = columns_of(covariance, poses)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-11 * np.abs(expected).max())


def test_of_a_map_with_priors(world):
    places = np.array([0, 30, 60])
    d = world.tangent_dim
    priors = Priors.from_arrays(
        pose=places,
        measurement=lie.take(world.poses, places),
        information=np.broadcast_to(np.eye(d), (3, d, d)),
    )
    covariance = MapCovariance(dataclasses.replace(world, priors=priors))
    poses = np.array([0, 12, 69])
    found, expected = columns_of(covariance, poses), joint_of(covariance, poses)
    assert np.abs(found[0, :, 0]).max() > 0.0
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-11 * np.abs(expected).max())


def test_odometry_changes_nothing_before_it_and_adds_its_own(world):
    before = MapCovariance(world)
    once = before.extend(grown(world, 2))
    longer = grown(world, 5, backward=(1, 3))
    twice = before.extend(grown(world, 2, backward=(1,))).extend(longer)
    by_three = before.extend(grown(world, 3, backward=(1,))).extend(longer)
    np.testing.assert_array_equal(twice.origin, before.origin)
    for covariance, one in ((once, grown(world, 2)), (twice, longer), (by_three, longer)):
        poses = np.array([0, 7, 69, *range(70, one.num_poses)])
        expected = joint_of(MapCovariance(one, origin=before.origin), poses)
        found = columns_of(covariance, poses)
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10 * np.abs(expected).max())
    old = np.array([3, 50])
    np.testing.assert_array_equal(columns_of(twice, old), columns_of(before, old))


def test_what_is_asked_on_the_way_changes_nothing(world):
    before, longer = MapCovariance(world), grown(world, 5, backward=(1, 3))
    one, poses = before.extend(grown(world, 2, backward=(1,))), np.array([7, 70, 71, 72, 74])
    expected = columns_of(one.extend(longer), poses)
    one.own(71)
    np.testing.assert_array_equal(columns_of(one.extend(longer), poses), expected)


def test_a_map_of_one_pose_grows(world):
    one = dataclasses.replace(
        world.with_edges(np.zeros(world.num_edges, bool)),
        poses=lie.take(world.poses, np.array([0])),
        ids=world.ids[:1],
    )
    longer = dataclasses.replace(
        one,
        poses=lie.take(world.poses, np.array([0, 1])),
        tail=np.array([0]),
        head=np.array([1]),
        measurement=lie.between(
            lie.take(world.poses, np.array([0])), lie.take(world.poses, np.array([1]))
        ),
        information=world.information[:1],
        ids=world.ids[:2],
        source=world.source[:1],
    )
    covariance, poses = MapCovariance(one).extend(longer), np.array([0, 1])
    expected = joint_of(MapCovariance(longer, origin=covariance.origin), poses)
    np.testing.assert_allclose(columns_of(covariance, poses), expected, atol=1e-12)


def test_what_is_more_than_odometry_is_refused(world):
    covariance = MapCovariance(world)
    longer = grown(world, 3)
    loop = dataclasses.replace(longer, tail=np.append(longer.tail[:-1], 5))
    with pytest.raises(InputError, match="one edge from each pose to the next"):
        covariance.extend(loop)
    with pytest.raises(InputError, match="one edge from each pose to the next"):
        covariance.extend(longer.with_edges(np.arange(longer.num_edges - 1)))
