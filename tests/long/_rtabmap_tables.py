"""The tables of an RTAB-Map database, as its schema has them, to be filled."""

import numpy as np

INSERT_NODE = "INSERT INTO Node VALUES (?, ?, 0, ?, ?, ?)"
INSERT_LINK = "INSERT INTO Link VALUES (?, ?, ?, ?, ?)"


def make_tables(made):
    """Makes both tables, empty, in a connection to a database."""
    made.execute(
        "CREATE TABLE Node (id INTEGER PRIMARY KEY, map_id INTEGER, weight INTEGER,"
        " stamp FLOAT, pose BLOB, ground_truth_pose BLOB)"
    )
    made.execute(
        "CREATE TABLE Link (from_id INTEGER, to_id INTEGER, type INTEGER,"
        " information_matrix BLOB NOT NULL, transform BLOB)"
    )


def blob(x, dtype=np.float32):
    """A transform that leads x metres ahead: three rows of a matrix."""
    matrix = np.eye(4)[:3]
    matrix[0, 3] = x
    return matrix.astype(dtype).tobytes()
