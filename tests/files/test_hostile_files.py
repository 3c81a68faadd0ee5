"""Files that never end, grow, or take long to be refused; names that comments cannot hold."""

import gzip
import io
import os
import threading

import jaxlie
import numpy as np
import pytest

from pcm_jax.errors import FileFormatError, InputError, InputWarning
from pcm_jax.files import read_graph, write_candidates, write_g2o
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph

UNIT = "1 0 0 1 0 1"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_pipes_and_devices(tmp_path):
    os.mkfifo(tmp_path / "pipe.g2o")
    for path in (tmp_path / "pipe.g2o", "/dev/zero"):
        with pytest.raises(FileFormatError, match="this is a pipe or a device, expected a file"):
            read_graph(path)


def test_what_a_compressed_file_grows_to_is_bounded(tmp_path):
    path = tmp_path / "bomb.g2o.gz"
    with gzip.open(path, "wb", 1) as file:
        file.write(b"\0" * (1 << 20) * 3)
    with pytest.raises(FileFormatError, match=r"bomb.g2o.gz:1: binary data \(a zero byte\)"):
        read_graph(path)
    with gzip.open(path, "wb", 1) as file:
        file.write(b"FIX 1\n" * (1 << 20))
    with pytest.raises(FileFormatError, match=r"bomb.g2o.gz: more than 3 MiB of text"):
        read_graph(path, byte_limit=3 << 20)


@pytest.mark.parametrize("blank", [b"\n", b" "])
def test_what_is_blank_without_end_is_refused(blank, tmp_path):
    """Each blank line would be one to look at, and eight bytes to keep."""
    path = tmp_path / "blank.g2o.gz"
    with gzip.open(path, "wb", 1) as file:
        file.write(b"VERTEX_SE2 0 0 0 0\n" + blank * (3 << 20))
    assert read_graph(path).maps[0].num_poses == 1
    with gzip.open(path, "wb", 1) as file:
        file.write(b"VERTEX_SE2 0 0 0 0\n" + blank * (18 << 20))
    with pytest.raises(FileFormatError, match=r"blank.g2o.gz:\d+: 16 MiB of white space, expected"):
        read_graph(path)


def test_a_first_word_a_line_is_no_pose_graph(tmp_path):
    """Each would be a kind of line of its own."""
    path = tmp_path / "words.g2o"
    path.write_text("VERTEX_SE2 0 0 0 0\n" + "".join(f"word{k} 1\n" for k in range(1000)))
    with pytest.raises(FileFormatError, match=r"words.g2o:301: unknown tag 'word299'"):
        read_graph(path)


def test_many_edges_between_two_poses(tmp_path):
    """Two files share parallel edges: matching them each with each would be 10⁸ comparisons."""
    key = ord("a") << 56
    for file in range(2):
        lines = [f"VERTEX_SE2 {key + k} {k} 0 0" for k in range(2)]
        lines += [
            f"EDGE_SE2 {key} {key + 1} {1 + (2 * i + file) * 1e-3} 0 0 {UNIT}" for i in range(5000)
        ]
        (tmp_path / f"{file}.g2o").write_text("\n".join(lines))
    first = tmp_path / "0.g2o"
    (tmp_path / "2.g2o").write_text(first.read_text())
    assert read_graph(first, tmp_path / "2.g2o").maps[0].num_edges == 5000
    assert read_graph(first, tmp_path / "1.g2o", ids="symbols").maps[0].num_edges == 10_000


def robots(names, ids=None):
    chain = {
        "tail": [0],
        "head": [1],
        "measurement": np.eye(3)[None],
        "information": 100 * np.eye(3)[None],
    }
    maps = tuple(
        PoseGraph.from_arrays(name=name, ids=None if ids is None else ids[k], **chain)
        for k, name in enumerate(names)
    )
    closures = LoopClosures.from_arrays(
        robot_a=[0, 0],
        pose_a=[0, 1],
        robot_b=[1, 1],
        pose_b=[0, 1],
        measurement=np.tile(np.eye(3), (2, 1, 1)),
        information=np.tile(np.eye(3), (2, 1, 1)),
    )
    return MultiRobotGraph(maps, closures)


def test_names_that_look_like_comments(tmp_path):
    graph = robots(("#1", "#2"))
    for number, one in enumerate(graph.maps):
        write_g2o(tmp_path / f"{number}.g2o", one)
    write_candidates(tmp_path / "c.csv", graph)
    again = read_graph(tmp_path / "0.g2o", tmp_path / "1.g2o", closures=tmp_path / "c.csv")
    assert again.names == ("#1", "#2") and len(again.closures) == 2


def test_tables_of_ids_belong_to_one_file(tmp_path):
    one = robots(("left", "right"), ([10, 11], [20, 21]))
    two = robots(("red", "blue"), ([70, 71], [80, 81]))
    for first, second in (("run.1", "run.2"), ("x.g2o", "x.g2o.gz")):
        write_g2o(tmp_path / first, one, ids="sequential")
        write_g2o(tmp_path / second, two, ids="sequential")
        assert read_graph(tmp_path / first).names == ("left", "right")
        assert read_graph(tmp_path / second).names == ("red", "blue")
    for name in ("mer\nged.g2o", " lead.g2o"):
        with pytest.raises(InputError, match="cannot be named in a comment"):
            write_g2o(tmp_path / name, one, ids="sequential")


def test_a_table_that_gives_a_vertex_twice(write):
    lines = [f"VERTEX_SE2 {k} {k} 0 0" for k in range(2)]
    path = write(*lines, f"EDGE_SE2 0 1 1 0 0 {UNIT}", "# pcm_jax id-table graph.ids.csv")
    write("vertex,robot,id", "0,x,10", "1,x,11", "1,y,99", name="graph.ids.csv")
    with pytest.raises(FileFormatError, match=r"ids.csv:4: vertex 1 again, expected it once"):
        read_graph(path)


def test_ids_beyond_64_bits():
    chain = {
        "tail": [0],
        "head": [1],
        "measurement": np.eye(3)[None],
        "information": np.eye(3)[None],
    }
    with pytest.raises(InputError, match=f"ids: {2**63} given, expected integers below"):
        PoseGraph.from_arrays(ids=np.array([0, 2**63], np.uint64), **chain)
    maps = (
        PoseGraph.from_arrays(ids=[-1, 1], name="a", **chain),
        PoseGraph.from_arrays(name="b", **chain),
    )
    with pytest.raises(InputError, match=rf"id_a\[0\]: id {2**64 - 1} given"):
        LoopClosures.from_ids(
            maps,
            robot_a=[0],
            id_a=np.array([2**64 - 1], np.uint64),
            robot_b=[1],
            id_b=[0],
            measurement=np.eye(3)[None],
            information=np.eye(3)[None],
        )


def test_information_that_only_one_factorisation_takes(write):
    """Its pivots are positive, but LAPACK rounds otherwise: an error, no traceback later."""
    triangle = (
        "3.3531860110994844 0.1972654405723253 3.523802818948322 0.6289551108784172"
        " -0.0372130839702598 3.7999470774749846"
    )
    path = write(*(f"VERTEX_SE2 {k} {k} 0 0" for k in range(2)), f"EDGE_SE2 0 1 1 0 0 {triangle}")
    with pytest.raises(FileFormatError, match=r"g2o:3: information is not positive definite"):
        read_graph(path)
    with pytest.warns(InputWarning, match="1 information matrices clipped"):
        read_graph(path, repair="clip")


def test_threads_that_write_one_path(tmp_path, make_robots):
    """Each writes a temporary file of its own: readers see one or the other, whole."""
    graphs = [make_robots(jaxlie.SE2, ("a", "b"), n=n) for n in (8, 20)]
    whole = set()
    for number, graph in enumerate(graphs):
        write_g2o(tmp_path / f"{number}.g2o", graph)
        whole.add((tmp_path / f"{number}.g2o").read_text())
    problems: list[str] = []

    def work(graph):
        for _ in range(30):
            try:
                write_g2o(tmp_path / "m.g2o", graph)
                if (tmp_path / "m.g2o").read_text() not in whole:
                    problems.append("half a file")
            except InputError as error:
                problems.append(str(error))

    threads = [threading.Thread(target=work, args=(graph,)) for graph in graphs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not problems


def test_what_a_file_grows_to_is_bounded_by_an_option(tmp_path):
    path = tmp_path / "long.g2o.gz"
    with gzip.open(path, "wb", 1) as file:
        file.write(b"VERTEX_SE2 0 0 0 0\n" + b"FIX 00\n" * 1000)
    with pytest.raises(FileFormatError, match=r"long.g2o.gz: more than 5000 bytes of text \(byte_"):
        read_graph(path, byte_limit=5000)
    assert read_graph(path, byte_limit=7019).maps[0].num_poses == 1
    for wrong in (0, 1.5, None, "1"):
        with pytest.raises(InputError, match=r"byte_limit: .* given, expected bytes, at least 1"):
            read_graph(path, byte_limit=wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("packed", [False, True])
def test_a_pipe_that_is_asked_for(packed, monkeypatch):
    text = f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 {UNIT}\n".encode()
    data = gzip.compress(text) if packed else text
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(data)))
    assert read_graph("-").maps[0].num_edges == 1
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(data)))
    with pytest.raises(FileFormatError, match="-: more than 20 bytes of text"):
        read_graph("-", byte_limit=20)
    monkeypatch.setattr("sys.stdin", None)
    with pytest.raises(FileFormatError, match="-: standard input is closed"):
        read_graph("-")


def test_a_table_of_ids_that_was_changed(tmp_path):
    write_g2o(
        tmp_path / "run.g2o", robots(("left", "right"), ([10, 11], [20, 21])), ids="sequential"
    )
    table = tmp_path / "run.ids.csv"
    table.write_text(table.read_text().replace("right", "wrong"))
    with pytest.raises(FileFormatError, match=r"run.ids.csv: changed since .*run.g2o was written"):
        read_graph(tmp_path / "run.g2o")


def test_digits_of_other_scripts_are_no_numbers(write):
    path = write("VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 \u0661 0 0", f"EDGE_SE2 0 1 1 0 0 {UNIT}")
    with pytest.raises(FileFormatError, match=r":2: '\u0661' given, expected a number"):
        read_graph(path)


def test_a_trajectory_without_sigmas_is_refused_before_it_is_read(write):
    path = write("0 0 0 0 0 0 0 1", "1 not a number", name="a.txt")
    with pytest.raises(FileFormatError, match=r"a.txt:1: a trajectory says nothing of its steps'"):
        read_graph(path)
