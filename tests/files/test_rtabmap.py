"""RTAB-Map's databases, made in the test as its schema says."""

import sqlite3

import numpy as np
import pytest
from long._rtabmap_tables import INSERT_LINK, INSERT_NODE, blob, make_tables

from pcm_jax import lie
from pcm_jax.errors import FileFormatError
from pcm_jax.files import read_graph

INFORMATION = np.diag([100.0, 100, 100, 400, 400, 400])


@pytest.fixture
def base(tmp_path):
    """Two sessions of three poses, two closures between them, a landmark and a prior."""
    path = tmp_path / "two.db"
    with sqlite3.connect(path) as made:
        make_tables(made)
        for node in range(1, 7):
            made.execute(
                INSERT_NODE,
                (node, int(node > 3), 1000.0 + node, blob(node - 1.0), blob(2.0 * node)),
            )
        weight = INFORMATION.tobytes()
        rows = [(1, 2, 0, 1.0), (2, 3, 0, 1.0), (4, 5, 0, 1.0), (5, 6, 6, 1.0)]
        rows += [(b, a, kind, -x) for a, b, kind, x in rows]  # stored at both ends
        rows += [(4, 1, 1, 3.0), (6, 3, 4, 3.0), (1, -1, 8, 0.0), (1, 1, 7, 0.5)]
        for first, second, kind, x in rows:
            made.execute(INSERT_LINK, (first, second, kind, weight, blob(x)))
    made.close()
    return path


def test_sessions_are_robots(base):
    with pytest.warns(UserWarning, match=r"skipped 1 lines \(1 landmark\)"):
        graph = read_graph(base)
    assert graph.names == ("session0", "session1")
    first, second = graph.maps
    assert second.ids.tolist() == [4, 5, 6]
    assert [one.num_edges for one in graph.maps] == [2, 2]
    np.testing.assert_allclose(first.information[0], INFORMATION)
    np.testing.assert_allclose(lie.translation(lie.as_numpy(second.poses))[:, 0], [3, 4, 5])
    np.testing.assert_allclose(second.stamps, [1004, 1005, 1006])
    assert graph.closures.robot_a.tolist() == [1, 1]
    assert graph.closures.pose_b.tolist() == [0, 2]
    np.testing.assert_allclose(lie.translation(graph.closures.measurement)[:, 0], [3, 3])
    np.testing.assert_allclose(lie.translation(graph.truth[0])[:, 0], [2, 4, 6])
    assert first.priors.pose.tolist() == [0]


def test_another_programs_database(tmp_path):
    with sqlite3.connect(tmp_path / "other.db") as made:
        made.execute("CREATE TABLE songs (name TEXT)")
    made.close()
    with pytest.raises(FileFormatError, match=r"other.db: no column Node.id, expected an RTAB-Map"):
        read_graph(tmp_path / "other.db")


def test_a_damaged_database(base):
    base.write_bytes(base.read_bytes()[:2000])
    with pytest.raises(FileFormatError, match=r"two.db: damaged database|no column"):
        read_graph(base)


def test_a_link_without_a_transform(base):
    with sqlite3.connect(base) as made:
        made.execute("UPDATE Link SET transform = ? WHERE type = 4", (b"12",))
    made.close()
    with pytest.raises(FileFormatError, match="link 6-3: expected 36 doubles and 12 floats"):
        read_graph(base)


def earlier(path, columns, values):
    """A database of an earlier version: links with other columns in place of the information."""
    with sqlite3.connect(path) as made:
        made.execute("CREATE TABLE Node (id INTEGER PRIMARY KEY, map_id INTEGER, pose BLOB)")
        names = "".join(f", {name} FLOAT" for name in columns)
        made.execute(
            f"CREATE TABLE Link (from_id INTEGER, to_id INTEGER, type INTEGER{names},"
            " transform BLOB)"
        )
        for node in range(1, 5):
            made.execute("INSERT INTO Node VALUES (?, ?, ?)", (node, int(node > 2), blob(node)))
        marks = ", ".join("?" * (4 + len(columns)))
        for first, second, kind in ((1, 2, 0), (3, 4, 0), (4, 1, 1)):
            row = (first, second, kind, *values, blob(1.0))
            made.execute(f"INSERT INTO Link VALUES ({marks})", row)
    made.close()
    return path


@pytest.mark.parametrize(
    ("columns", "values", "sigmas"),
    [
        (("rot_variance", "trans_variance"), (0.0025, 0.01), None),
        (("variance",), (0.01,), None),
        ((), (), (0.1, 0.05)),
    ],
)
def test_earlier_versions(tmp_path, columns, values, sigmas):
    path = earlier(tmp_path / "old.db", columns, values)
    graph = read_graph(path, default_sigmas=sigmas)
    turn = 100.0 if columns == ("variance",) else 400.0
    expected = np.diag([100.0] * 3 + [turn] * 3)
    np.testing.assert_allclose(graph.maps[0].information[0], expected, rtol=1e-12)
    np.testing.assert_allclose(graph.closures.information[0], expected, rtol=1e-12)
    assert graph.maps[0].stamps is None


def test_earlier_versions_that_say_too_little(tmp_path):
    with pytest.raises(FileFormatError, match=r"links without information; give default_sigmas"):
        read_graph(earlier(tmp_path / "none.db", (), ()))
    with pytest.raises(FileFormatError, match=r"link 1-2: expected 36 doubles or positive var"):
        read_graph(earlier(tmp_path / "zero.db", ("variance",), (0.0,)))


def test_nodes_and_links_that_hold_nothing(base):
    """A node that nothing joins, and links that were found by appearance alone."""
    with sqlite3.connect(base) as made:
        made.execute("INSERT INTO Node VALUES (9, 1, 0, 1009, ?, NULL)", (blob(9.0),))
        weight = INFORMATION.tobytes()
        for transform in (None, bytes(48)):
            made.execute("INSERT INTO Link VALUES (5, 2, 1, ?, ?)", (weight, transform))
    made.close()
    left = r"skipped 4 lines \(2 link without a transform, 1 node without a link, 1 landmark\)"
    with pytest.warns(UserWarning, match=left):
        graph = read_graph(base)
    assert [one.num_poses for one in graph.maps] == [3, 3]
    assert len(graph.closures) == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("UPDATE Node SET map_id = 'one' WHERE id = 2", r"row 2: Node.map_id is 'one', expected"),
        ("UPDATE Link SET from_id = 1.5 WHERE rowid = 1", r"row 1: Link.from_id is '1.5', exp"),
        ("UPDATE Link SET type = NULL WHERE rowid = 3", r"row 3: Link.type is 'None', expected an"),
        ("UPDATE Link SET transform = 7 WHERE rowid = 1", "expected 36 doubles and 12 floats"),
    ],
)
def test_values_of_another_kind(base, change, message):
    """SQLite keeps them in any column."""
    with sqlite3.connect(base) as opened:
        opened.execute(change)
    opened.close()
    with pytest.raises(FileFormatError, match=message):
        read_graph(base)


@pytest.mark.filterwarnings("ignore:.*skipped 1 lines")
def test_stamps_that_are_none(base):
    with sqlite3.connect(base) as opened:
        opened.execute("UPDATE Node SET stamp = 'noon' WHERE id = 1")
    opened.close()
    np.testing.assert_array_equal(read_graph(base).maps[0].stamps, [np.nan, 1002, 1003])


def test_numbers_that_signal(base):
    """A NaN of the kind that a processor complains of is no pose, like any other."""
    signalling = np.full(12, 0x7FA00000, np.uint32).tobytes()
    with sqlite3.connect(base) as opened:
        opened.execute("UPDATE Node SET pose = ? WHERE id = 1", (signalling,))
    opened.close()
    with pytest.raises(FileFormatError, match="edge to pose 1, which no VERTEX line defines"):
        read_graph(base)


def test_a_schema_that_is_no_text(base):
    """SQLite's own message about it is none either."""
    data = base.read_bytes()
    base.write_bytes(data.replace(b"CREATE TABLE Link", b"CREATE TABL\xf4 Link"))
    with pytest.raises(FileFormatError, match=r"two\.db: damaged database"):
        read_graph(base)


def test_a_row_that_says_it_is_longer_than_any_memory(tmp_path):
    path = tmp_path / "long.db"
    with sqlite3.connect(path) as made:
        made.execute("PRAGMA page_size=512")
        make_tables(made)
    made.close()
    data = bytearray(path.read_bytes())
    first = int.from_bytes(data[108:110], "big")  # cell of the schema, which begins with its length
    data[first : first + 9] = b"\xff" * 9
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match=r"long\.db: damaged database: a row is too long"):
        read_graph(path)
