"""The table of promised figures in the top README."""

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
    found = dict.fromkeys(headlines.ROWS.values(), entry(1.5, 2.0, True))
    found["cliques/hard/over_mcqd"] = entry(2.5, 2.0, False, "each node costs a call")
    found["streaming/SE3-20000/seconds"] = entry(900.0, None, None)
    return found


def test_every_row_is_measured_by_some_case():
    known = {f"{case.name}/{metric.name}" for case in all_cases() for metric in case.metrics}
    assert set(headlines.ROWS.values()) <= known


def test_rows_and_reasons(entries):
    lines = headlines.table(entries).splitlines()
    assert lines[2] == (
        "| Q of 1,000 closures in space, an ordered pair | ≤ 2 s | 1.5 s | `distances/SE3-1000` |"
    )
    assert "| 20,000 closures in space to a graph |  | 900 s | `streaming/SE3-20000` |" in lines
    label = "their times over mcqd's (C++), geometric mean"
    assert f"| {label} | ≤ 2 s | **2.5 s** | `cliques/hard` |" in lines
    assert headlines.missed(entries) == f"- *{label}*: each node costs a call."


def test_readme_keeps_all_else(entries):
    document = f"before\n\n{headlines.MARKERS[0]}\nold\n{headlines.MARKERS[1]}\nafter"
    text = headlines.with_headlines(document, entries)
    assert text.startswith(f"before\n\n{headlines.MARKERS[0]}\n\n| ")
    assert text.endswith(f"a call.\n\n{headlines.MARKERS[1]}\nafter")
    assert "old" not in text
    assert headlines.with_headlines(text, entries) == text


def test_readme_has_a_place_for_it():
    assert all(marker in headlines.README.read_text() for marker in headlines.MARKERS)
