"""Every bad file gives one line that names file, line, value and what was expected."""

import gzip
import lzma
import subprocess
import sys

import pytest

from pcm_jax.errors import FileFormatError, InputWarning
from pcm_jax.files import read_graph, write_g2o

GOOD = [
    "VERTEX_SE2 0 0 0 0",
    "VERTEX_SE2 1 1 0 0",
    "VERTEX_SE2 2 2 0 0",
    "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1",
    "EDGE_SE2 1 2 1 0 0 1 0 0 1 0 1",
]
VERTEX_3D = "VERTEX_SE3:QUAT 3 0 0 0 0 0 0 1"


@pytest.mark.parametrize(
    ("number", "line", "message"),
    [
        (
            2,
            "VERTEX_SE4 1 1 0 0",
            ":2: unknown tag 'VERTEX_SE4', expected one of VERTEX_SE2, EDGE_",
        ),
        (2, "1344081605.38 1 0 0", ":2: unknown tag '1344081605.38', expected one of"),
        (2, "VERTEX_SE2 1 1 0", ":2: 4 columns, expected 5: tag id x y theta$"),
        (2, "VERTEX_SE2 1 1 0 0 0", ":2: 6 columns, expected 5: tag id x y theta$"),
        (
            4,
            "EDGE_SE2 0 1 1 0 0 1 0 0 1 0",
            ":4: 11 columns, expected 12: tag id id x y theta and 6",
        ),
        (2, "VERTEX_SE2 1 nan 0 0", ":2: nan given, expected a finite number$"),
        (2, "VERTEX_SE2 1 1e400 0 0", ":2: inf given, expected a finite number$"),
        (
            2,
            "VERTEX_SE2 1 1e200 0 0",
            r":2: 1e\+200 given, expected a finite number below 1e\+100$",
        ),
        (4, "EDGE_SE2 0 1 1 0 -inf 1 0 0 1 0 1", ":4: -inf given, expected a finite number$"),
        (4, "EDGE_SE2 0 1 1 0 0 1 0 NaN 1 0 1", ":4: nan given, expected a finite number$"),
        (2, "VERTEX_SE2 1 one 0 0", ":2: 'one' given, expected a number$"),
        (2, "VERTEX_SE2 1 1_0 0 0", ":2: '1_0' given, expected a number$"),
        (2, "VERTEX_SE2 1.0 1 0 0", ":2: '1.0' given, expected an integer id of 64 bits$"),
        (
            2,
            f"VERTEX_SE2 {2**63} 1 0 0",
            f":2: '{2**63}' given, expected an integer id of 64 bits$",
        ),
        (5, "EDGE_SE2 1 3 1 0 0 1 0 0 1 0 1", ":5: edge to pose 3, which no VERTEX line defines$"),
        (5, "EDGE_SE2 7 2 1 0 0 1 0 0 1 0 1", ":5: edge to pose 7, which no VERTEX line defines$"),
        (5, "EDGE_SE2 1 1 1 0 0 1 0 0 1 0 1", ":5: edge from pose 1 to itself, expected two"),
        (3, "VERTEX_SE2 1 2 0 0", r":3: vertex 1 again, with another pose than at .*g2o:2$"),
        (3, VERTEX_3D, ":3: VERTEX_SE3:QUAT in a file that began with VERTEX_SE2: SE.2. and SE.3."),
        (
            4,
            "EDGE_SE2 0 1 1 0 0 1 0 0 -1 0 1",
            r":4: information is not positive definite \(smallest eigenvalue -1\); repair=.clip. ",
        ),
        (5, "FIX 1", ": the map falls into 2 parts: no edges lead from pose 0 to pose 2, expected"),
    ],
)
def test_one_bad_line(write, number, line, message):
    lines = list(GOOD)
    lines[number - 1] = line
    path = write(*lines)
    with pytest.raises(FileFormatError, match=f"^{path}{message}") as caught:
        read_graph(path)
    assert "\n" not in str(caught.value)
    assert caught.value.line == (None if "falls" in message else number)


def test_the_first_bad_line_is_named(write):
    path = write(*GOOD[:4], "BAD 1", *GOOD[4:], "WORSE 2", "VERTEX_SE2 x")
    with pytest.raises(FileFormatError, match=r":5: unknown tag 'BAD'"):
        read_graph(path)


def test_quaternions(write):
    edge = "EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 {} " + "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
    vertices = ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1", "VERTEX_SE3:QUAT 1 0 0 0 0 0 0 1")
    with pytest.raises(FileFormatError, match=r":3: quaternion of norm 0, expected norm 1$"):
        read_graph(write(*vertices, edge.format(0)))
    with pytest.warns(
        InputWarning, match=r":3: quaternion of norm 1.002 scaled to norm 1 \(2 such"
    ):
        graph = read_graph(write(*vertices, edge.format(1.002), edge.format(0.992)))
    assert graph.maps[0].measurement.wxyz_xyz[:, 0].tolist() == [1.0, 1.0]
    read_graph(write(*vertices, edge.format(1.0009)))  # rounding in the file is no cause for alarm


def test_groups_of_two_files(write):
    flat = write(*GOOD, name="flat.g2o")
    solid = write(VERTEX_3D, name="solid.g2o")
    with pytest.raises(
        FileFormatError, match=r"solid.g2o: holds SE3 poses, but .*flat.g2o holds SE2"
    ):
        read_graph(flat, solid)


@pytest.mark.parametrize("text", ["", "\n\n", "# only a comment\n", "FIX 0\n"])
def test_nothing_in_the_file(tmp_path, text):
    path = tmp_path / "empty.g2o"
    path.write_text(text)
    with pytest.raises(
        FileFormatError, match=r"empty.g2o: no VERTEX or EDGE line, expected a pose"
    ):
        read_graph(path)


def test_a_file_cut_short_inside_a_line(tmp_path):
    path = tmp_path / "cut.g2o"
    path.write_text("\n".join(GOOD)[:-8])
    with pytest.raises(FileFormatError, match=r":5: \d+ columns, .*\(is the file cut short\?\)$"):
        read_graph(path)


@pytest.mark.parametrize("compress", [gzip.compress, lzma.compress])
@pytest.mark.parametrize("keep", [7, 40, -1, -9])
def test_a_compressed_file_cut_short(tmp_path, compress, keep):
    path = tmp_path / "graph.g2o.xz"
    path.write_bytes(compress("\n".join(GOOD).encode())[:keep])
    with pytest.raises(
        FileFormatError, match=r"graph.g2o.xz: damaged or truncated compressed file"
    ):
        read_graph(path)


@pytest.mark.parametrize("compress", [gzip.compress, lzma.compress])
def test_a_damaged_compressed_file(tmp_path, compress):
    data = bytearray(compress("\n".join(GOOD).encode()))
    data[len(data) // 2] ^= 0xFF
    path = tmp_path / "graph.g2o.gz"
    path.write_bytes(bytes(data))
    with pytest.raises(FileFormatError):
        read_graph(path)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"VERTEX_SE2 0 0 0 0\n\0\1\2", r":2: binary data \(a zero byte\), expected text$"),
        (b"VERTEX_SE2 0 0 0 0\n\n\xff\xfe\n", r":3: binary data \(byte 0xff\), expected text$"),
        (b"\x89PNG\r\n\x1a\n", r":1: binary data \(byte 0x89\), expected text$"),
    ],
)
def test_binary_files(tmp_path, data, message):
    path = tmp_path / "graph.g2o"
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match=message):
        read_graph(path)


def test_missing_files_and_folders(tmp_path, write):
    with pytest.raises(FileFormatError, match=r"none.g2o: there is no such file$"):
        read_graph(tmp_path / "none.g2o")
    with pytest.raises(FileFormatError, match=r"this is a folder, expected a file$"):
        read_graph(tmp_path)
    with pytest.raises(FileFormatError, match="cannot be read"):
        read_graph("a\0b")
    graph = read_graph(write(*GOOD))
    with pytest.raises(
        FileFormatError, match=r"out.g2o: there is no folder .*missing to write to$"
    ):
        write_g2o(tmp_path / "missing" / "out.g2o", graph)
    with pytest.raises(FileFormatError, match=r"cannot be written: File name too long$"):
        write_g2o(tmp_path / ("x" * 300), graph)
    with pytest.raises(FileFormatError, match=r"this is a folder, expected a file to write to$"):
        write_g2o(tmp_path, graph)


def test_importing_the_readers_does_not_import_scipy():
    """Reading a file needs csgraph; importing the package must not."""
    code = "import sys, pcm_jax.files; sys.exit('scipy.sparse.csgraph' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.filterwarnings("ignore::pcm_jax.errors.InputWarning")
def test_information_whose_inverse_is_at_the_end_of_floats(write):
    """Looking at what sigmas it would mean overflows nowhere."""
    unit = "1 0 0 1 0"
    read_graph(write(f"ODOMETRY 0 1 1 0 0.5 {unit} 1e-308", f"EDGE2 0 1 1 0 0.5 {unit} 1"))


def test_information_that_overflows_where_it_is_turned(write):
    """Of a covariance in the frame of the edge's start, in TORO's files."""
    unit = "1 0 0 0 0 0 1e-308 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
    vertices = "VERTEX3 0 0 0 0 0 0 0", "VERTEX3 1 1 2 3 0 0 0"
    path = write(*vertices, f"EDGE3 0 1 1 2 3 0.1 0.2 0.3 {unit}")
    with pytest.raises(FileFormatError, match=r":3: .* given, expected a finite number"):
        read_graph(path, information="covariance")
