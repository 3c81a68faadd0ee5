"""`python -m benchmarks.peers`: every library solves one small graph, and comes to our cost."""

import subprocess
import sys

import numpy as np
import pytest

from benchmarks import peers
from benchmarks.experiments import ceres_peer, symforce_peer
from benchmarks.suite import gtsam_peer
from benchmarks.suite.optimization import at_chordal_poses
from pcm_jax import lie, optimize
from pcm_jax.simulation import simulate_city, simulate_sessions

SIMULATE = {3: simulate_city, 6: simulate_sessions}


def small_graph(tangent_dim):
    world = SIMULATE[tangent_dim](seed=3, poses=60, inliers=0, aliased_groups=0, random=1)
    return at_chordal_poses(world.graph.maps[0])


@pytest.mark.parametrize("tangent_dim", [3, 6])
@pytest.mark.parametrize("peer", ["gtsam", "symforce", "ceres"])
def test_a_library_comes_to_our_optimum(peer, tangent_dim):
    installed = {"gtsam": gtsam_peer.gtsam, "symforce": symforce_peer.cc_sym}
    if installed.get(peer, ceres_peer.pyceres) is None:
        pytest.skip(f"{peer} is not installed")
    graph = small_graph(tangent_dim)
    ready = peers._contestant(peer, graph)
    if peer == "ceres" and tangent_dim == 6:
        assert ready is None
        return
    best = optimize(graph, initial="given").cost
    start = peers.cost_at(graph, np.asarray(lie.as_matrix(lie.as_numpy(graph.poses))))
    assert start > best * (1 + 1e-6)
    for _ in range(2):  # the second time from the same start
        assert peers.cost_at(graph, ready()()()) == pytest.approx(best, rel=1e-7)


def test_mrob_in_the_plane():
    if subprocess.run([sys.executable, "-c", "import mrob"], check=False).returncode:
        pytest.skip("mrob is not installed")
    graph = small_graph(3)
    seconds, poses = peers._by_mrob(graph, sys.executable)
    assert seconds > 0
    # Its residuals are differences of coordinates: the same to first order in the noise.
    assert peers.cost_at(graph, poses) == pytest.approx(optimize(graph).cost, rel=0.05)
    moved = np.asarray(lie.as_matrix(lie.as_numpy(optimize(graph).graph.poses))) - poses
    assert np.abs(moved).max() < 0.02
