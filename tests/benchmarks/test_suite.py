"""The suite itself: its cases are well formed, its peer is given the same problem, it runs."""

import dataclasses
import json
import subprocess
import sys

import gtsam
import jaxlie
import numpy as np
import pytest

from benchmarks.__main__ import SUBJECTS, all_cases, main
from benchmarks.suite import gtsam_peer, maps, memory, optimization
from benchmarks.suite.harness import ROOT, Measured, Settings, chosen
from benchmarks.suite.random_worlds import moved, random_closures, random_map
from pcm_jax import lie, optimize
from pcm_jax.arrays import device_array


def test_every_metric_has_one_name_and_its_subject_s():
    cases = all_cases()
    names = [f"{case.name}/{metric.name}" for case in cases for metric in case.metrics]
    assert len(names) == len(set(names))
    assert {name.split("/")[0] for name in names} == set(SUBJECTS)


def test_stand_ins_only_where_the_files_are_absent(tmp_path):
    def stand_ins(settings):
        return {case.name for case in chosen(all_cases(), settings, ()) if "simulated" in case.name}

    assert stand_ins(Settings(True, tmp_path)) == {
        "optimization/simulated-city",
        "optimization/simulated-campus",
        "marginals/simulated-city-100",
        "marginals/simulated-city-230",
        "marginals/simulated-city-300",
        "files/simulated-city",
    }
    for relative in maps.FILES.values():
        path = tmp_path / relative
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    assert stand_ins(Settings(True, tmp_path)) == set()


def edge_errors(graph):
    poses = lie.as_numpy(graph.poses)
    relative = lie.between(*(lie.take(poses, np.asarray(k)) for k in (graph.tail, graph.head)))
    return relative, lie.log(lie.between(lie.as_numpy(graph.measurement), relative))


def dense_covariance(graph):
    """Of right perturbations of all poses but the first, which is held."""
    relative, error = edge_errors(graph)
    to_head = lie.right_jacobian_inverse(graph.group, error)
    to_tail = -to_head @ lie.adjoint(lie.inverse(relative))
    edges, d = np.arange(graph.num_edges), graph.tangent_dim
    jacobian = np.zeros((graph.num_edges, d, graph.num_poses, d))
    jacobian[edges, :, np.asarray(graph.head)] = to_head
    jacobian[edges, :, np.asarray(graph.tail)] = to_tail
    flat = jacobian[:, :, 1:].reshape(graph.num_edges, d, -1)
    return np.linalg.inv(np.einsum("eip,eij,ejq->pq", flat, np.asarray(graph.information), flat))


@pytest.mark.parametrize("group", [jaxlie.SE2, jaxlie.SE3], ids=["SE2", "SE3"])
def test_gtsam_is_given_the_same_problem(group):
    graph = random_map(group, np.random.default_rng(3), poses=12, loops=6)
    _, error = edge_errors(graph)
    cost = 0.5 * np.einsum("ei,eij,ej->", error, np.asarray(graph.information), error)
    factors, values = gtsam_peer.factors_and_values(graph, "solve")
    assert factors.error(values) == pytest.approx(cost, rel=1e-9)

    optimum = gtsam_peer.gauss_newton(factors, values).optimize()
    at = optimum.atPose2 if group is jaxlie.SE2 else optimum.atPose3
    solved = lie.from_matrix(np.stack([at(k).matrix() for k in range(12)]))
    graph = graph.with_poses(lie.as_device(solved))
    factors, values = gtsam_peer.factors_and_values(graph, "marginals")
    poses = np.arange(1, 12)
    found = gtsam_peer.joint_marginal_covariance(factors, values, poses)
    expected = dense_covariance(graph)
    found = gtsam_peer.in_our_order(found, graph.tangent_dim)
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()


def test_gtsam_needs_no_jax_for_a_plain_graph():
    program = "import sys, benchmarks.suite.gtsam_peer; print('jax' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, check=True, capture_output=True, text=True
    )
    assert done.stdout.strip() == "False"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")
def test_memory_of_one_solve(tmp_path):
    graph = random_map(jaxlie.SE2, np.random.default_rng(3), poses=300, loops=100)
    np.savez(tmp_path / "graph.npz", **gtsam_peer.plain(graph)._asdict())
    found = {each: memory.one_solve(each, tmp_path / "graph.npz") for each in ("blocks", "gtsam")}
    for megabytes in found.values():
        assert 10.0 < megabytes["before"] <= megabytes["solving"] <= megabytes["whole"]
    assert found["gtsam"]["whole"] < found["blocks"]["before"]


def test_lago_and_gauss_newton_find_our_optimum():
    graph = random_map(jaxlie.SE2, np.random.default_rng(5), poses=40, loops=20)
    diagonal = np.broadcast_to(np.diag([25.0, 16.0, 400.0]), graph.information.shape)
    graph = dataclasses.replace(graph, information=device_array(diagonal))
    factors, _ = gtsam_peer.factors_and_values(graph, "solve")
    found = factors.error(gtsam_peer.lago_and_gauss_newton(factors))
    assert found == pytest.approx(optimize(graph).cost, rel=1e-6)


def test_the_mean_of_ratios_is_geometric_and_of_all():
    ratios = {"a": Measured(2.0), "b": Measured(0.5)}
    assert optimization.mean_of(ratios).value == pytest.approx(1.0)
    missing = optimization.mean_of(ratios | {"c": Measured(None, "no engine")})
    assert missing == Measured(None, "no engine")


@pytest.mark.parametrize("group", [jaxlie.SE2, jaxlie.SE3], ids=["SE2", "SE3"])
def test_random_worlds_are_drawn_with_the_covariance_they_state(group):
    rng = np.random.default_rng(4)
    graph = random_map(group, rng, poses=400, loops=200)
    _, error = edge_errors(graph)
    squared = np.einsum("ei,eij,ej->e", error, np.asarray(graph.information), error)
    d = graph.tangent_dim
    assert squared.mean() == pytest.approx(d, abs=4 * np.sqrt(2 * d / len(squared)))
    far = moved(graph, rng, 1e3)
    np.testing.assert_allclose(edge_errors(far)[1], error, atol=1e-10)
    closures = random_closures(rng, [graph, graph], 50, once=True)
    assert len(np.unique(closures.pose_a)) == len(np.unique(closures.pose_b)) == 50


@pytest.mark.slow
def test_a_row_without_data_or_peer_says_why(tmp_path, monkeypatch, capsys):
    arguments = ["--quick", "--only", "end_to_end/spoiled", "--data", str(tmp_path / "nothing")]
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    (entry,) = summary.values()
    assert entry["value"] is None
    assert "is not in the folder of public data (--data)" in entry["note"]
    assert entry["note"] in capsys.readouterr().out
    monkeypatch.setattr(gtsam_peer, "gtsam", None)
    with pytest.raises(gtsam_peer.NotMeasuredError, match=r"pip install '\.\[bench\]'"):
        gtsam_peer.require()
    assert gtsam.Pose2 is not None


@pytest.mark.slow
def test_one_subject_from_the_command_line(tmp_path, capsys):
    assert main(["--quick", "--only", "cliques/planted", "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert set(summary) == {"cliques/planted/planted-150", "cliques/planted/planted-300"}
    entry = summary["cliques/planted/planted-300"]
    assert {"value", "unit", "direction", "baseline"} <= set(entry)
    assert entry["value"] > 0.0
    assert "| cliques/planted/planted-300 |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "nonsense"], "--only: no case starts so; expected one of optimization"),
        (["--quick", "--record"], "--record: expected the whole suite"),
    ],
)
def test_bad_options(arguments, message, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([*arguments, "--out", str(tmp_path)])
    assert stopped.value.code == 2
    assert message in capsys.readouterr().err
