"""A format of a user's own: a few lines outside the package."""

import subprocess
import sys

import jaxlie
import numpy as np
import pytest

from pcm_jax import files, lie
from pcm_jax.cli import main
from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files import read_graph, write_graph
from pcm_jax.files.formats import Format, formats, markdown, register, unregister
from pcm_jax.files.pose_file import Lines, PoseFile, no_lines


def read_toy(source, _):
    """Lines `i j x y angle`, all of the same information."""
    rows = np.array([line.split()[1:] for _, line in source.head], float)
    transforms = np.stack([np.cos(rows[:, 4]), np.sin(rows[:, 4]), *rows[:, 2:4].T], axis=1)
    information = np.broadcast_to(np.eye(3), (len(rows), 3, 3)).copy()
    edges = Lines(rows[:, :2].astype(np.int64), transforms, information, np.arange(len(rows)) + 1)
    return PoseFile(source.path, jaxlie.SE2, no_lines(jaxlie.SE2, 1), edges)


def write_toy(path, graph):
    (one,) = graph.maps
    rows = zip(one.tail, one.head, lie.log(lie.as_numpy(one.measurement)), strict=True)
    text = [f"toy {i} {k} {x!s} {y!s} {angle!s}" for i, k, (x, y, angle) in rows]
    path.write_text("\n".join(text))


@pytest.fixture
def toy():
    name = "toy"
    yield register(
        Format(
            name,
            "edges of one robot",
            recognise=lambda source: float(source.head[:1] != [] and "toy" in source.head[0][1]),
            read=read_toy,
            write=write_toy,
            suffixes=(".toy",),
        )
    )
    unregister(name)


def test_a_new_format_is_a_few_lines(toy, tmp_path):
    (tmp_path / "a.toy").write_text("toy 0 1 1 0 0\ntoy 1 2 2 0 0\n")
    graph = read_graph(tmp_path / "a.toy")
    assert graph.maps[0].num_poses == 3
    np.testing.assert_allclose(np.asarray(graph.maps[0].poses.unit_complex_xy)[2, 2:], [3, 0])
    write_graph(tmp_path / "b.toy", graph)
    again = read_graph(tmp_path / "b.toy", format="toy")
    np.testing.assert_array_equal(again.maps[0].information, graph.maps[0].information)
    assert again.maps[0].num_edges == 2
    assert toy in formats()


def test_formats_are_told_by_suffix_or_name(tmp_path, make_robots):
    graph = make_robots(jaxlie.SE2)
    write_graph(tmp_path / "a.g2o.gz", graph)
    assert len(read_graph(tmp_path / "a.g2o.gz").maps) == 2
    with pytest.raises(FileFormatError, match=r"suffix '.toy' given, expected one of .*\.g2o"):
        write_graph(tmp_path / "a.toy", graph)
    with pytest.raises(InputError, match="format: 'toro' given, expected one that is written"):
        write_graph(tmp_path / "a.toy", graph, format="toro")
    with pytest.raises(InputError, match=r"format: 'toy' given, expected one of .*g2o"):
        write_graph(tmp_path / "a.toy", graph, format="toy")


def test_content_of_no_format(write):
    path = write("one two three")
    with pytest.raises(FileFormatError, match=":1: 'one two three' begins no format known"):
        read_graph(path)
    with pytest.raises(FileFormatError, match="; 3 numbers a line, where TUM's have 8, KITTI's 12"):
        read_graph(write("1 2 3"))
    with pytest.raises(FileFormatError, match="; g2o's lines begin with VERTEX_SE2"):
        read_graph(write("VERTEX_SIM3 1 2 3"))


def test_the_table_of_formats_is_the_registrys():
    assert markdown() in files.__doc__, "replace the table in pcm_jax/files/__init__.py"


def test_formats_command(capsys):
    assert main(["formats"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:4] == ["format", "holds", "read", "written"]
    assert {one.name for one in formats()} == {line.split()[0] for line in lines[1:]}


def test_formats_command_imports_no_reader():
    code = (
        "import sys; from pcm_jax.cli import main; status = main(['formats']);"
        "sys.exit(status or int('jax' in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
