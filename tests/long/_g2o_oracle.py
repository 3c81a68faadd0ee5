"""A strict reader of g2o, which shares nothing with the package: what plain files must mean.

It knows two kinds of vertex and of edge, finite ASCII numbers and single spaces, and declines all
else, so that it is right by being short.
"""

from __future__ import annotations

import re

import numpy as np

NUMBER = re.compile(r"-?[0-9]{1,15}(\.[0-9]{1,17})?(e-?[0-9]{1,2})?")
INTEGER = re.compile(r"0|[1-9][0-9]{0,18}")
EDGES = {"EDGE_SE2": 3 + 6, "EDGE_SE3:QUAT": 7 + 21}
VERTICES = {"VERTEX_SE2": 3, "VERTEX_SE3:QUAT": 7}


def strict(text: str) -> tuple[set[int], list[np.ndarray]] | None:
    """The ids of the poses and a row for each edge, or None for what is not plain.

    A row has the two ids, the measurement (metres; radians, or a unit quaternion x y z w whose w is
    not negative), and the information's upper triangle, row by row.
    """
    ids, rows = set(), []
    for line in text.split("\n"):
        tag, *words = line.split(" ")
        if tag == "" and not words:
            continue
        count = {**VERTICES, **EDGES}.get(tag)
        integers = 1 if tag in VERTICES else 2
        if count is None or len(words) != integers + count:
            return None
        if not all(INTEGER.fullmatch(word) for word in words[:integers]):
            return None
        if any(int(word) >= 1 << 63 for word in words[:integers]):
            return None
        if not all(NUMBER.fullmatch(word) for word in words[integers:]):
            return None
        if tag in VERTICES:
            if int(words[0]) in ids:
                return None
            ids.add(int(words[0]))
        else:
            numbers = np.array([float(word) for word in words[2:]])
            if tag == "EDGE_SE3:QUAT":
                turn = numbers[3:7]
                if abs(np.linalg.norm(turn) - 1) > 1e-6:
                    return None
                numbers[3:7] = turn / np.linalg.norm(turn) * (1 if turn[3] >= 0 else -1)
            elif abs(numbers[2]) > np.pi:
                return None
            rows.append(np.array([int(words[0]), int(words[1]), *numbers], object))
    return None if _lone(ids, rows) else (ids, rows)


def _lone(ids: set[int], rows: list[np.ndarray]) -> set[int]:
    """Letters of symbols between whose poses no edge is: landmarks, which are left out, and told.

    Nor is it plain where ids with a letter and without one are in one file.
    """
    ends = [(int(row[0]) >> 56, int(row[1]) >> 56) for row in rows]
    letters = {one >> 56 for one in ids} | {letter for pair in ends for letter in pair}
    joined = {a for a, b in ends if a == b}
    return letters - joined if letters != {0} else set()
