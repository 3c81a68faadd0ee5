"""There and back through every format that is read and written, by what the registry says of it."""

import dataclasses

import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.files import read_candidates, read_graph, write_graph
from pcm_jax.files.formats import formats
from pcm_jax.graph import MultiRobotGraph, Priors

BOTH_WAYS = [one for one in formats() if one.read is not None and one.write is not None]
GROUPS = {"open3d": [jaxlie.SE3]}  # the others hold both
NAMELESS = {"open3d"}  # its robots are parts of one list of poses, numbered through


def full(make_robots, rng, group):
    """Two robots with everything that a container can hold."""
    graph = make_robots(group)
    d, labels = graph.tangent_dim, rng.random(len(graph.closures)) < 0.5
    labels[:2] = True, False
    closures = dataclasses.replace(
        graph.closures, weight=rng.integers(1, 9, len(labels)).astype(float), is_true=labels
    )
    root = rng.normal(size=(2, d, d))
    maps = [
        dataclasses.replace(
            own,
            stamps=1e9 + 0.5 * np.arange(own.num_poses),
            priors=Priors.from_arrays(
                pose=[1, 4],
                measurement=lie.exp(group, rng.normal(size=(2, d))),
                information=root @ root.swapaxes(1, 2) + np.eye(d),
            ),
        )
        for own in graph.maps
    ]
    truth = tuple(lie.exp(group, rng.normal(size=(own.num_poses, d))) for own in maps)
    return MultiRobotGraph(tuple(maps), closures, truth)


def assert_same_transforms(found, expected):
    apart = np.asarray(lie.log(lie.between(lie.as_numpy(expected), lie.as_numpy(found))))
    np.testing.assert_allclose(apart, 0.0, atol=1e-9)


def assert_same_measurements(found, expected):
    assert_same_transforms(found.measurement, expected.measurement)
    np.testing.assert_allclose(found.information, expected.information, rtol=1e-9, atol=1e-9)


def in_order(graph):
    """The graph with its measurements by their later pose: JRL has one entry a pose."""
    maps = [
        own.with_edges(np.argsort(np.maximum(own.tail, own.head), kind="stable"))
        for own in graph.maps
    ]
    closures = graph.closures[np.lexsort((graph.closures.pose_a, graph.closures.robot_a))]
    return MultiRobotGraph(tuple(maps), closures, graph.truth)


def assert_same_closures(found, expected, kept):
    for field in ("robot_a", "pose_a", "robot_b", "pose_b"):
        np.testing.assert_array_equal(getattr(found, field), getattr(expected, field))
    assert_same_measurements(found, expected)
    if kept("labels"):
        np.testing.assert_array_equal(found.is_true, expected.is_true)
    else:
        assert found.is_true is None


def cases():
    for one in BOTH_WAYS:
        for group in GROUPS.get(one.name, [jaxlie.SE2, jaxlie.SE3]):
            yield pytest.param(one, group, id=f"{one.name}-{group.__name__}")


def test_every_writer_has_a_reader():
    """A format that is written and not read could not be tested here."""
    assert {one.name for one in formats() if one.write is not None} == {
        one.name for one in BOTH_WAYS
    }
    assert len(BOTH_WAYS) >= 4


@pytest.mark.parametrize(("one", "group"), list(cases()))
def test_there_and_back(one, group, make_robots, rng, tmp_path):
    graph = full(make_robots, rng, group)
    path = tmp_path / f"written{one.suffixes[0]}"
    write_graph(path, graph, format=one.name)

    def kept(what):
        return getattr(one, what).startswith("kept")

    if "candidate" in one.about and "graph" not in one.about:
        assert_same_closures(read_candidates(path, graph), graph.closures, kept)
        np.testing.assert_array_equal(read_candidates(path, graph).weight, graph.closures.weight)
        return
    again, graph = in_order(read_graph(path, format=one.name)), in_order(graph)
    if one.name not in NAMELESS:
        assert again.names == graph.names
    for found, expected in zip(again.maps, graph.maps, strict=True):
        assert_same_transforms(found.poses, expected.poses)
        first = found.ids[0] if one.name in NAMELESS else 0
        np.testing.assert_array_equal(found.ids - first, expected.ids)
        np.testing.assert_array_equal(found.tail, expected.tail)
        np.testing.assert_array_equal(found.head, expected.head)
        assert_same_measurements(found, expected)
        if kept("priors"):
            np.testing.assert_array_equal(found.priors.pose, expected.priors.pose)
            assert_same_measurements(found.priors, expected.priors)
        else:
            assert found.priors is None
        if kept("stamps"):
            np.testing.assert_allclose(found.stamps, expected.stamps, atol=1e-6)
        else:
            assert found.stamps is None
    assert_same_closures(again.closures, graph.closures, kept)
    if "true poses" in one.labels:
        for found, expected in zip(again.truth, graph.truth, strict=True):
            assert_same_transforms(found, expected)
    else:
        assert again.truth is None
