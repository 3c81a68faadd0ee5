"""The streamed graph against the dense one, bit by bit; killed and resumed; and what is refused."""

import dataclasses

import consistency_worlds as worlds
import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.consistency import (
    PackedGraph,
    chi2_gate,
    consistency_graph,
    consistency_problem,
    squared_mahalanobis,
    stream_consistency_graph,
)
from pcm_jax.errors import InputError

COUNT, PANEL = 201, 64  # neither a whole number of panels nor of bytes
PAIRS = COUNT * (COUNT - 1) // 2


def make_world(group, seed, count=COUNT):
    """Two maps and closures in no order, some of which share poses, some the maps' first ones."""
    rng = np.random.default_rng(seed)
    maps = [worlds.random_map(group, rng, poses=poses, loops=15) for poses in (30, 45)]
    return *maps, worlds.random_closures(group, rng, *maps, count)


def dense_graph_and_gate(world, share):
    """The graph by way of Q, and a gate in the widest gap near a quantile of its distances."""
    squared = np.asarray(squared_mahalanobis(consistency_problem(*world)))
    values = np.sort(np.maximum(squared, squared.T)[np.triu_indices(len(squared), 1)])
    near = int(share * len(values)) + np.arange(100)
    at = near[np.argmax(np.diff(np.log(values[near])))]
    gate = float(np.sqrt(values[at] * values[at + 1]))
    return np.asarray(consistency_graph(squared, gate)), gate


@pytest.fixture(scope="module")
def plane():
    return make_world(jaxlie.SE2, seed=5)


@pytest.mark.slow
def test_same_bits_as_the_dense_graph(group):
    world = make_world(group, seed=3)
    touched = np.asarray(world[2].pose_a)
    assert (touched == 0).any()  # the pose held fixed
    assert len(np.unique(touched)) < COUNT / 4
    dense, gate = dense_graph_and_gate(world, share=0.3)
    assert 0.2 < dense.mean() < 0.4
    streamed = stream_consistency_graph(*world, gate, panel=PANEL)
    assert streamed.bits.shape == (COUNT, 26)
    assert streamed.bits.dtype == np.uint8
    np.testing.assert_array_equal(streamed.dense(), dense)
    np.testing.assert_array_equal(streamed.degree, dense.sum(axis=1))


def test_panels_of_another_size(plane):
    dense, gate = dense_graph_and_gate(plane, share=0.5)
    streamed = stream_consistency_graph(*plane, gate)
    np.testing.assert_array_equal(streamed.dense(), dense)


def test_far_from_the_origin(plane):
    """1,000 km away a covariance in the map's own frame has lost its last digits."""
    dense, gate = dense_graph_and_gate(plane, share=0.3)
    motion = lie.exp(jaxlie.SE2, np.array([1e6, -1e6, 1.0]))
    far = [worlds.moved_map(graph, motion) for graph in plane[:2]]
    streamed = stream_consistency_graph(*far, plane[2], gate, panel=PANEL)
    np.testing.assert_array_equal(streamed.dense(), dense)


class KilledError(Exception):
    """Stands for whatever stops a run."""


def test_resumes_after_a_kill(plane, tmp_path):
    dense, gate = dense_graph_and_gate(plane, share=0.3)

    def kill(stage, done, _):
        seen.append(done)
        if len(seen) == 2:
            raise KilledError

    seen: list[int] = []
    with pytest.raises(KilledError):
        stream_consistency_graph(*plane, gate, panel=PANEL, folder=tmp_path, progress=kill)
    finished = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert len(finished) == 2
    calls = []
    again = stream_consistency_graph(
        *plane, gate, panel=PANEL, folder=tmp_path, progress=lambda stage, *now: calls.append(now)
    )
    np.testing.assert_array_equal(again.dense(), dense)
    assert [done for done, _ in calls[:2]] == seen
    assert [calls[-1], len(calls)] == [(PAIRS, PAIRS), 4]
    assert all(path.stat().st_mtime_ns == then for path, then in finished.items())
    assert len(list(tmp_path.iterdir())) == 4


def test_what_was_kept_is_believed_only_if_it_fits(plane, tmp_path):
    dense, gate = dense_graph_and_gate(plane, share=0.3)
    stream_consistency_graph(*plane, gate, panel=PANEL, folder=tmp_path)
    kept = sorted(tmp_path.iterdir())
    kept[0].write_bytes(b"")
    kept[1].write_bytes(kept[1].read_bytes()[:-9])
    np.save(kept[2], np.zeros((2, 2), np.uint8))
    again = stream_consistency_graph(*plane, gate, panel=PANEL, folder=tmp_path)
    np.testing.assert_array_equal(again.dense(), dense)
    information = plane[2].information * 0.01
    others = [
        (plane, 0.5 * gate),
        ((*plane[:2], dataclasses.replace(plane[2], information=information)), gate),
    ]
    for world, other_gate in others:
        squared = np.asarray(squared_mahalanobis(consistency_problem(*world)))
        streamed = stream_consistency_graph(*world, other_gate, panel=PANEL, folder=tmp_path)
        expected = consistency_graph(squared, other_gate)
        assert (expected != dense).any()
        np.testing.assert_array_equal(streamed.dense(), expected)


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_to_disagree(plane, count):
    progress = []
    world = (*plane[:2], plane[2][np.arange(count)])
    graph = stream_consistency_graph(*world, 1.0, progress=lambda stage, *now: progress.append(now))
    assert graph.count == count
    assert graph.bits.shape == (count, count)
    assert not graph.dense().any()
    assert progress == [(0, 0)] * count


def test_a_gate_of_nothing_lets_nothing_pass(plane):
    world = (*plane[:2], plane[2][np.arange(3)])
    assert not stream_consistency_graph(*world, 0.0).dense().any()
    with pytest.raises(InputError, match="gate: -1e-300; expected one squared distance"):
        stream_consistency_graph(*world, -1e-300)


def test_packed_graph():
    dense = np.triu(np.random.default_rng(1).random((19, 19)) < 0.5, 1)
    dense |= dense.T
    graph = PackedGraph(np.packbits(dense, axis=1), 19)
    np.testing.assert_array_equal(graph.dense(), dense)
    assert graph.dense().dtype == bool
    assert graph.degree.tolist() == dense.sum(axis=1).tolist()


def test_refused(plane):
    map_a, map_b, closures = plane
    gate = float(chi2_gate(0.99, 3))
    with pytest.raises(InputError, match="panel: 100; expected a multiple of 64"):
        stream_consistency_graph(*plane, gate, panel=100)
    with pytest.raises(InputError, match="gate: nan; expected one squared distance"):
        stream_consistency_graph(*plane, np.nan)
    outside = dataclasses.replace(closures, pose_a=closures.pose_a + 25)
    with pytest.raises(InputError, match=r"closures.pose_a\[\d+\]: pose \d+ is not in the map"):
        stream_consistency_graph(map_a, map_b, outside, gate)
