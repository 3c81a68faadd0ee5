"""The table of promised figures in the top README."""

from fnmatch import fnmatchcase

import pytest

from benchmarks.__main__ import all_cases
from benchmarks.suite import headlines


def entry(value, figure, reached, reason=""):
    return {
        "value": value,
        "unit": "s",
        "direction": "lower",
        "digits": 3,
        "figure": figure,
        "reached": reached,
        "reason": reason,
    }


@pytest.fixture
def entries():
    names = [f"{case.name}/{metric.name}" for case in all_cases() for metric in case.metrics]
    found = dict.fromkeys(names, entry(1.5, 2.0, True))
    found["cliques/hard/over_mcqd"] = entry(2.5, 2.0, False, "each node costs a call")
    found["cliques/hard/worst_over_mcqd"] = entry(9.0, 2.0, False, "each node costs a call")
    found["streaming/SE3-20000/seconds"] = entry(900.0, None, None)
    found["memory/intel/blocks_process"] = entry(3.0, 2.0, False)
    found["memory/intel/cholmod_process"] = entry(None, 2.0, None)
    return found


def test_every_row_is_measured_by_some_case(entries):
    for pattern in headlines.ROWS.values():
        assert any(fnmatchcase(name, pattern) for name in entries), pattern


def test_rows_and_reasons(entries):
    lines = headlines.table(entries).splitlines()
    assert lines[2] == (
        "| Q of 1,000 closures in space, an ordered pair | ≤ 2 s | 1.5 s | `distances/SE3-1000` |"
    )
    label = "20,000 closures in space straight to a graph"
    assert f"| {label} |  | 900 s | `streaming/SE3-20000` |" in lines
    label = "… time over mcqd's (C++), geometric mean"
    assert f"| {label} | ≤ 2 s | **2.5 s** | `cliques/hard` |" in lines
    label = "… of the whole process"
    assert f"| {label} | ≤ 2 s | **3 s** | `memory` |" in lines
    assert headlines.missed(entries).splitlines() == [
        "- `memory/intel/blocks_process` (3 s): not looked into.",
        "- `cliques/hard/over_mcqd` (2.5 s), `cliques/hard/worst_over_mcqd` (9 s): "
        "each node costs a call.",
    ]


def test_readme_keeps_all_else(entries):
    document = f"before\n\n{headlines.MARKERS[0]}\nold\n{headlines.MARKERS[1]}\nafter"
    text = headlines.with_headlines(document, entries)
    assert text.startswith(f"before\n\n{headlines.MARKERS[0]}\n\n| ")
    assert text.endswith(f"a call.\n\n{headlines.MARKERS[1]}\nafter")
    assert "old" not in text
    assert headlines.with_headlines(text, entries) == text


def test_readme_has_a_place_for_it():
    assert all(marker in headlines.README.read_text() for marker in headlines.MARKERS)
