"""Hints are followed on the data before they are given, and `inspect` and `merge` give the same."""

import dataclasses
import json

import pytest

from pcm_jax import MultiRobotGraph, lie, write_g2o
from pcm_jax.simulation import simulate_city

HINT = "--information sqrt"


@pytest.fixture
def stated(city, tmp_path):
    """The city's file, its information times a factor."""

    def write(translation, rotation, name="stated.g2o"):
        text = (city / "graph.g2o").read_text()
        text = text.replace(" 2500.0", f" {translation}").replace(" 10000.0", f" {rotation}")
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write


def both(run, path, *options):
    """True if both commands give the hint, False if neither does."""
    inspected = json.loads(run("inspect", path, "--json", *options).out)
    given = [
        any(HINT in line for line in inspected["odd"]),
        HINT in run("merge", path, *options).out,
    ]
    assert len(set(given)) == 1, (path, given)
    return given[0]


def test_square_roots_taken_as_written_are_told(run, stated):
    """As iSAM's files hold them: read so, the maps fit as stated noise does."""
    path = stated(50.0, 100.0)
    assert both(run, path)
    assert not both(run, path, "--information", "sqrt")


def test_noise_as_stated_is_not_doubted(run, city):
    assert not both(run, city / "graph.g2o")


def test_sigmas_too_large_by_any_other_factor_are_no_square_root(run, stated):
    """A fit as far beyond 1 on the other side is no better a reading."""
    assert not both(run, stated(20.0, 300.0))
    assert not both(run, stated(200.0, 400.0))


def test_a_fit_without_noise_says_nothing(run, tmp_path):
    """Poses and measurements that agree exactly: no reading fits better than any other."""
    lines = []
    for robot in "ab":
        key = ord(robot) << 56
        lines += [f"VERTEX_SE2 {key + k} {k} 0 0" for k in range(4)]
        ends = [(0, 1), (1, 2), (2, 3), (0, 2), (1, 3)]
        lines += [f"EDGE_SE2 {key + i} {key + j} {j - i} 0 0 4 0 0 4 0 9" for i, j in ends]
    a, b = (ord(robot) << 56 for robot in "ab")
    lines += [f"EDGE_SE2 {a + k} {b + k} 0 1 0 4 0 0 4 0 9" for k in range(3)]
    (tmp_path / "exact.g2o").write_text("\n".join(lines) + "\n")
    assert not both(run, tmp_path / "exact.g2o")


def test_inverted_closures_are_told(run, tmp_path):
    """Every measurement between the robots is the pose of the first seen from the second."""
    graph = simulate_city(poses=60, inliers=12, aliased_groups=0, random=0).graph
    closures = graph.closures
    inverted = dataclasses.replace(closures, measurement=lie.inverse(closures.measurement))
    write_g2o(tmp_path / "inverted.g2o", MultiRobotGraph(graph.maps, inverted))
    write_g2o(tmp_path / "right.g2o", graph)
    report = tmp_path / "report.json"
    ran = run("merge", tmp_path / "inverted.g2o", "--report", report)
    assert ran.status == 0
    (hint,) = json.loads(report.read_text())["hints"]
    assert hint.startswith("nearly every closure is rejected; inverted: 12 of 12 closures agree if")
    assert hint in ran.out
    assert "next: mend the closures as said above, and merge again" in ran.out.splitlines()
    assert "inverted" not in run("merge", tmp_path / "right.g2o").out.replace("inverted.g2o", "")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("city10000/city10000.g2o.xz", True),  # 0.016 as written, 0.996 as square roots
        ("classic2d/manhattanOlson3500.isam.txt.xz", True),  # 0.023 and 1.04
        ("classic2d/intel.g2o.xz", False),  # 0.019 and 2.6
        ("classic3d/sphere2500.g2o.xz", False),  # 0.092 and 8.6
        ("classic3d/parking-garage.g2o.xz", False),  # 5e-5 both ways
    ],
)
def test_on_public_files(run, shared_data, name, told):
    """One map each: what it says of itself."""
    if not (shared_data / name).exists():
        pytest.skip(f"{name} is not there")
    odd = json.loads(run("inspect", shared_data / name, "--json").out)["odd"]
    assert any(HINT in line for line in odd) is told
