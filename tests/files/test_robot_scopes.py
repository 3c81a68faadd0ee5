"""Whose poses the ids of one or several files are."""

import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import FileFormatError, InputWarning
from pcm_jax.files import read_graph

UNIT = "1 0 0 1 0 1"


def key(name: str) -> int:
    return (ord(name[0]) << 56) | int(name[1:])


def vertex(name, x=0.0):
    return f"VERTEX_SE2 {key(name)} {x} 0 0"


def edge(a, b, x=1.0, information=UNIT):
    return f"EDGE_SE2 {key(a)} {key(b)} {x} 0 0 {information}"


def robot(letter, *edges, first=0):
    """A chain of three poses, and further edges."""
    names = [f"{letter}{first + k}" for k in range(3)]
    return [*map(vertex, names), edge(*names[:2]), edge(*names[1:]), *edges]


def links(graph):
    """The closures as text: "a0-b2 1.0"."""
    c = graph.closures
    x = np.asarray(lie.parameters(lie.as_numpy(c.measurement)))[:, 2]
    ends = zip(c.robot_a, c.pose_a, c.robot_b, c.pose_b, strict=True)
    names = [
        f"{graph.maps[a].pose_name(int(i))}-{graph.maps[b].pose_name(int(k))}"
        for a, i, b, k in ends
    ]
    return [f"{name} {value:g}" for name, value in zip(names, x, strict=True)]


def test_plain_ids_belong_to_their_file(write):
    lines = ("VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 1 0 0", f"EDGE_SE2 0 1 1 0 0 {UNIT}")
    paths = [write(*lines, name=name) for name in ("one.g2o", "two.g2o", "one-more.g2o")]
    graph = read_graph(*paths)
    assert graph.names == ("one", "two", "one-more")
    assert [one.ids.tolist() for one in graph.maps] == [[0, 1]] * 3
    assert len(graph.closures) == 0


def test_symbols_name_robots_and_keep_every_digit(write):
    graph = read_graph(write(*robot("x", first=2**55), *robot("B")))
    assert graph.names == ("B", "x")
    assert graph.maps[1].ids.tolist() == [key(f"x{2**55 + k}") for k in range(3)]
    assert graph.maps[1].ids.dtype == np.int64
    assert graph.maps[1].pose_name(2) == f"x{2**55 + 2}"


def test_robots_come_in_the_order_of_the_files_that_hold_them(write):
    second = write(*robot("b", edge("b0", "a1")), name="0.g2o")
    first = write(*robot("a"), name="1.g2o")
    assert read_graph(second, first).names == ("b", "a")
    assert links(read_graph(second, first)) == ["b0-a1 1"]


def test_edges_repeated_across_files_count_once(write):
    shared = [edge("a0", "b1"), edge("a2", "b2", 2.0)]
    one = write(*robot("a", *shared), name="0.g2o")
    two = write(*robot("b", *reversed(shared)), name="1.g2o")
    graph = read_graph(one, two)
    assert links(graph) == ["a0-b1 1", "a2-b2 2"]
    assert graph.closures.source.tolist() == [f"{one}:6", f"{one}:7"]
    assert [one.num_edges for one in graph.maps] == [2, 2]


def test_a_closure_stated_again_counts_once(write):
    """One pair of poses measured again, with the same numbers or with others, in several files."""
    same, other = edge("a0", "b1"), edge("a0", "b1", 1.1)
    one = write(*robot("a", same, other), name="0.g2o")
    two = write(*robot("b", same, same), name="1.g2o")
    three = write(*robot("c", other, same, same, edge("a0", "b1", 1.2)), name="2.g2o")
    with pytest.warns(InputWarning, match=rf"2 closures repeat .*{two}:7 says what {one}:6 says"):
        graph = read_graph(one, two, three)
    assert links(graph) == ["a0-b1 1", "a0-b1 1.1", "a0-b1 1.2"]


@pytest.mark.parametrize(
    ("factor", "information", "count"),
    [
        (1.0 + 9e-6, UNIT, 1),
        (1.0 + 2e-5, UNIT, 2),
        (1.0, "1.000009 0 0 1 0 1", 1),
        (1.0, "1 0 0 1 0 1.00002", 2),
    ],
)
def test_copies_agree_to_five_digits(write, factor, information, count):
    one = write(*robot("a", edge("a0", "b1", 7.0)), name="0.g2o")
    two = write(*robot("b", edge("a0", "b1", 7.0 * factor, information)), name="1.g2o")
    assert len(read_graph(one, two).closures) == count


def test_copies_may_have_the_opposite_quaternion(write):
    unit = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
    parts = []
    for letter, sign in (("a", 1.0), ("b", -1.0)):
        names = [key(f"{letter}{k}") for k in range(2)]
        lines = [f"VERTEX_SE3:QUAT {name} 0 0 0 0 0 0 1" for name in names]
        lines.append(f"EDGE_SE3:QUAT {names[0]} {names[1]} 1 0 0 0 0 0 1 {unit}")
        turn = f"{sign * 0.6} 0 0 {sign * 0.8}"
        lines.append(f"EDGE_SE3:QUAT {key('a0')} {key('b1')} 1 2 3 {turn} {unit}")
        parts.append(write(*lines, name=f"{letter}.g2o"))
    assert len(read_graph(*parts).closures) == 1


def test_repeated_inside_one_file(write):
    """Of a map's edges two measurements, as the file has them; of closures one."""
    lines = [*robot("a", edge("a0", "b0"), edge("a0", "b0"), edge("a0", "a1")), *robot("b")]
    with pytest.warns(InputWarning, match="1 closures repeat earlier ones"):
        graph = read_graph(write(*lines))
    assert len(graph.closures) == 1
    assert graph.maps[0].num_edges == 3


def test_robots_without_vertices(write):
    """Their poses are all that edges name, also those from other robots' poses."""
    one = write(edge("a0", "a1"), edge("a1", "a2"), edge("a1", "b3"), name="0.g2o")
    two = write(edge("b2", "b3"), edge("b3", "b4"), edge("a1", "b3"), name="1.g2o")
    graph = read_graph(one, two)
    assert [one.ids.tolist() for one in graph.maps] == [
        [key(f"{letter}{k}") for k in ks] for letter, ks in (("a", (0, 1, 2)), ("b", (2, 3, 4)))
    ]
    assert links(graph) == ["a1-b3 1"]


def test_symbols_and_plain_ids_mix(write):
    plain = write(
        "VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 1 0 0", f"EDGE_SE2 0 1 1 0 0 {UNIT}", name="p"
    )
    graph = read_graph(write(*robot("a")), plain)
    assert graph.names == ("a", "p")


def test_an_edge_to_a_robot_that_no_file_holds(write):
    path = write(*robot("a", edge("a0", "b17")))
    with pytest.raises(FileFormatError) as caught:
        read_graph(path)
    assert str(caught.value) == (
        f"{path}:6: edge to pose b17, but no file given holds that robot's map;"
        " give its file as well"
    )


def test_an_edge_to_another_robots_pose_that_is_not_there(write):
    path = write(*robot("a", edge("a0", "b17")), *robot("b"))
    with pytest.raises(FileFormatError, match=":6: edge to pose b17, which no VERTEX line defines"):
        read_graph(path)


def test_a_vertex_repeated_across_files(write):
    one = write(*robot("a"), vertex("b1", 1e-12), *robot("b")[:1], name="0.g2o")
    two = write(*robot("b"), name="1.g2o")
    with pytest.raises(FileFormatError, match=r"1.g2o:2: vertex b1 again, .* than at .*0.g2o:6"):
        read_graph(one, two)
