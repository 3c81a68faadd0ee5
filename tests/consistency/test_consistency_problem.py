"""What goes into a problem, what is refused, and its precision."""

import dataclasses
import subprocess
import sys

import consistency_worlds as worlds
import jax
import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.consistency import consistency_problem
from pcm_jax.errors import InputError
from pcm_jax.lie import unrolled


@pytest.fixture(scope="module")
def world():
    return worlds.random_world(jaxlie.SE2, seed=8, count=20)


@pytest.fixture(scope="module")
def problem(world):
    return consistency_problem(*world, marginals=worlds.marginals_of(*world))


def test_fields(world, problem):
    map_a, _, closures = world
    size, poses = len(problem.valid), problem.relative_covariance_a.shape[-1]
    assert problem.valid.sum() == 20
    assert poses >= len(np.unique(closures.pose_a))
    assert problem.measurement.get_batch_axes() == problem.pose_b.get_batch_axes() == (size,)
    assert problem.measurement_covariance.shape == (size, 3, 3)
    assert problem.relative_covariance_a.shape == (6, poses, poses)
    identity = problem.measurement_covariance[:20] @ closures.information
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), (20, 3, 3)), atol=1e-12)
    for leaf in jax.tree.leaves(problem):
        assert leaf.dtype in (np.float64, np.int32, np.bool_)
    touched = np.unique(np.asarray(closures.pose_a))
    centre = lie.as_numpy(map_a.poses).unit_complex_xy[touched, 2:].mean(axis=0)
    moved = np.asarray(problem.pose_a.unit_complex_xy)[:20, 2:] + centre
    np.testing.assert_allclose(moved, np.asarray(map_a.poses.unit_complex_xy)[closures.pose_a, 2:])


def test_relative_covariance_entry_by_entry(world, problem):
    """G against covariances of one pair at a time, with left perturbations in the moved frame."""
    map_a, _, closures = world
    joint = worlds.dense_covariance(map_a)
    pose_a, row_a = np.asarray(closures.pose_a), np.asarray(problem.row_a)
    placed = lie.as_numpy(problem.pose_a)
    for u, v in [(0, 1), (5, 2), (19, 3)]:
        sides = [lie.adjoint(lie.take(placed, k)) for k in (u, v)]
        i, j = pose_a[u], pose_a[v]
        both = np.hstack([-sides[0], sides[1]])
        blocks = joint[[i, j]][:, :, [i, j]].reshape(6, 6)
        found = unrolled.unpack(np.asarray(problem.relative_covariance_a)[:, row_a[u], row_a[v]])
        np.testing.assert_allclose(found, both @ blocks @ both.T, rtol=1e-9, atol=1e-12)


def test_rows_come_in_order_of_first_use(world, problem):
    rows = np.asarray(problem.row_a)[:20]
    assert rows[0] == 0
    assert (rows <= np.maximum.accumulate(rows)).all()
    assert (np.diff(np.maximum.accumulate(rows)) <= 1).all()


def test_it_is_a_pytree_that_replace_works_on(problem):
    doubled = jax.tree.map(lambda leaf: leaf, problem)
    assert isinstance(doubled, type(problem))
    changed = dataclasses.replace(problem, valid=~problem.valid)
    assert changed.row_a is problem.row_a


def test_pose_out_of_range(world):
    map_a, map_b, closures = world
    bad = dataclasses.replace(
        closures, pose_b=np.where(np.arange(len(closures)) == 3, 99, closures.pose_b)
    )
    with pytest.raises(InputError, match=r"closures.pose_b\[3\]: pose 99 .* expected 0 to 8"):
        consistency_problem(map_a, map_b, bad)


def test_several_robot_pairs(world):
    map_a, map_b, closures = world
    bad = dataclasses.replace(
        closures, robot_a=np.where(np.arange(len(closures)) == 3, 2, closures.robot_a)
    )
    with pytest.raises(InputError, match=r"closures: some join robots 0 to 1, others 2 to 1"):
        consistency_problem(map_a, map_b, bad)


def test_groups_differ(world):
    other = worlds.random_world(jaxlie.SE3, seed=8)
    with pytest.raises(InputError, match="map_b: poses are SE3, expected SE2 like the closures"):
        consistency_problem(world[0], other[1], world[2])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda joint: joint[:-1, :-1], r"marginals\[1\]: shape \(\d+, \d+\); expected"),
        (lambda joint: joint + np.triu(np.ones_like(joint)), r"marginals\[1\]\[.*symmetric"),
        (lambda joint: joint * np.nan, r"marginals\[1\]\[0, 0\]: nan; expected finite"),
    ],
)
def test_bad_marginals(world, damage, message):
    side_a, side_b = worlds.marginals_of(*world)
    with pytest.raises(InputError, match=message):
        consistency_problem(*world, marginals=(side_a, damage(side_b)))


@pytest.mark.slow
def test_64_bit_results_without_the_64_bit_setting():
    """In a program that never enables it: float64 in, float64 out, and the setting untouched."""
    program = """
import jax, jaxlie, numpy as np
from pcm_jax import lie
from pcm_jax.consistency import *
from pcm_jax.graph import LoopClosures, PoseGraph

rng = np.random.default_rng(0)
first, second = (
    PoseGraph.from_trajectory(
        lie.exp(jaxlie.SE2, rng.normal(size=(5, 3))), sigma_translation=0.1, sigma_rotation=0.01
    )
    for _ in range(2)
)
closures = LoopClosures.from_arrays(
    robot_a=np.zeros(5, int),
    pose_a=np.arange(5),
    robot_b=np.ones(5, int),
    pose_b=np.arange(5),
    measurement=lie.exp(jaxlie.SE2, rng.normal(size=(5, 3))),
    covariance=np.tile(np.eye(3), (5, 1, 1)),
)
problem = consistency_problem(first, second, closures)
squared = squared_mahalanobis(problem)
gate = chi2_gate(0.99, 3)
graph = consistency_graph(squared, gate)
assert squared.dtype == gate.dtype == problem.relative_covariance_a.dtype == np.float64
assert not jax.config.jax_enable_x64
definition = squared_mahalanobis(problem, kernel="jacfwd")
np.testing.assert_allclose(squared, definition, rtol=1e-11)
np.testing.assert_array_equal(graph, consistency_graph(np.asarray(squared), gate))
single = jax.tree.map(
    lambda x: np.asarray(x, np.float32) if x.dtype == np.float64 else x, problem
)
squared_single = squared_mahalanobis(single)
assert squared_single.dtype == np.float32
np.testing.assert_allclose(squared_single, squared, rtol=1e-3)
"""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
