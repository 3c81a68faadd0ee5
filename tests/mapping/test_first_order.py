"""The first step of a map with new loops, by the factor that it had before."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.graph import PoseGraph, Priors
from pcm_jax.mapping import MapCovariance, covariance, optimize
from pcm_jax.mapping.first_order import first_step
from pcm_jax.simulation import simulate_city, simulate_sessions


@pytest.fixture(scope="module", params=["SE2", "SE3"])
def world(request):
    make = simulate_city if request.param == "SE2" else simulate_sessions
    kind = {"robots": 1} if request.param == "SE2" else {"sessions": 1}
    return optimize(make(seed=7, poses=40, **kind).graph.maps[0]).graph


def with_edge(one: PoseGraph, tail: int, head: int, *, error: float = 0.0, seed: int = 0):
    """The map with one edge more; to a pose that is not there yet, that as well."""
    size, d = one.num_poses, one.tangent_dim
    noise = lie.exp(one.group, error * np.random.default_rng(seed).normal(size=(1, d)))
    poses, new = lie.as_numpy(one.poses), max(tail, head) == size
    if new:
        step = lie.take(lie.as_numpy(one.measurement), np.array([seed % 5]))
        before = lie.take(poses, np.array([min(tail, head)]))
        poses = lie.concatenate([poses, lie.compose(before, step)])
    ends = (lie.take(poses, np.array([end])) for end in (tail, head))
    measured = lie.compose(lie.between(*ends), noise)
    return dataclasses.replace(
        one,
        poses=poses,
        tail=np.append(one.tail, tail),
        head=np.append(one.head, head),
        measurement=lie.concatenate([lie.as_numpy(one.measurement), measured]),
        information=np.concatenate([one.information, one.information[[seed % 5]]]),
        ids=np.arange(size + new),
        source=np.append(one.source, ""),
    )


def expected_step(known: MapCovariance, before: int, grown: PoseGraph) -> np.ndarray:
    """Parameters of the poses after (H + GᵀG)⁻¹ Gᵀ r, dense, with G by automatic derivatives."""
    d, edges, size = grown.tangent_dim, known.pose_graph.num_edges, grown.num_poses
    old, everyone = known.pose_graph.num_poses, np.arange(known.pose_graph.num_poses)
    information = np.zeros((size * d, size * d))
    prior = known.joint(everyone, side="left")
    information[d : old * d, d : old * d] = np.linalg.inv(prior[d:, d:])
    values = np.array(lie.parameters(lie.as_numpy(grown.poses)))
    values[:, -len(known.origin) :] -= known.origin
    frame = grown.group(values)
    gradient = np.zeros(size * d)
    for row in range(edges, grown.num_edges):
        root = np.linalg.cholesky(np.asarray(grown.information)[row]).T
        ends = np.array([grown.tail[row], grown.head[row]])
        measured = lie.take(grown.measurement, row)

        def residual(moves, root=root, ends=ends, measured=measured):
            at = [lie.take(frame, int(end)) for end in ends]
            tail, head = (
                lie.compose(lie.exp(grown.group, move), pose)
                for move, pose in zip(moves, at, strict=True)
            )
            return root @ lie.log(lie.compose(lie.inverse(measured), lie.between(tail, head)))

        zero = np.zeros((2, d))
        slope = np.zeros((d, size, d))
        for end, part in zip(ends, np.moveaxis(jax.jacfwd(residual)(zero), 1, 0), strict=True):
            slope[:, end] += part
        slope = slope.reshape(d, -1)
        information += slope.T @ slope
        gradient += slope.T @ residual(zero) * (row >= before)
    step = np.zeros((size, d))
    free = slice(d, None)
    step.ravel()[free] = -np.linalg.solve(information[free, free], gradient[free])
    moved = np.array(lie.parameters(lie.compose(lie.exp(grown.group, step), frame)))
    moved[:, -len(known.origin) :] += known.origin
    return moved


def same(found, expected: np.ndarray) -> None:
    np.testing.assert_allclose(lie.parameters(found), expected, rtol=0.0, atol=2e-7)


def test_is_the_dense_one(world):
    known = MapCovariance(world)
    grown = with_edge(world, 39, 3, error=0.05)
    found = first_step(known, world.num_edges, grown)
    same(found, expected_step(known, world.num_edges, grown))
    moved = np.abs(lie.translation(found) - lie.translation(lie.as_numpy(world.poses)))
    assert moved.max() > 1e-3


def test_of_loops_and_odometry_that_came_one_after_another(world):
    known = MapCovariance(world)
    first = with_edge(world, 39, 3, error=0.05)
    longer = with_edge(with_edge(first, 39, 40, seed=1), 41, 40, seed=2)
    grown = with_edge(with_edge(longer, 41, 11, error=0.05, seed=3), 20, 41, error=0.1, seed=4)
    before = longer.num_edges
    same(first_step(known, before, grown), expected_step(known, before, grown))


def test_lessens_the_cost_as_a_whole_step_does(world):
    known = MapCovariance(world)
    grown = with_edge(world, 39, 0, error=0.02)
    start = optimize(grown, initial="given", max_steps=1).initial_cost
    best = optimize(grown, initial="given").cost
    stepped = grown.with_poses(first_step(known, world.num_edges, grown))
    after = optimize(stepped, initial="given", max_steps=1).initial_cost
    assert after - best < 1e-3 * (start - best)


def test_the_held_pose_stays_to_the_last_bit(world):
    values = np.array(lie.parameters(lie.as_numpy(world.poses)))
    values[:, -2:] += 0.1
    moved = world.with_poses(world.group(values))
    space = 2 if world.tangent_dim == 3 else 3
    known = MapCovariance(moved, origin=np.full(space, 1e7))
    found = first_step(known, moved.num_edges, with_edge(moved, 39, 3, error=0.01))
    np.testing.assert_array_equal(lie.parameters(found)[0], values[0])


def test_without_a_step(world):
    known = MapCovariance(world)
    apart = with_edge(world, 10, 40)  # a new pose, and no odometry leads there
    for grown in (apart, with_edge(apart, 40, 3, error=0.01)):
        assert first_step(known, world.num_edges, grown) is None
    d = world.tangent_dim
    priors = Priors.from_arrays(
        pose=np.array([0]), measurement=lie.take(world.poses, [0]), information=np.eye(d)[None]
    )
    grown = dataclasses.replace(with_edge(world, 39, 3), priors=priors)
    assert first_step(known, world.num_edges, grown) is None


def test_without_loops_or_with_many(world):
    known = MapCovariance(world)
    longer = with_edge(world, 39, 40, seed=1)
    assert first_step(known, world.num_edges, longer) is None
    for pose in range(covariance.LOOPS_SINCE):
        longer = with_edge(longer, 40, pose, error=0.01)
    assert first_step(known, world.num_edges, longer) is not None
    assert first_step(known, world.num_edges, with_edge(longer, 40, 20)) is None


def test_a_singular_map_is_named(world):
    """All hangs on the first pose by next to nothing: 1e-30 + 1 − 1."""
    information = np.broadcast_to(np.eye(world.tangent_dim), world.information.shape).copy()
    information[0] *= 1e-30
    weak = dataclasses.replace(world, information=information).with_edges(np.arange(39))
    with pytest.raises(InputError, match="its information is singular"):
        first_step(MapCovariance(weak), weak.num_edges, with_edge(weak, 39, 3))


def test_one_factor_serves_a_few_loops(world, monkeypatch):
    made, factorize = [], covariance.covariance_factor
    monkeypatch.setattr(
        covariance, "covariance_factor", lambda graph: (made.append(graph), factorize(graph))[1]
    )
    here, grown = MapCovariance(world), world
    for loop in range(covariance.LOOPS_SINCE + 1):
        before, grown = grown.num_edges, with_edge(grown, 39, loop, error=0.01, seed=loop)
        step = first_step(here.known, before, grown)
        grown = optimize(grown.with_poses(step), initial="given").graph
        here = here.followed_by(grown)
    assert [one.num_edges for one in made] == [world.num_edges, world.num_edges + loop]
    here.joint(np.array([1, 2]))
    assert here.known is here and len(made) == 3
    assert here.extend(grown).known is here


def test_a_name_changes_nothing_else(world):
    asked = MapCovariance(world)
    factor = asked.factor()
    twin = asked.renamed("b")
    assert twin.pose_graph.name == "b" and asked.pose_graph.name == world.name
    assert twin.factor() is factor and twin.known is twin
    longer = asked.extend(with_edge(world, 39, 40)).renamed("c")
    assert longer.known is asked and longer.pose_graph.name == "c"
    np.testing.assert_array_equal(longer.own(39), asked.own(39))
