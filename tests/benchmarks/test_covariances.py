"""That worlds, covariances and rates are what the experiment says, on small worlds."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from benchmarks import covariances
from benchmarks.experiments.drifting import CITY, RIGHT, Point, candidates, odometry
from pcm_jax import chi2_gate, consistency_problem, lie, squared_mahalanobis

pytestmark = pytest.mark.slow


SMALL = CITY._replace(poses=120, drifts=(1.0, 2.0), shares=(0.0, 1.0), share=1.0)


@pytest.fixture(scope="module")
def inside():
    """Share of the right pairs within the 95 % gate, in 100 worlds with all their loops."""
    gate, found = float(chi2_gate(0.95, 3)), []
    pairs = ~np.eye(RIGHT, dtype=bool)
    for number in range(100):
        world = candidates(SMALL, Point(1.0, 1.0), 7, number)
        right = np.ix_(world.right, world.right)
        distances = covariances.squared_distances(world.graph)
        found.append([(each[right][pairs] <= gate).mean() for each in distances.values()])
    return dict(zip(covariances.COVARIANCES, np.mean(found, axis=0), strict=True))


def test_the_joint_covariance_is_calibrated(inside):
    assert 0.93 < inside["joint"] < 0.97


def test_the_others_are_not(inside):
    assert inside["independent"] > 0.98
    assert inside["odometry-chain"] > 0.98


def test_without_loops_the_chain_is_the_joint():
    world = candidates(SMALL, Point(1.0, 0.0), 0, 0)
    assert all(odometry(one).all() for one in world.graph.maps)
    distances = covariances.squared_distances(world.graph)
    np.testing.assert_allclose(distances["odometry-chain"], distances["joint"], rtol=1e-9)
    a, b = world.graph.maps
    own = np.asarray(squared_mahalanobis(consistency_problem(a, b, world.graph.closures)))
    np.testing.assert_allclose(distances["joint"], own, rtol=1e-9)
    assert (distances["independent"] <= distances["joint"] * (1 + 1e-9)).mean() > 0.99


def test_points_share_their_worlds_and_differ_in_noise():
    quiet, loud = (candidates(SMALL, Point(drift, 1.0), 0, 3) for drift in (0.5, 1.0))
    np.testing.assert_array_equal(quiet.right, loud.right)
    for one, other in zip(quiet.graph.maps, loud.graph.maps, strict=True):
        np.testing.assert_array_equal(one.head, other.head)
    errors = [
        np.std(lie.log(_error(world))[odometry(world.graph.maps[0])], axis=0)
        for world in (quiet, loud)
    ]
    np.testing.assert_allclose(errors[1], 2.0 * errors[0], rtol=1e-6)


def _error(world):
    one, truth = world.graph.maps[0], world.truth[0]
    ends = (lie.take(truth, np.asarray(index)) for index in (one.tail, one.head))
    return lie.between(lie.between(*ends), lie.as_numpy(one.measurement))


def test_the_next_place_is_a_street_further_on():
    world = candidates(SMALL, Point(1.0, 1.0), 0, 3)
    closures, (truth_a, truth_b) = world.graph.closures, world.truth
    stands = lie.compose(
        lie.take(truth_a, np.asarray(closures.pose_a)), lie.as_numpy(closures.measurement)
    )
    moved = lie.translation(stands) - lie.translation(
        lie.take(truth_b, np.asarray(closures.pose_b))
    )
    distance = np.linalg.norm(moved, axis=1)
    assert world.next_place.sum() == 5
    np.testing.assert_allclose(distance[world.next_place], 5.0, atol=0.2)
    np.testing.assert_allclose(distance[world.right], 0.0, atol=0.2)


def test_shape_of_the_result(tmp_path, monkeypatch):
    monkeypatch.setattr(covariances, "KINDS", {"city": SMALL})
    monkeypatch.setattr(covariances, "SOURCES", ())
    arguments = ["--worlds", "1", "--kinds", "city", "--out", str(tmp_path)]
    assert covariances.main(arguments) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert [(point["drift"], point["share"]) for point in summary["city"]] == [
        (1.0, 1.0),
        (2.0, 1.0),
        (2.0, 0.0),
    ]
    rows = {f"{name}-{gate}" for name in covariances.COVARIANCES for gate in (95, 99)}
    for point in summary["city"]:
        assert set(point["methods"]) == rows | {"no-outliers"}
        inside = [point["gates"][f"joint-{c:g}"]["inside"] for c in covariances.CONFIDENCES]
        assert inside == sorted(inside)
        assert point["methods"]["joint-99"]["fpr"] < 0.05
    with (tmp_path / "points.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 3 * 7
    for picture in ("drift", "loops", "gates"):
        assert (tmp_path / f"city-{picture}.png").stat().st_size > 10_000

    def never(*_):
        raise RuntimeError("a world that is kept is not run again")

    monkeypatch.setattr(covariances, "run_world", never)
    assert covariances.main(arguments) == 0
