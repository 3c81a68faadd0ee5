import dataclasses
import os

import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import InputError, InputWarning
from pcm_jax.files import read_graph, write_g2o
from pcm_jax.graph import MultiRobotGraph, PoseGraph, Priors, split
from pcm_jax.lie import R1

LABELS = [(ord("g") << 56 | ord(label) << 48) + np.arange(8) for label in "AB"]
KEYS = {letter: (ord(letter) << 56) + np.arange(8) for letter in "abz"}


@pytest.mark.parametrize("suffix", ["", ".gz", ".xz"])
@pytest.mark.parametrize("ids", ["original", "sequential"])
@pytest.mark.parametrize(
    ("names", "known"),
    [
        (("a",), None),
        (("rover",), [np.arange(8) * 3 - 5]),
        (("a", "b"), None),
        (("b", "a", "z"), [KEYS["b"], KEYS["a"], KEYS["z"]]),
        (("one, two", "b", 'three "four"'), [np.arange(8) + 100, KEYS["z"], np.arange(8)[::-1]]),
        (("z",), [KEYS["z"]]),
        (("not z",), [KEYS["z"]]),
        (("aa", "ab", "ac", "ad"), None),
        (("A", "B"), LABELS),
        (("left", "right"), LABELS),
    ],
)
def test_round_trip(tmp_path, make_robots, assert_same, group, names, known, ids, suffix):
    graph = make_robots(group, names, known)
    path = tmp_path / f"graph.g2o{suffix}"
    write_g2o(path, graph, ids=ids)
    assert_same(graph, read_graph(path))
    write_g2o(path, read_graph(path), ids=ids)
    assert_same(graph, read_graph(path))


def test_a_split_graph_round_trips(tmp_path, make_robots, assert_same, group):
    graph = split(make_robots(group, ("a",), n=8).maps[0], [4])
    write_g2o(tmp_path / "split.g2o", graph)
    assert_same(graph, read_graph(tmp_path / "split.g2o"))


def test_one_robot_is_written_as_other_programs_expect(tmp_path, make_robots):
    graph = make_robots(jaxlie.SE2, ("a",), [np.arange(8) + 3])
    write_g2o(tmp_path / "a.g2o", graph.maps[0])
    lines = (tmp_path / "a.g2o").read_text().splitlines()
    assert {line.split()[0] for line in lines} == {"VERTEX_SE2", "EDGE_SE2"}
    assert lines[0].startswith("VERTEX_SE2 3 ")


def test_symbol_keys_are_written_as_they_are(tmp_path, make_robots):
    graph = make_robots(jaxlie.SE3, ("a", "b"), [KEYS["a"], KEYS["b"]])
    write_g2o(tmp_path / "ab.g2o", graph)
    assert "#" not in (tmp_path / "ab.g2o").read_text()


def test_sequential_ids_and_their_table(tmp_path, make_robots, group):
    graph = make_robots(group, ("rover", "b"), [np.arange(8) * 2, KEYS["b"]])
    write_g2o(tmp_path / "merged.g2o", graph, ids="sequential")
    lines = (tmp_path / "merged.g2o").read_text().splitlines()
    vertices = [line.split()[1] for line in lines if line.startswith("VERTEX")]
    assert vertices == [str(k) for k in range(16)]
    table = (tmp_path / "merged.ids.csv").read_text().splitlines()
    assert table[:3] == ["vertex,robot,id", "0,rover,0", "1,rover,2"]
    assert table[-1] == f"15,b,{KEYS['b'][7]}"


def test_without_its_table_a_sequential_file_is_one_robot(tmp_path, make_robots):
    graph = make_robots(jaxlie.SE2, ("a", "b"))
    write_g2o(tmp_path / "merged.g2o", graph, ids="sequential")
    (tmp_path / "merged.ids.csv").unlink()
    with pytest.warns(InputWarning, match=r"the id table merged.ids.csv is not beside it"):
        alone = read_graph(tmp_path / "merged.g2o")
    assert [one.num_poses for one in alone.maps] == [16]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("vertex,id\n", "ids.csv:1: expected the columns vertex,robot,id"),
        ("vertex,robot,id\n0,a\n", "ids.csv:2: 2 columns, expected 3"),
        ("vertex,robot,id\n0,a,x\n", "ids.csv:2: 'x' given, expected an integer id"),
        ("vertex,robot,id\n0,a,0\n1,a,1\n", "ids.csv: changed since"),
    ],
)
def test_a_bad_table(tmp_path, make_robots, text, message):
    write_g2o(tmp_path / "merged.g2o", make_robots(jaxlie.SE2), ids="sequential")
    (tmp_path / "merged.ids.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_graph(tmp_path / "merged.g2o")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ids": "random"}, "ids: 'random' given, expected one of"),
        ({"names": ("a", "line\nbreak")}, r"robot name 'line\\nbreak' cannot be written"),
        ({"names": ("a", " b")}, "robot name ' b' cannot be written"),
        (
            {"known": [np.arange(8), np.arange(8) - 1]},
            "robot 'b' has the id -1, which fits no symbol",
        ),
        (
            {"known": [np.arange(8), np.arange(8) + 2**56 - 4]},
            "has the id 72057594037927936, which",
        ),
    ],
)
def test_what_cannot_be_written(tmp_path, make_robots, changes, message):
    graph = make_robots(jaxlie.SE2, changes.get("names", ("a", "b")), changes.get("known"))
    with pytest.raises(InputError, match=message):
        write_g2o(tmp_path / "graph.g2o", graph, ids=changes.get("ids", "original"))
    assert not list(tmp_path.iterdir())


def test_a_table_without_a_vertex(write):
    path = write("# pcm_jax id-table graph.ids.csv", "VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 0 0 0")
    write("vertex,robot,id", "0,a,0", name="graph.ids.csv")
    with pytest.raises(InputError, match=r"g2o:3: vertex 1 is not in the file's id table"):
        read_graph(path)


def test_written_files_are_read_together(tmp_path, make_robots):
    """Their letters are chosen afresh in each file; names tell whether robots are the same."""
    one, two = make_robots(jaxlie.SE2, ("ann", "bob")), make_robots(jaxlie.SE2, ("cat", "dog"))
    write_g2o(tmp_path / "1.g2o", one)
    write_g2o(tmp_path / "2.g2o", two)
    both = read_graph(tmp_path / "1.g2o", tmp_path / "2.g2o")
    assert both.names == ("ann", "bob", "cat", "dog")
    assert len(both.closures) == len(one.closures) + len(two.closures)


def test_the_line_cannot_be_written(tmp_path):
    line = PoseGraph.from_trajectory(
        R1(np.arange(3.0)[:, None]), sigma_translation=1.0, sigma_rotation=1.0
    )
    assert line.information.shape == (2, 1, 1)
    with pytest.raises(InputError, match="graph: R1 given, expected SE2 or SE3"):
        write_g2o(tmp_path / "line.g2o", line)


def test_a_table_with_an_impossible_name(write):
    lines = ("VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 0 0 0", "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1")
    path = write(f"# pcm_jax id-table {'x' * 300}", *lines)
    with pytest.warns(InputWarning, match="is not beside it"):
        assert read_graph(path).maps[0].num_poses == 2
    read_graph(write("# pcm_jax id-table ../graph.ids.csv", *lines))


def test_files_are_written_whole_or_not_at_all(tmp_path, make_robots, monkeypatch):
    path = tmp_path / "graph.g2o"
    path.write_text("what was there before")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    monkeypatch.setattr("pathlib.Path.replace", full)
    with pytest.raises(InputError, match=r"graph.g2o: cannot be written: No space left on device$"):
        write_g2o(path, make_robots(jaxlie.SE2))
    assert [one.name for one in tmp_path.iterdir()] == ["graph.g2o"]
    assert path.read_text() == "what was there before"


def test_devices_are_written_to(make_robots):
    write_g2o(os.devnull, make_robots(jaxlie.SE2))
    assert not os.path.isfile(os.devnull)  # noqa: PTH113


def test_priors_round_trip(tmp_path, make_robots, group):
    graph = make_robots(group, ("left", "right"))
    one = graph.maps[0]
    rows = np.array([2, 5])
    priors = Priors(
        rows, lie.take(lie.as_numpy(one.poses), rows), one.information[:2], np.full(2, "", object)
    )
    maps = (dataclasses.replace(one, priors=priors), graph.maps[1])
    write_g2o(tmp_path / "graph.g2o", MultiRobotGraph(maps, graph.closures))
    again = read_graph(tmp_path / "graph.g2o")
    assert again.maps[1].priors is None
    found = again.maps[0].priors
    assert found.pose.tolist() == [2, 5]
    apart = lie.log(lie.between(found.measurement, priors.measurement))
    np.testing.assert_allclose(apart, 0.0, atol=1e-12)
    np.testing.assert_allclose(found.information, priors.information, rtol=1e-12)
