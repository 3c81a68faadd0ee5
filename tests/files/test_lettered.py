"""Candidates by letters of a file's own, beside maps of plain ids: ROMAN's layout.

As its writer has it (mit-acl/roman, roman/align/results.py): a line `# LC: n`, then an edge between
`a12` and `b7`, whoever the two robots are; `align/NAME_NAME/align.g2o` beside `NAME.g2o`.
"""

import numpy as np
import pytest

from pcm_jax.errors import FileFormatError, InputWarning
from pcm_jax.files import read_candidates, read_graph

ROWS = ("4.0" + 5 * " 0.0", "4.0" + 4 * " 0.0", "4.0 0.0 0.0 0.0", "9.0 0.0 0.0", "9.0 0.0", "9.0")
TRIANGLE = " \t".join(ROWS)
EDGE = "EDGE_SE3:QUAT {} {} \t1.0 0.0 0.0 \t0.0 0.0 0.0 1.0 \t" + TRIANGLE + " \t"


@pytest.fixture
def maps(write):
    return {
        name: write(*(EDGE.format(k, k + 1) for k in range(length)), name=f"{name}.g2o")
        for name, length in (("alice", 4), ("bob", 3), ("carol", 5))
    }


def pair(write, name="align.g2o"):
    lines = [EDGE.format("a1", "b2"), "# LC: 7", EDGE.format("a3", "b0")]
    return write("# LC: 5", *lines, name=name)


def check(graph, robots):
    closures = graph.closures
    assert [graph.names[k] for k in (closures.robot_a[0], closures.robot_b[0])] == robots
    np.testing.assert_array_equal(closures.pose_a, [1, 3])
    np.testing.assert_array_equal(closures.pose_b, [2, 0])
    np.testing.assert_array_equal(closures.weight, [5.0, 7.0])


@pytest.mark.filterwarnings("ignore::pcm_jax.errors.InputWarning")
@pytest.mark.parametrize("how", ["among the maps", "as closures", "to maps in memory"])
def test_two_robots_are_meant_in_their_order(write, maps, how):
    path = pair(write)
    if how == "among the maps":
        graph = read_graph(maps["bob"], path, maps["alice"])
    elif how == "as closures":
        graph = read_graph(maps["bob"], maps["alice"], closures=path)
    else:
        graph = read_graph(maps["bob"], maps["alice"])
        graph = type(graph)(graph.maps, read_candidates(path, graph))
    check(graph, ["bob", "alice"])


def test_who_is_meant_is_told(write, maps):
    with pytest.warns(InputWarning, match="candidates by letters: a is bob, b is alice"):
        read_graph(maps["bob"], maps["alice"], closures=pair(write))


@pytest.mark.filterwarnings("ignore::pcm_jax.errors.InputWarning")
def test_a_file_or_its_folder_is_called_after_the_two(write, maps, tmp_path):
    check(read_graph(*maps.values(), closures=pair(write, "carol_bob.g2o")), ["carol", "bob"])
    (tmp_path / "carol_alice").mkdir()
    own = pair(write, "carol_alice/align.g2o")
    check(read_graph(*maps.values(), closures=own), ["carol", "alice"])


def test_of_three_robots_any_two_may_be_meant(write, maps):
    with pytest.raises(FileFormatError, match=r"align.g2o:2: robots a, b given, but which"):
        read_graph(*maps.values(), closures=pair(write))


def test_closures_of_one_robot_with_itself_are_refused(write, maps):
    with pytest.raises(FileFormatError, match="closure from robot 'bob' to itself"):
        read_graph(maps["alice"], maps["bob"], closures=pair(write, "bob_bob.g2o"))


def test_letters_that_are_names(write):
    steps = [EDGE.format(k, k + 1) for k in range(4)]
    a, b, c = (write(*steps, name=f"{name}.g2o") for name in "abc")
    check(read_graph(c, b, a, closures=pair(write)), ["a", "b"])
    with pytest.raises(FileFormatError, match="called after b and c"):
        read_graph(c, b, a, closures=pair(write, "b_c.g2o"))


def test_text_ids_of_one_file_are_symbols(write):
    own = [EDGE.format(f"{robot}{k}", f"{robot}{k + 1}") for robot in "ab" for k in range(3)]
    graph = read_graph(write(*own, EDGE.format("a0", "b1"), name="both.g2o"))
    assert graph.names == ("a", "b")
    assert len(graph.closures) == 1


@pytest.mark.parametrize("wrong", ["ab1", "a", "a-1", "a1.5", "é1", "a99999999999999999999"])
def test_text_that_is_no_id(write, wrong):
    path = write(EDGE.format("a0", wrong), name="one.g2o")
    with pytest.raises(FileFormatError, match=r"one.g2o:1: '.*' given, expected an integer id of"):
        read_graph(path)
