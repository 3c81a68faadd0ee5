"""Simulated registrations: their errors, and the candidates that are made of them."""

from __future__ import annotations

from typing import Any

import jaxlie
import numpy as np
import pytest

from benchmarks.experiments import registrations
from benchmarks.experiments.nclt import Session
from benchmarks.experiments.registrations import COVARIANCE, draw_version, register
from pcm_jax import InputError, lie

SIGMAS = np.array([0.05, 0.05, 0.05, 0.005, 0.005, 0.005])


def error_of(measurement, exact) -> Any:
    return lie.log(lie.between(exact, measurement))


def loop(count, *, start=0.0, offset=0.0):
    """Twice round a square of 200 m, a pose every 2 m."""
    along = (start + 2.0 * np.arange(count)) % 800.0
    side, rest = np.divmod(along, 200.0)
    corners = np.array([[0.0, 0.0], [200.0, 0.0], [200.0, 200.0], [0.0, 200.0]])
    directions = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    places = corners[side.astype(int)] + rest[:, None] * directions[side.astype(int)]
    heading = 0.5 * np.pi * side
    zero = np.zeros(count)
    turns = np.stack([np.cos(heading / 2), zero, zero, np.sin(heading / 2)], axis=1)
    parameters: Any = np.column_stack([turns, places + offset, zero])
    return jaxlie.SE3(parameters)


def session(name, truth):
    rest = len(lie.parameters(truth)) - 1
    covariance = np.repeat(np.diag(SIGMAS**2)[None], rest, axis=0)
    return Session(name, truth, truth, covariance, SIGMAS, {})


@pytest.fixture(scope="module")
def sessions():
    return session("first", loop(600)), session("second", loop(500, start=300.0, offset=0.5))


@pytest.fixture(scope="module")
def version(sessions):
    return draw_version(np.random.default_rng(0), sessions)


def test_errors_are_duderstadts():
    exact = lie.take(loop(100), np.arange(20_000) % 100)
    error = error_of(register(np.random.default_rng(0), exact), exact)
    off, turned = np.linalg.norm(error[:, :3], axis=1), np.linalg.norm(error[:, 3:], axis=1)
    assert 0.07 < np.median(off) < 0.11
    assert 0.21 < np.percentile(off, 95) < 0.28
    assert np.rad2deg(np.median(turned)) == pytest.approx(1.0, rel=0.05)
    assert 2.4 < np.rad2deg(np.percentile(turned, 95)) < 3.0
    np.testing.assert_allclose(np.cov(error.T), COVARIANCE, rtol=0.15, atol=1e-4)


def test_numbers_of_the_paper(version):
    counts = registrations.counts_by_kind(version.kinds, np.ones(len(version.kinds), bool))
    assert counts["true"] == version.is_true.sum() == 10
    assert sum(counts.values()) == len(version.graph.closures) == 108
    assert counts["aliased"] == 8
    assert abs(counts["near_identity"] - counts["swapped"]) <= 1
    np.testing.assert_array_equal(version.is_true, version.kinds == "true")


def test_only_the_threshold_says_what_is_right(version):
    closures = version.graph.closures
    ends = [
        lie.take(version.truth[robot], np.asarray(pose))
        for robot, pose in enumerate((closures.pose_a, closures.pose_b))
    ]
    exact, measured = lie.between(*ends), lie.as_numpy(closures.measurement)
    np.testing.assert_array_equal(registrations.is_right(measured, exact), version.is_true)
    near = np.linalg.norm(lie.translation(exact), axis=1) <= registrations.REACH
    np.testing.assert_array_equal(near, np.isin(version.kinds, ["true", "poor"]))
    looks_near = np.linalg.norm(lie.translation(measured), axis=1) < 6.0
    assert looks_near.all()  # no outlier is known by the distance that it claims


def test_poor_registrations_are_near_misses(sessions):
    found = []
    for seed in range(20):
        version = draw_version(np.random.default_rng(seed), sessions)
        closures, poor = version.graph.closures, version.kinds == "poor"
        ends = [
            lie.take(version.truth[robot], np.asarray(pose)[poor])
            for robot, pose in enumerate((closures.pose_a, closures.pose_b))
        ]
        measured = lie.take(lie.as_numpy(closures.measurement), poor)
        found.append(error_of(measured, lie.between(*ends)))
    errors = np.concatenate(found)
    assert 5 < len(errors) < 60  # one in a hundred of 3,000
    assert np.median(np.linalg.norm(errors[:, :3], axis=1)) < 1.0


def test_maps_return_to_places(version):
    for one, truth in zip(version.graph.maps, version.truth, strict=True):
        tail, head = np.asarray(one.tail), np.asarray(one.head)
        loops = head - tail != 1
        assert loops.sum() > 20
        exact = lie.between(lie.take(truth, tail[loops]), lie.take(truth, head[loops]))
        error = error_of(lie.take(lie.as_numpy(one.measurement), loops), exact)
        assert np.median(np.linalg.norm(error[:, :3], axis=1)) < 0.2
        assert np.linalg.norm(lie.translation(exact), axis=1).max() <= registrations.REACH


def test_sessions_of_different_places():
    pair = session("first", loop(600)), session("second", loop(600, offset=5_000.0))
    with pytest.raises(InputError, match="first and second have 0 places in common"):
        draw_version(np.random.default_rng(0), pair)
